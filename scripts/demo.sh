#!/usr/bin/env bash
# Sets up, then makes a synthetic log and builds a map from it.
set -euo pipefail
here=$(dirname "${BASH_SOURCE[0]}")
bash "$here/setup.sh"
exec "$here/../.venv/bin/mapper" demo "$@"
