#!/usr/bin/env bash
# Sets up, then checks style, types and behaviour. Arguments go to pytest:
#   bash scripts/test.sh                   everything, as .ci/run does
#   bash scripts/test.sh -m "not slow"     the quick loop, without the tests that take more than 5 s
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash scripts/setup.sh --dev
.venv/bin/ruff check .
.venv/bin/ruff format --check .

types=$(mktemp)
trap 'rm -f "$types"' EXIT
.venv/bin/mypy >"$types" 2>&1 & # beside the tests, which leave a processor idle now and then
status=0
.venv/bin/pytest -n auto --dist loadfile --no-loadscope-reorder "$@" || status=$? # a file's fixtures are made once
wait $! || {
  cat "$types" >&2
  status=1
}
exit "$status"
