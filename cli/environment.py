"""Environment variables that libraries read when they are loaded."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mapper.runtime.progress import Progress


def prepare_environment() -> None:
    """Leave the threads to us, and give compiled code a place where it may be kept."""
    import mapper
    from mapper.runtime.extras import one_thread_per_library

    one_thread_per_library()
    os.environ.setdefault("RUST_LOG", "off")  # Rerun would print lines of its own beside our errors
    package = Path(mapper.__file__).parent
    if not os.access(package, os.W_OK):  # numba keeps its code beside ours, and refuses to work if it cannot
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mapper" / "numba"
        os.environ.setdefault("NUMBA_CACHE_DIR", str(cache))


def note_compilation(progress: "Progress") -> None:
    """Say that a verb takes longer this time, if numba has not compiled our kernels before."""
    import mapper

    cache = os.environ.get("NUMBA_CACHE_DIR") or Path(mapper.__file__).parent
    if next(Path(cache).rglob("*.nbi"), None) is None:
        progress.note("first run here: the kernels are compiled once, which takes about a minute")
