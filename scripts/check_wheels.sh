#!/usr/bin/env bash
# Checks that pip finds a wheel of every dependency, core and with all extras, for the supported interpreters and
# machines; nothing is installed or built. Missing wheels are named, and the exit status is then 1.
# usage: bash scripts/check_wheels.sh [PYTHON_VERSION…]
#   PYTHON_VERSION   such as 3.13; without, 3.11 3.12 3.13
# It needs a network, for PyPI's metadata. scripts/smoke_test_wheel.sh runs the package, where there is an interpreter.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

export MACOSX_DEPLOYMENT_TARGET=14.0 # KISS-Matcher's oldest
platforms="x86_64-manylinux_2_35 aarch64-manylinux_2_35 aarch64-apple-darwin"
[ $# -gt 0 ] || set -- 3.11 3.12 3.13

place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
# pip itself would take this machine's markers for another's
"$place/venv/bin/python" -m pip install --quiet --disable-pip-version-check uv

status=0
for version in "$@"; do
  for platform in $platforms; do
    for extra in "" "--extra all"; do
      # shellcheck disable=SC2086 # two words
      if "$place/venv/bin/uv" pip compile --quiet --no-header --no-annotate --only-binary :all: \
        --python-version "$version" --python-platform "$platform" $extra pyproject.toml \
        >"$place/found" 2>"$place/said"; then
        printf 'ok    Python %s  %-22s  %-5s  %d packages\n' "$version" "$platform" "${extra:+[all]}" \
          "$(wc -l <"$place/found")"
      else
        status=1
        printf 'FAIL  Python %s  %-22s  %-5s\n' "$version" "$platform" "${extra:+[all]}"
        sed 's/^/      /' "$place/said"
      fi
    done
  done
done
exit "$status"
