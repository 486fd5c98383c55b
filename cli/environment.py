"""What a process needs before a verb runs: variables that libraries read, and handlers of signals."""

import os
import signal
import threading
from pathlib import Path
from types import FrameType

from mapper.core.errors import Terminated


def prepare_environment() -> None:
    """Leave the threads to us, and give compiled code a place where it may be kept."""
    import mapper
    from mapper.runtime.extras import one_thread_per_library
    from mapper.runtime.kernels import drop_stale_kernels

    one_thread_per_library()
    os.environ.setdefault("RUST_LOG", "off")  # Rerun would print lines of its own beside our errors
    package = Path(mapper.__file__).parent
    if not os.access(package, os.W_OK):  # numba keeps its code beside ours, and refuses to work if it cannot
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mapper"
        os.environ.setdefault("NUMBA_CACHE_DIR", str(cache / "numba"))
    drop_stale_kernels()


_UNSAFE = frozenset({"importlib", "llvmlite", "numba"})
"""Packages whose frames no exception may leave: in LLVM's callbacks it ends the process, in the import of a
compiled module it becomes a SystemError."""
_AGAIN_S = 0.05


def handle_interrupts() -> None:
    """Raise KeyboardInterrupt at Ctrl-C, and Terminated at SIGTERM, in the main thread."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise for a signal; in a module that cannot take an exception it is sent again a little later."""
    if _is_unsafe(frame):
        timer = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
        timer.daemon = True
        timer.start()
        return
    raise Terminated("SIGTERM") if number == signal.SIGTERM else KeyboardInterrupt


def _is_unsafe(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] in _UNSAFE:
            return True
        frame = frame.f_back
    return False
