"""Ctrl-C and SIGTERM, which end a verb where Python code runs that can be left at any line."""

import os
import signal
import threading
from types import FrameType

from mapper.core.errors import Terminated

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
