#!/usr/bin/env bash
# Writes requirements/locked*.txt anew from the pins in requirements/: every package for all Pythons that we serve, with the
# hashes of its files. Needs uv (https://docs.astral.sh/uv) on PATH. Hashes of other builds of PyTorch go on as arguments.
#   scripts/lock.sh 6746dbcbeb526eb61330b76b41ff1b4eb848951103a892eeb080dfa2b264667b
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

cd "$ROOT/requirements"
command -v uv >/dev/null || die "lock: there is no uv on PATH"
made="$(mktemp -d)"
trap 'rm -rf "$made"' EXIT
compile() { # OUTPUT REQUIREMENTS...
    uv pip compile --universal --python-version 3.10 --no-python-downloads --no-header --no-annotate --quiet \
        --output-file "$@"
}
compile "$made/whole" --generate-hashes ros.txt runtime.txt test.txt
compile "$made/lidar" ros.txt lidar.txt
compile "$made/kilted" --generate-hashes ros_kilted.txt
python3 "$ROOT/scripts/split_lock.py" "$made/whole" "$made/lidar" "$made/kilted" "$@"
