"""Checks of the machine: interpreter, C library, processors, memory, disk, places for compiled code."""

import os
import platform
import re
import shutil
import sys
import tempfile
from pathlib import Path

import mapper
from mapper.doctor.finding import Finding
from mapper.runtime.bytecode import has_bytecode

_LEAST_PYTHON = (3, 11)
_LEAST_GLIBC = (2, 35)
_LEAST_MEMORY_GB = 2.0
_LEAST_DISK_GB = 1.0
_THREADS = "OMP_NUM_THREADS"


def check_python() -> Finding:
    """Return our version and the interpreter's."""
    machine = f"{sys.platform} {platform.machine()}"
    text = f"mapper {mapper.__version__} on Python {platform.python_version()}, {machine}"
    if sys.version_info < _LEAST_PYTHON:
        return Finding("python", "failed", text, "use Python 3.11 or newer")
    return Finding("python", "well", text)


def check_glibc() -> Finding:
    """Return the C library's version; wheels are built for one and run on any later."""
    name, version = platform.libc_ver()
    text = f"{name or 'another C library than glibc'} {version}".strip()
    numbers = tuple(int(number) for number in re.findall(r"\d+", version)[:2])
    if name == "glibc" and numbers < _LEAST_GLIBC:
        return Finding(
            "glibc", "failed", f"{text}, Open3D's wheel needs 2.35", "use Debian 12, Ubuntu 22.04 or newer"
        )
    return Finding("glibc", "well", text)


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))  # a container may have fewer than the machine
    return os.cpu_count() or 1


def check_threads() -> Finding:
    """Return how many processors are available, and whether libraries start threads of their own."""
    each = os.environ.get(_THREADS, "unset")
    text = f"{processors()} processors available, {_THREADS} is {each}"
    if each != "1":
        return Finding(
            "threads", "warning", text, f"unset {_THREADS}: small matrices are slower with several"
        )
    return Finding("threads", "well", text)


def check_memory() -> Finding:
    """Return the machine's memory."""
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        return Finding("memory", "well", "this system does not report it")
    lines = re.findall(r"^(\w+): +(\d+) kB", meminfo.read_text(encoding="ascii"), re.MULTILINE)
    kilobytes = {name: int(value) for name, value in lines}
    total_gb, free_gb = (kilobytes[name] * 1024 / 1e9 for name in ("MemTotal", "MemAvailable"))
    text = f"{free_gb:.1f} GB of {total_gb:.1f} GB available"
    if free_gb < _LEAST_MEMORY_GB:
        return Finding("memory", "warning", text, "end other programs, or build with --set workers=0")
    return Finding("memory", "well", text)


def check_disk() -> Finding:
    """Return how much room there is for runs here, and for scratch files."""
    places = {"here": Path.cwd(), "scratch": Path(tempfile.gettempdir())}
    free_gb = {name: shutil.disk_usage(place).free / 1e9 for name, place in places.items()}
    text = ", ".join(f"{free_gb[name]:.1f} GB free in {place} ({name})" for name, place in places.items())
    if min(free_gb.values()) < _LEAST_DISK_GB:
        return Finding("disk", "warning", text, "make room, or choose an --out and a TMPDIR elsewhere")
    return Finding("disk", "well", text)


def check_bytecode() -> Finding:
    """Return whether the next start need not compile Python's own modules and numpy's again."""
    modules = [module for name, module in sys.modules.items() if name.split(".")[0] in ("mapper", "numpy")]
    missing = sum(not has_bytecode(module) for module in modules)
    if not missing:
        return Finding("bytecode", "well", "kept")
    why = ": PYTHONDONTWRITEBYTECODE is set" if sys.dont_write_bytecode else ""
    text = f"{missing} of {len(modules)} modules are compiled at every start{why}"
    return Finding("bytecode", "warning", text, "mapper doctor --warm keeps them, and halves the start")


def check_kernels() -> Finding:
    """Return where compiled kernels are kept, whether they can be, and how many there are by now."""
    folder, compiled = kernel_folder(), compiled_kernels()
    text = f"{len(compiled)} compiled kernels kept in {folder}"
    if not os.access(_nearest_existing(folder), os.W_OK):
        remedy = "set NUMBA_CACHE_DIR to a folder that may be written"
        return Finding("numba cache", "failed", f"{text}, which cannot be written", remedy)
    if not compiled:
        return Finding("numba cache", "warning", text, "mapper doctor --warm compiles them")
    return Finding("numba cache", "well", text)


def kernel_folder() -> Path:
    """Return the folder that keeps compiled kernels: NUMBA_CACHE_DIR, or that of this package."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(mapper.__file__).parent)


def compiled_kernels() -> set[Path]:
    """Return the kernels that are compiled, as files without the line and the version at the end."""
    return {file.with_name(file.name.rpartition("-")[0]) for file in kernel_folder().rglob("*.nbi")}


def _nearest_existing(folder: Path) -> Path:
    return next(place for place in (folder, *folder.parents) if place.exists())
