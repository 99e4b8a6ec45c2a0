#!/usr/bin/env bash
# Builds the workspace with colcon. Does nothing when no source that is compiled or copied has changed: Python modules are
# linked, so an edit in one needs no build.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"
one_at_a_time

[ -f "$VENV/ngo_key" ] || die "build: there is no complete environment in $VENV; run make venv"
cd "$ROOT/ros_ws"
key="$(
    {
        cat "$VENV/ngo_key"
        find src wheels -type f \( -name package.xml -o -name 'setup.*' -o -name CMakeLists.txt -o -name '*.cmake' \
            -o -name '*.msg' -o -name '*.srv' -o -name '*.action' \) -print0 | sort -z | xargs -0 sha256sum
        find src -type f -path '*/resource/*' -o -type f -path '*/launch/*' -o -type f -path '*/config/*' \
            -o -type f -path '*/weights/*' | grep -v __pycache__ | sort
    } | sha256sum
)"
if [ -f install/local_setup.bash ] && [ "$(cat install/ngo_key 2>/dev/null)" = "$key" ]; then
    exit 0
fi

rm -f install/ngo_key
# Links of an earlier build to sources that are gone would end this one.
for folder in build install; do
    [ ! -d "$folder" ] || find "$folder" -xtype l -delete
done
# A build must see the underlay alone: what this shell has opened besides would end up in the setup files.
unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PYTHONPATH
export NGO_ENV_UNDERLAY_ONLY=1
. "$ROOT/env.sh"

paths=(src) cmake_args=(-DBUILD_TESTING=OFF)
# Stand-ins for packages that this ROS 2 lacks.
for package in wheels/*/package.xml; do
    package="$(dirname "$package")"
    for prefix in ${AMENT_PREFIX_PATH//:/ }; do
        [ ! -d "$prefix/share/${package#wheels/}" ] || continue 2
    done
    paths+=("$package")
done
if is_wheels "$(cat "$VENV/ngo_underlay")"; then
    # A workaround for the wheels' CMake files.
    cmake_args+=("-DCMAKE_PROJECT_INCLUDE=$ROOT/ros_ws/wheels/drop_missing_python_includes.cmake")
fi
step "build the workspace" colcon build --symlink-install --base-paths "${paths[@]}" --cmake-args "${cmake_args[@]}"
# What was compiled lies beside the modules, which are linked.
unset NGO_ENV_UNDERLAY_ONLY
. "$ROOT/env.sh"
weights=()
[ "$(find_purpose)" = lidar ] || weights=(src/ngo_estimator/weights/maze{2d,3d})
step "compile what estimators run" env OMP_NUM_THREADS=1 "$VENV/bin/python" -m ngo_estimator.offline.compile_ahead "${weights[@]}"
echo "$key" >install/ngo_key
