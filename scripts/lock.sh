#!/usr/bin/env bash
# Writes requirements/locked*.txt anew from the pins in requirements/: every package for all Pythons that we serve, with the
# hashes of its files. Needs uv (https://docs.astral.sh/uv) on PATH. Hashes of other builds of PyTorch go on as arguments.
#   scripts/lock.sh 6746dbcbeb526eb61330b76b41ff1b4eb848951103a892eeb080dfa2b264667b
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

cd "$ROOT/requirements"
command -v uv >/dev/null || die "lock: there is no uv on PATH"
whole="$(mktemp)"
trap 'rm -f "$whole"' EXIT
uv pip compile --universal --python-version 3.10 --no-python-downloads --generate-hashes --no-header --no-annotate \
    --quiet --output-file "$whole" ros.txt runtime.txt test.txt
python3 "$ROOT/scripts/split_lock.py" "$whole" "$@"
