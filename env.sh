# Opens the project's environment in this shell (bash or zsh), from any folder:  . ./env.sh
#
# Order matters: the ROS 2 underlay first (the wheels in .venv, or an installed Jazzy), then the workspace overlay, because
# the overlay's own setup file does not chain to the wheels. The tools folder goes last on PATH so that a real `ros2` wins.

_ngo_env_fail() {
    echo "env.sh: $1" >&2
    if [ -n "${_ngo_nounset-}" ]; then set -u; fi
    unset _ngo_root _ngo_underlay _ngo_shell _ngo_nounset _ngo_entry
    unset -f _ngo_env_open _ngo_env_fail _ngo_env_prepend _ngo_env_has
    return 1
}

_ngo_env_has() { # does the colon-separated list $1 hold $2?
    case ":$1:" in *":$2:"*) return 0 ;; *) return 1 ;; esac
}

_ngo_env_prepend() { # puts $2 first in the colon-separated variable $1, once
    eval "_ngo_env_list=\"\${$1-}\""
    _ngo_env_has "$_ngo_env_list" "$2" || export "$1=$2${_ngo_env_list:+:$_ngo_env_list}"
    unset _ngo_env_list
}

_ngo_env_open() {
    _ngo_root="$1"
    if [ ! -x "$_ngo_root/.venv/bin/python" ]; then
        _ngo_env_fail "there is no environment in $_ngo_root/.venv yet: run \`make build\` in $_ngo_root first"
        return 1
    fi

    # An installed Jazzy is the underlay where `make venv` found one; it wrote down which.
    if [ -f "$_ngo_root/.venv/ngo_underlay" ]; then
        _ngo_underlay="$(cat "$_ngo_root/.venv/ngo_underlay")"
    else
        _ngo_underlay=wheels
    fi
    _ngo_shell=bash
    if [ -n "${ZSH_VERSION-}" ]; then _ngo_shell=zsh; fi
    # Setup files of ROS and colcon read variables that may be unset, so `set -u` is lifted around them.
    case "$-" in *u*) _ngo_nounset=1 ;; *) _ngo_nounset= ;; esac
    set +u
    if [ "$_ngo_underlay" = wheels ] || [ "$_ngo_underlay" = kilted-wheels ]; then
        for _ngo_entry in $(echo "${AMENT_PREFIX_PATH-}" | tr : '\n'); do
            if [ "$_ngo_entry" != "$_ngo_root/.venv" ] && [ -f "$_ngo_entry/share/rclpy/package.xml" ]; then
                _ngo_env_fail "this shell has opened another ROS 2 ($_ngo_entry): use a new one, or run \`make build\` in this one"
                return 1
            fi
        done
        # Unlike bin/activate this leaves the prompt alone, and a second sourcing changes nothing.
        export VIRTUAL_ENV="$_ngo_root/.venv"
        _ngo_env_prepend AMENT_PREFIX_PATH "$VIRTUAL_ENV"
        _ngo_env_prepend CMAKE_PREFIX_PATH "$VIRTUAL_ENV"
        export ROS_VERSION=2 ROS_PYTHON_VERSION=3 ROS_DISTRO=jazzy
        [ "$_ngo_underlay" = wheels ] || export ROS_DISTRO=kilted
        # The wheels start Python a second time with their libraries on LD_LIBRARY_PATH, unless this guard says that it has
        # been done. A guard without the libraries (or with those of another environment) would leave Python without ROS.
        _ngo_env_has "${LD_LIBRARY_PATH-}" "$VIRTUAL_ENV/lib" || unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
    else
        if [ ! -f "$_ngo_underlay/setup.$_ngo_shell" ]; then
            _ngo_env_fail "the ROS 2 that .venv was made for is gone ($_ngo_underlay): run \`make clean venv build\` in $_ngo_root"
            return 1
        fi
        . "$_ngo_underlay/setup.$_ngo_shell"
        export VIRTUAL_ENV="$_ngo_root/.venv"
    fi
    _ngo_env_prepend PATH "$VIRTUAL_ENV/bin"
    export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"

    # The build itself opens only what lies below the workspace.
    if [ -n "${NGO_ENV_UNDERLAY_ONLY-}" ]; then
        :
    elif [ -f "$_ngo_root/ros_ws/install/local_setup.$_ngo_shell" ]; then
        . "$_ngo_root/ros_ws/install/local_setup.$_ngo_shell"
    else
        _ngo_env_fail "the workspace is not built yet: run \`make build\` in $_ngo_root first"
        return 1
    fi
    _ngo_env_has "$PATH" "$_ngo_root/tools" || export PATH="$PATH:$_ngo_root/tools"
    # `python -m training...`, demo and benchmarks from any folder.
    _ngo_env_has "${PYTHONPATH-}" "$_ngo_root" || export PYTHONPATH="${PYTHONPATH:+$PYTHONPATH:}$_ngo_root"
    if [ -n "$_ngo_nounset" ]; then set -u; fi
    unset _ngo_root _ngo_underlay _ngo_shell _ngo_nounset _ngo_entry
    unset -f _ngo_env_open _ngo_env_fail _ngo_env_prepend _ngo_env_has
}

if [ -n "${BASH_VERSION-}" ]; then
    _ngo_env_open "$(cd "$(dirname "${BASH_SOURCE[0]}")" >/dev/null && pwd)"
elif [ -n "${ZSH_VERSION-}" ]; then
    # eval: other shells must be able to read past zsh's own syntax.
    eval '_ngo_env_open "$(cd "$(dirname "${(%):-%x}")" >/dev/null && pwd)"'
else
    echo "env.sh: needs bash or zsh" >&2
    return 1
fi
