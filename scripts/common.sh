# Functions of all build scripts: paths, the choice of the ROS 2, the display of a step. Sourced, never run.

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." >/dev/null && pwd)"
VENV="$ROOT/.venv"
LOGS="$ROOT/ros_ws/log/steps"
PYTHON_VERSIONS="3.10 to 3.13"

# In a shell that has opened env.sh, `python3` is .venv's own, which can make no new .venv.
PATH="$(printf '%s' "$PATH" | tr : '\n' | grep -vxF "$VENV/bin" | paste -sd :)"

say() { printf '[ngo] %s\n' "$*"; }

die() {
    printf '[ngo] FAILED: %s\n' "$*" >&2
    exit 1
}

one_at_a_time() { # a second make in this checkout waits here, instead of installing into the same folder
    exec 9<"$ROOT/requirements"
    flock 9
}

python_fits() { # is $1 a Python of a version that we serve?
    "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

is_wheels() { # is the ROS 2 $1 one of those from wheels?
    [[ "$1" =~ ^(kilted-)?wheels$ ]]
}

# Prints the prefix of the installed ROS 2 Jazzy to use, or `wheels` or `kilted-wheels`. In this order: what make was told
# (ROS=), what this shell has sourced, what .venv was made for, what is installed.
find_underlay() {
    local prefix entries sourced=
    IFS=: read -ra entries <<<"${AMENT_PREFIX_PATH-}"
    for prefix in "${entries[@]}"; do
        # The wheels have no setup.bash in their prefix, so an opened env.sh is not taken for an installed ROS 2.
        if [ -z "$sourced" ] && [ -f "$prefix/share/rclpy/package.xml" ] && [ -f "$prefix/setup.bash" ]; then
            sourced="$prefix"
        fi
    done
    if [ -n "$sourced" ] && [ "${ROS_DISTRO-}" != jazzy ]; then
        die "ROS 2 '${ROS_DISTRO-}' is sourced in this shell, this project needs 'jazzy'; use a shell without it"
    elif [ -n "$sourced" ] && [ -n "${ROS-}" ] && [ "$ROS" != "$sourced" ]; then
        die "ROS=$ROS was asked for, but this shell has sourced $sourced; use a shell without it"
    elif [ -n "${ROS-}" ] && ! is_wheels "$ROS" && [ ! -f "$ROS/setup.bash" ]; then
        die "ROS=$ROS was asked for, but there is no $ROS/setup.bash; give the prefix of an installed ROS 2 Jazzy, 'wheels' or 'kilted-wheels'"
    elif [ -n "${ROS-}" ]; then
        echo "$ROS"
    elif [ -n "$sourced" ]; then
        echo "$sourced"
    elif [ -s "$VENV/ngo_underlay" ]; then
        cat "$VENV/ngo_underlay"
    elif [ -f /opt/ros/jazzy/setup.bash ]; then
        echo /opt/ros/jazzy
    else
        echo wheels
    fi
}

# Prints what .venv is for: `lidar`, without PyTorch and the simulators, or `all`. What make was told (FOR=) comes before
# what .venv was made for.
find_purpose() {
    local purpose="${FOR-}"
    [ -n "$purpose" ] || purpose="$(cat "$VENV/ngo_for" 2>/dev/null || echo all)"
    case "$purpose" in
    all | lidar) echo "$purpose" ;;
    *) die "FOR=$purpose was asked for; expected 'lidar' (no PyTorch, no simulators) or 'all'" ;;
    esac
}

# Prints the interpreter to make .venv with: $PYTHON if given, python3 if it fits, else the newest on PATH that does.
# An installed ROS 2 has compiled parts for the system's own python3, so that is the one there.
find_python() {
    local candidate
    if [ -n "${PYTHON-}" ]; then
        echo "$PYTHON"
        return
    fi
    if ! is_wheels "$1" && [ -x /usr/bin/python3 ]; then
        echo /usr/bin/python3
        return
    fi
    for candidate in python3 python3.13 python3.12 python3.11 python3.10; do
        if command -v "$candidate" >/dev/null && python_fits "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    command -v python3 || true
}

# step NAME COMMAND...: runs the command with its output in a log; shows that it goes on; on failure names the step, the
# log and the log's last lines. V=1 shows everything.
step() {
    local name="$1" log began=$SECONDS shown=0 seconds pid
    shift
    mkdir -p "$LOGS"
    log="$LOGS/$(echo "$name" | tr -cs 'a-zA-Z0-9\n' '-').log"
    say "$name ..."
    if [ -n "${V-}" ]; then
        if ! "$@" 2>&1 | tee "$log"; then die "$name; the whole log: $log"; fi
        return
    fi
    "$@" >"$log" 2>&1 &
    pid=$!
    # An interrupted make must not leave an installer at work behind it.
    trap 'kill "$pid" 2>/dev/null; exit 130' INT TERM
    while kill -0 "$pid" 2>/dev/null; do
        sleep 1
        seconds=$((SECONDS - began))
        if [ -t 1 ]; then
            printf '\r\033[K[ngo]   %3d s  %s' "$seconds" "$(tail -n 1 "$log" | tr -d '\r' | cut -c 1-90)"
        elif [ $((seconds - shown)) -ge 20 ]; then
            shown=$seconds
            say "  $seconds s  $(tail -n 1 "$log" | tr -d '\r' | cut -c 1-90)"
        fi
    done
    if [ -t 1 ]; then printf '\r\033[K'; fi
    trap - INT TERM
    seconds=$((SECONDS - began))
    if ! wait "$pid"; then
        tail -n 25 "$log" | sed 's/^/    /' >&2
        die "$name, after $seconds s; the whole log: $log"
    fi
    say "$name: done in $seconds s"
}
