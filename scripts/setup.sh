#!/usr/bin/env bash
# Makes .venv, installs the project with all its extras, compiles the kernels; the second time it does nothing.
# usage: bash scripts/setup.sh [--dev]
#   --dev   adds what the tests need, and axe-core if npm is installed
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'setup: %s\n' "$*" >&2; }
fail() {
  say "$*"
  exit 1
}

extra=all
wheels="numpy cv2 numba gtsam matplotlib foxglove mcap open3d kiss_icp kiss_matcher rerun"
for option in "$@"; do
  case "$option" in
    --dev) extra=dev ;;
    *) fail "unknown option $option; want --dev" ;;
  esac
done
venv=.venv
stamp="$venv/.installed[$extra]"

# Installs Debian packages if we may; otherwise says exactly what to type.
need_packages() {
  local as_root=()
  if [ "$(id -u)" != 0 ]; then
    if sudo -n true 2>/dev/null; then
      as_root=(sudo -n)
    else
      fail "missing system packages; run: sudo apt-get install -y $*    and then this again"
    fi
  fi
  command -v apt-get >/dev/null || fail "missing system packages ($*), and there is no apt-get to install them"
  say "installing $*"
  "${as_root[@]}" apt-get update -qq >&2
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
    apt-get install -y -qq --no-install-recommends "$@" >&2 || fail "apt-get could not install: $*"
}

is_new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
  local name
  for name in python3 python3.11 python3.12 python3.13 python3.14; do
    if command -v "$name" >/dev/null && is_new_enough "$name"; then
      command -v "$name"
      return
    fi
  done
  return 1
}

make_venv() {
  local python version
  python=$(find_python) || {
    need_packages python3 python3-venv
    python=$(find_python) || fail "want Python 3.11 or newer; $(python3 --version 2>&1) is all there is"
  }
  if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then # Debian ships them apart
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    need_packages "python$version-venv"
  fi
  say "making $venv with $("$python" --version)"
  rm -rf "$venv"
  "$python" -m venv "$venv"
}

# Prints the first shared library that a wheel expects from the system and does not find.
missing_library() {
  # shellcheck disable=SC2086 # one word per wheel
  "$venv/bin/python" - $wheels <<'PYTHON'
import importlib.util
import re
import sys

for name in sys.argv[1:]:
    if importlib.util.find_spec(name) is None:
        continue
    try:
        importlib.import_module(name)
    except (ImportError, OSError) as error:
        found = re.search(r"(lib\S+\.so[.\d]*): cannot open shared object file", str(error))
        print(found[1] if found else f"{name}: {error}")
        break
PYTHON
}

package_of() {
  case "$1" in
    libgomp.so.*) echo libgomp1 ;;
    libstdc++.so.*) echo libstdc++6 ;;
    libgcc_s.so.*) echo libgcc-s1 ;;
    libGL.so.*) echo libgl1 ;;
    libEGL.so.*) echo libegl1 ;;
    libX11.so.*) echo libx11-6 ;;
    libudev.so.*) echo libudev1 ;;
    libidn2.so.*) echo libidn2-0 ;;
    libusb-1.0.so.*) echo libusb-1.0-0 ;;
    libglib-2.0.so.* | libgthread-2.0.so.*) echo libglib2.0-0 ;;
    libz.so.*) echo zlib1g ;;
    libatomic.so.*) echo libatomic1 ;;
    *) return 1 ;;
  esac
}

install_missing_libraries() {
  local library package before=""
  while library=$(missing_library) && [ -n "$library" ]; do
    package=$(package_of "$library") || fail "cannot load $library"
    [ "$package" != "$before" ] || fail "cannot load $library, although $package is installed"
    need_packages "$package"
    before=$package
  done
}

[ -x "$venv/bin/python" ] && is_new_enough "$venv/bin/python" || make_venv
"$venv/bin/python" -m pip --version >/dev/null 2>&1 || "$venv/bin/python" -m ensurepip >/dev/null

# numba notices a changed kernel, but not a changed kernel that another module's kernel calls.
kernels=$(grep -rl njit mapper --include='*.py' | sort | xargs cat | sha256sum)
stale=""
if [ "$(cat "$venv/.kernels" 2>/dev/null)" != "$kernels" ]; then
  find mapper -name '*.nb[ic]' -delete
  stale=yes
fi

compile_kernels() {
  if "$venv/bin/mapper" doctor --warm >&2; then
    printf '%s\n' "$kernels" >"$venv/.kernels"
  else
    say "the kernels could not be compiled; the first build will do it, or say why"
  fi
}

# Most of what the wheels bring is never imported; Python keeps the bytecode of what is.
install() {
  "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile "$@" >&2
  install_missing_libraries
}

# The pages' tests of accessibility are skipped without it.
install_axe() {
  command -v npm >/dev/null || return 0
  npm install --silent --no-save --prefix "$venv/share/axe" axe-core@4.14.1 >&2 || say "npm could not install axe-core"
}

# The folder counts as well: an editable install and its scripts name it.
want=$( (pwd; "$venv/bin/python" --version; cat pyproject.toml scripts/setup.sh) | sha256sum)
if [ "$(cat "$stamp" 2>/dev/null)" != "$want" ]; then
  if [ -n "$(find "$venv" -name 'mapper-0.1.0.dist-info' -print -quit)" ]; then # its name until 0.2
    "$venv/bin/python" -m pip uninstall --quiet --yes mapper >&2
  fi
  rm -f "$venv/.libraries" # tells scripts/test.sh that all are there, while the kernels are compiled
  say "installing the project"
  MAPPER_KERNELS=0 install --editable . # compiled below, beside the sources
  compile_kernels &
  say "installing its extras [$extra]"
  install "octree-mapper[$extra]"
  touch "$venv/.libraries"
  [ "$extra" != dev ] || install_axe
  wait
  printf '%s\n' "$want" >"$stamp"
elif [ -n "$stale" ]; then
  compile_kernels
fi
