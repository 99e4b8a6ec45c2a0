#!/usr/bin/env bash
# Ends where .venv was made for a lidar alone, with a line about what to do.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/common.sh"

purpose="$(find_purpose)"
[ "$purpose" = all ] || die "this needs PyTorch and the simulators, and .venv has what a lidar needs: run make venv FOR=all"
