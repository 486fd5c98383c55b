#!/usr/bin/env bash
# Builds the wheel and tests it in an empty environment: synth, build, export and eval of both sensors' logs.
# usage: bash scripts/smoke_test_wheel.sh [--extras NAMES] [PYTHON…]
#   --extras NAMES   install these extras too, such as all or viewer,mesh; without, core alone
#   PYTHON           interpreters to try, one after the other; without, python3
# Takes a few minutes for each interpreter, most of it for pip and for numba. SMOKE_FOLDER keeps what it makes.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'smoke test: %s\n' "$*" >&2; }
fail() {
  say "$*"
  exit 1
}

extras=""
if [ "${1:-}" = --extras ]; then
  extras="[${2:?want names of extras}]"
  shift 2
fi
[ $# -gt 0 ] || set -- python3

if [ -n "${SMOKE_FOLDER:-}" ]; then
  place=$SMOKE_FOLDER
  mkdir -p "$place"
else
  place=$(mktemp -d)
  trap 'rm -rf "$place"' EXIT
fi

# setuptools leaves what it builds in the tree, and puts what an older build left there into the wheel.
rm -rf "$place/tree" "$place/dist"
mkdir "$place/tree"
git ls-files -z --cached --others --exclude-standard | tar --null --files-from=- -c | tar -x -C "$place/tree"
"$1" -m venv "$place/build"
"$place/build/bin/python" -m pip install --quiet --quiet --disable-pip-version-check build
"$place/build/bin/python" -m build --outdir "$place/dist" "$place/tree" >"$place/build.log" 2>&1 ||
  fail "python -m build failed: $(tail -n 3 "$place/build.log")"
wheel=$(echo "$place"/dist/*.whl)
say "$(basename "$wheel"): $(du -k "$wheel" | cut -f1) kB"

# Runs the installed program in a clean environment, away from the source tree.
mapper() {
  (cd "$run" && env -i PATH=/usr/bin:/bin HOME="$run" LANG=C.UTF-8 "$venv/bin/mapper" "$@") ||
    fail "failed: mapper $*"
}

kernels() { find "$venv" -path '*/mapper/*' -name '*.nbc' | sort; }

# Succeeds if the program ends with status 1 and a line that has these words.
refuses() {
  local words=$1 said
  shift
  said=$(cd "$run" && env -i PATH=/usr/bin:/bin HOME="$run" "$venv/bin/mapper" "$@" 2>&1) &&
    fail "did not refuse: mapper $*"
  case "$said" in
    *Traceback*) fail "a traceback: mapper $*: $said" ;;
    *"$words"*) ;;
    *) fail "mapper $*: said '$said', want '$words'" ;;
  esac
}

for python in "$@"; do
  version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  venv=$place/venv-$version run=$place/run-$version
  rm -rf "$venv" "$run"
  mkdir "$run"
  "$python" -m venv "$venv"
  "$venv/bin/python" -m pip install --quiet --quiet --disable-pip-version-check --only-binary :all: "$wheel$extras"
  [ "$python" != "$1" ] || [ -n "$(kernels)" ] || fail "the wheel has no compiled kernels"
  mapper doctor --warm >"$run/warm.txt" # those of other interpreters
  warm=$(kernels)
  for sensor in rgbd lidar; do
    mapper synth "$sensor" --sensor "$sensor" --seconds 2 --quiet
    mapper build "$sensor" --out "run_$sensor" --quiet
    mapper export "run_$sensor" --as octomap --out "$sensor.bt" --quiet
    mapper export "run_$sensor" --as nav2 --out "nav2_$sensor" --quiet
    mapper eval "run_$sensor" >"$run/eval_$sensor.txt"
    grep -q ATE "$run/eval_$sensor.txt" || fail "mapper eval run_$sensor: no ATE"
    mapper report "run_$sensor" --out "$sensor.html" --quiet
  done
  [ "$(kernels)" = "$warm" ] || fail "builds compiled more kernels: $(diff <(echo "$warm") <(kernels))"
  if [ -z "$extras" ]; then
    refuses "[viewer]" view run_rgbd
    refuses "[mesh]" export run_rgbd --as mesh --out mesh.ply
    refuses "[peers]" build lidar --out kiss --set odometry.kind=kiss-icp
    refuses "[peers]" register lidar/velodyne/000000.npy lidar/velodyne/000001.npy --method ndt --out ndt
  elif [ "$extras" = "[all]" ]; then
    mapper export run_rgbd --as mesh --out mesh.ply
    mapper compare lidar --out compared --quiet
  fi
  mapper doctor >"$run/doctor.txt"
  say "Python $version with core${extras:+ and $extras}: works"
done
