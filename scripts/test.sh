#!/usr/bin/env bash
# Sets up, then checks style, types and behaviour. Arguments go to pytest:
#   bash scripts/test.sh                   everything, as .ci/run does
#   bash scripts/test.sh -m "not slow"     the quick loop, without the tests that take more than 5 s
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Builds a second of a sensor's log, for which numba compiles most kernels.
compile_kernels_for() {
  local place
  place=$(mktemp -d)
  .venv/bin/mapper synth "$place/log" --sensor "$1" --seconds 1 --quiet &&
    .venv/bin/mapper build "$place/log" --out "$place/run" --quiet ||
    echo "test: the build that compiles kernels for $1 failed; a test will say why" >&2
  rm -r "$place"
}

PIP_COMPILE=0 bash scripts/setup.sh --dev # most of what the wheels bring is never imported
.venv/bin/ruff check .
.venv/bin/ruff format --check .
if [ -n "$(find mapper -name '*.nbi' -print -quit)" ]; then
  .venv/bin/mypy
else # compiled here, kernels are not compiled by every worker of pytest
  { .venv/bin/mypy && compile_kernels_for lidar; } &
  types=$!
  compile_kernels_for rgbd
  wait "$types"
fi
.venv/bin/pytest -n auto --dist loadfile --no-loadscope-reorder "$@" # a file's fixtures are made once
