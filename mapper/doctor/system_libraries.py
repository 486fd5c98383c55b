"""Shared objects that the wheels expect of the system, and the Debian packages that hold them."""

import ctypes
from collections.abc import Iterable

from mapper.doctor.finding import Finding

PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
"""System libraries that ``readelf -d`` names in our wheels, without libc and those that wheels bring."""


def check_system_libraries(wanted: Iterable[str] = tuple(PACKAGES)) -> Finding:
    """Return which shared objects the loader does not find."""
    wanted = list(wanted)
    missing = [name for name in wanted if not _loads(name)]
    if missing:
        return Finding("system libraries", "failed", f"missing {', '.join(missing)}", apt_line(missing))
    return Finding("system libraries", "well", f"all {len(wanted)} are there")


def apt_line(missing: Iterable[str]) -> str:
    """Return the command that brings shared objects to Debian or Ubuntu."""
    missing = list(missing)
    known = [PACKAGES[name] for name in missing if name in PACKAGES]
    if len(known) < len(missing):
        return f"find the package with: apt-file search {missing[0]}"
    return f"sudo apt-get install {' '.join(known)}"


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True
