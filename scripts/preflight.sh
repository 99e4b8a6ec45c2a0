#!/usr/bin/env bash
# Checks the machine's tools before anything is installed. Prints one line for each missing tool.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

missing=0
lack() {
    printf '[ngo] missing: %s\n' "$*" >&2
    missing=1
}

underlay="$(find_underlay)"
python="$(find_python "$underlay")"

[ "$(uname -s)" = Linux ] || lack "Linux: this is $(uname -s), for which there are no ROS 2 wheels"
for tool in g++ cmake git make; do
    command -v "$tool" >/dev/null || lack "$tool (Debian, Ubuntu: apt-get install $tool)"
done
if command -v cmake >/dev/null; then
    version="$(cmake --version | head -n 1 | grep -oE '[0-9]+\.[0-9]+' | head -n 1)"
    if [ "$(printf '3.19\n%s\n' "$version" | sort -V | head -n 1)" != 3.19 ]; then
        lack "cmake 3.19 or newer: this is $version"
    fi
fi

if [ -z "$python" ]; then
    lack "Python $PYTHON_VERSIONS: there is no python3 on PATH (Debian, Ubuntu: apt-get install python3 python3-venv python3-dev)"
elif ! command -v "$python" >/dev/null; then
    lack "Python $PYTHON_VERSIONS: PYTHON=$python is no program"
elif ! python_fits "$python"; then
    lack "Python $PYTHON_VERSIONS: $python is $("$python" -V 2>&1); give another one with make PYTHON=..."
else
    "$python" -c 'import venv, ensurepip' 2>/dev/null ||
        lack "the venv module of $python (Debian, Ubuntu: apt-get install python3-venv)"
    headers="$("$python" -c 'import sysconfig; print(sysconfig.get_paths()["include"])')"
    [ -f "$headers/Python.h" ] ||
        lack "the C headers of $python, which messages are compiled with (Debian, Ubuntu: apt-get install python3-dev)"
    if ! is_wheels "$underlay" && ! bash -c ". '$underlay/setup.bash' && '$python' -c 'import rclpy'" >/dev/null 2>&1; then
        lack "a Python that the ROS 2 in $underlay works with: '$python' cannot import rclpy there (make PYTHON=..., or ROS=wheels)"
    fi
fi

if [ ! -d "$VENV" ]; then
    free_mib="$(df -Pm "$ROOT" | awk 'NR == 2 {print $4}')"
    need_mib=4096
    [ "$(find_purpose)" = all ] || need_mib=1024
    [ "$free_mib" -ge "$need_mib" ] || lack "$need_mib MiB of free disk space for .venv: $ROOT has $free_mib MiB"
fi

[ "$missing" = 0 ] || die "the tools listed above are missing"
