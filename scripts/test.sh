#!/usr/bin/env bash
# Sets up, then checks style, types and behaviour. Arguments go to pytest:
#   bash scripts/test.sh                   everything, as .ci/run does
#   bash scripts/test.sh -m "not slow"     the quick loop, without the tests that take more than 5 s
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

types=$(mktemp)
check_types() { # while kernels are compiled, the last of them by one process
  until [ -e .venv/.libraries ]; do sleep 1; done
  .venv/bin/mypy
}
check_types >"$types" 2>&1 &
checking=$!
trap 'kill "$checking" 2>/dev/null || true; rm -f "$types"' EXIT
bash scripts/setup.sh --dev
.venv/bin/ruff check .
.venv/bin/ruff format --check .

status=0
.venv/bin/pytest -n auto --dist loadfile --no-loadscope-reorder "$@" || status=$? # a file's fixtures are made once
wait "$checking" || {
  cat "$types" >&2
  status=1
}
exit "$status"
