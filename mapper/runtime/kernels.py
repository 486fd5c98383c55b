"""Compiled kernels as numba keeps them: where they are, and whether they are those of this package."""

import os
from contextlib import suppress
from pathlib import Path
from zlib import crc32

import mapper
from mapper.runtime.progress import Progress

_MODULES = "modules.crc"


def kernel_folder() -> Path:
    """Return the folder that keeps compiled kernels: NUMBA_CACHE_DIR, or that of this package."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(mapper.__file__).parent)


def compiled_kernels() -> set[Path]:
    """Return the kernels that are compiled, as files without the line and the version at the end."""
    return {file.with_name(file.name.rpartition("-")[0]) for file in kernel_folder().rglob("*.nbi")}


def note_compilation(progress: Progress) -> None:
    """Say that a job takes longer this time, if numba has not compiled our kernels before."""
    if not compiled_kernels():
        progress.note("first run here: the kernels are compiled once, which takes about a minute")


def drop_stale_kernels() -> None:
    """Remove the kernels that were compiled before a module came or went.

    An index of numba names the classes of arguments by their modules, and it is read before the times of the
    source files are compared: after an upgrade it would fail to import what is no longer there.
    """
    package = Path(mapper.__file__).parent
    modules = sorted(str(file.relative_to(package)) for file in package.rglob("*.py"))
    names = str(crc32("\n".join(modules).encode()))
    folder = kernel_folder() / "__pycache__"
    mark = folder / _MODULES
    with suppress(OSError):  # a folder that cannot be written keeps no kernels either
        if mark.exists() and mark.read_text() == names:
            return
        ours = {Path(module).stem for module in modules}  # other packages' kernels may lie beside them
        for index in kernel_folder().rglob("*.nbi"):
            if index.name.partition(".")[0] in ours:
                index.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        mark.write_text(names)
