import signal
import time
from types import SimpleNamespace

import pytest

from mapper.cli import environment
from mapper.core.errors import Terminated


def frame_in(*modules):
    """Return a stack of frames, the innermost of which is in the first module."""
    frame = None
    for module in reversed(modules):
        frame = SimpleNamespace(f_globals={"__name__": module}, f_back=frame)
    return frame


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_an_interrupt_ends_python_code(number, error):
    with pytest.raises(error):
        environment.interrupt(number, frame_in("mapper.pipeline.track", "mapper.cli.build"))


@pytest.mark.parametrize("module", ["llvmlite.binding.ffi", "importlib._bootstrap", "numba.core.dispatcher"])
def test_an_interrupt_waits_for_compilers_and_imports(module, monkeypatch):
    sent = []
    monkeypatch.setattr("os.kill", lambda _, number: sent.append(number))
    environment.interrupt(signal.SIGTERM, frame_in("ctypes", module, "mapper.cli.build"))
    until = time.monotonic() + 5.0
    while not sent and time.monotonic() < until:
        time.sleep(0.01)
    assert sent == [signal.SIGTERM]
