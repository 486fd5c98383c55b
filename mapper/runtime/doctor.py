"""Checks of a machine and an installation: a line for the machine, the kernels, and each library."""

import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

import mapper
from mapper.core.errors import DataError
from mapper.runtime.extras import DISTRIBUTION, install_line
from mapper.runtime.kernels import compiled_kernels, kernel_folder
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress

_LEAST_GB = 2.0
PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
"""System libraries that our wheels need, without libc, and the Debian packages that hold them."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Attributes:
        name: Name of the check.
        verdict: "warning" is worth knowing; "failed" keeps some verb from working.
        detail: Result in one line.
        remedy: Instruction to the user; empty when all is well.
    """

    name: str
    verdict: Literal["well", "warning", "failed"]
    detail: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if (self.verdict == "well") == bool(self.remedy):
            raise DataError(f"{self.name}: verdict {self.verdict!r} with remedy {self.remedy!r}")


def check_machine() -> Finding:
    """Return our version, the interpreter's, the number of processors, and what memory and disk are free."""
    free_gb = {"disk": shutil.disk_usage(Path.cwd()).free / 1e9}
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        lines = re.findall(r"^(\w+): +(\d+) kB", meminfo.read_text(encoding="ascii"), re.MULTILINE)
        free_gb["memory"] = {name: int(value) for name, value in lines}["MemAvailable"] * 1024 / 1e9
    text = (
        f"mapper {mapper.__version__} on Python {platform.python_version()}, {sys.platform} "
        f"{platform.machine()}, {processors()} processors, "
        f"{', '.join(f'{free:.1f} GB of {name} free' for name, free in free_gb.items())}"
    )
    if min(free_gb.values()) < _LEAST_GB:
        remedy = "end other programs, choose an --out elsewhere, or build with --set workers=0"
        return Finding("machine", "warning", text, remedy)
    if os.environ.get("OMP_NUM_THREADS", "1") != "1":
        return Finding("machine", "warning", text, "unset OMP_NUM_THREADS: small matrices are slower with it")
    return Finding("machine", "well", text)


def check_kernels() -> Finding:
    """Return where compiled kernels are kept, whether they can be, and how many there are by now."""
    folder, compiled = kernel_folder(), compiled_kernels()
    text = f"{len(compiled)} compiled kernels kept in {folder}"
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    if not os.access(existing, os.W_OK):
        remedy = "set NUMBA_CACHE_DIR to a folder that may be written"
        return Finding("numba cache", "failed", f"{text}, which cannot be written", remedy)
    if not compiled:
        return Finding("numba cache", "warning", text, "mapper doctor --warm compiles them")
    return Finding("numba cache", "well", text)


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))  # a container may have fewer than the machine
    return os.cpu_count() or 1


_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[[\w,]*\])?(>=(?P<least>[\d.]+))?")
_EXTRA = re.compile(r"""extra == ['"](?P<name>[\w-]+)['"]""")
_MISSING_OBJECT = re.compile(r"(?P<object>lib[\w.+-]+\.so[\w.]*): cannot open shared object file")
MODULES = {
    "foxglove-sdk": "foxglove",
    "opencv-contrib-python-headless": "cv2",
    "protobuf": "google.protobuf",
    "rerun-sdk": "rerun",
}
"""Names in ``import`` of libraries that have another one in pip."""
_TIMEOUT_S = 120.0  # Open3D takes 10 s on an idle machine


@dataclass(frozen=True, slots=True)
class Requirement:
    """A library that this package names.

    Attributes:
        name: Its name in pip.
        least: Its least version.
        extra: The extra that brings it; None if all need it.
    """

    name: str
    least: str = "0"
    extra: str | None = None


def examine(*, progress: Progress = SILENT) -> list[Finding]:
    """Check the machine, then import every library in a process of its own, one per processor at a time."""
    findings, wanted = [check_machine(), check_kernels()], requirements()
    with progress.stage("try") as report:
        for done, finding in enumerate(ordered_map(check_library, wanted, workers=processors()), start=1):
            findings.append(finding)
            report(done, len(wanted))
    return findings


def requirements() -> list[Requirement]:
    """Return every library that this package needs or can use; none where the package is not installed."""
    found: dict[str, Requirement] = {}
    try:
        lines = metadata.requires(DISTRIBUTION) or ()
    except metadata.PackageNotFoundError:
        return []
    for line in lines:
        match, extra = _REQUIREMENT.match(line), _EXTRA.search(line)
        if match is None or (extra is not None and extra["name"] in {"all", "dev"}):
            continue
        name = match["name"]
        found.setdefault(name, Requirement(name, match["least"] or "0", extra and extra["name"]))
    return list(found.values())


def check_library(wanted: Requirement) -> Finding:
    """Return whether a library is installed, of at least a version, and can be imported."""
    name, again = wanted.name, f"pip install '{wanted.name}>={wanted.least}'"
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        if wanted.extra is not None:
            return Finding(name, "well", f"optional, not installed: {install_line(wanted.extra)}")
        return Finding(name, "failed", "not installed", again)
    if _numbers(version) < _numbers(wanted.least):
        return Finding(name, "failed", f"{version}, want at least {wanted.least}", again)
    again = f"pip install --force-reinstall --no-cache-dir '{name}=={version}'"
    module = MODULES.get(name, name.replace("-", "_"))
    command = [sys.executable, "-c", f"import {module}"]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return Finding(name, "failed", f"{version}, not imported after {_TIMEOUT_S:.0f} s", again)
    if ended.returncode == 0:
        return Finding(name, "well", version)
    said = (ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"])[-1]
    if missing := _MISSING_OBJECT.search(said):
        wanted_object = missing["object"]
        package = PACKAGES.get(wanted_object)
        again = (
            f"sudo apt-get install {package}"
            if package
            else f"find the package with: apt-file search {wanted_object}"
        )
    return Finding(name, "failed", f"{version}, {said}", again)


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", version)[:3]]
