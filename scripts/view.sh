#!/usr/bin/env bash
# Installs the live view into .venv, which make venv leaves out. Does nothing when it is there.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"
one_at_a_time

key="$(sha256sum <"$ROOT/requirements/view.txt")"
if [ "$(cat "$VENV/ngo_view_key" 2>/dev/null)" = "$key" ]; then
    exit 0
fi
cd "$ROOT"
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH
step "install the live view (230 MB to download, once)" "$VENV/bin/python" -m pip install \
    --disable-pip-version-check -r requirements/view.txt
echo "$key" >"$VENV/ngo_view_key"
