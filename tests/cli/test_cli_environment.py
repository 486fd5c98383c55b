"""What the command line tells numba and OpenCV, and what it asks of them."""

import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from mapper.cli.environment import interrupt
from mapper.core.errors import Terminated
from mapper.runtime.kernels import drop_stale_kernels, note_compilation


def test_compilation_is_noted_until_numba_has_kept_its_code(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    notes = []
    progress = SimpleNamespace(note=notes.append)
    note_compilation(progress)
    assert notes == ["first run here: the kernels are compiled once, which takes about a minute"]
    (tmp_path / "mapper_0123").mkdir()
    (tmp_path / "mapper_0123" / "kernels.cast_rays-155.py311.nbi").touch()
    note_compilation(progress)
    assert len(notes) == 1


def test_opencv_starts_no_threads_unless_the_user_says_so():
    script = (
        "from mapper.cli.environment import prepare_environment; prepare_environment();"
        "import cv2; print(cv2.getNumThreads())"
    )
    for given, threads in (({}, "1"), ({"OPENCV_FOR_THREADS_NUM": "2"}, "2")):
        clean = {name: value for name, value in os.environ.items() if name != "OPENCV_FOR_THREADS_NUM"}
        done = subprocess.run(
            [sys.executable, "-c", script], env=clean | given, capture_output=True, text=True, check=True
        )
        assert done.stdout.strip() == threads


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
        interrupt(number, frame_in("mapper.pipeline.track", "mapper.cli.build"))


@pytest.mark.parametrize("module", ["llvmlite.binding.ffi", "importlib._bootstrap", "numba.core.dispatcher"])
def test_an_interrupt_waits_for_compilers_and_imports(module, monkeypatch):
    sent = []
    monkeypatch.setattr("os.kill", lambda _, number: sent.append(number))
    interrupt(signal.SIGTERM, frame_in("ctypes", module, "mapper.cli.build"))
    until = time.monotonic() + 5.0
    while not sent and time.monotonic() < until:
        time.sleep(0.01)
    assert sent == [signal.SIGTERM]


def test_kernels_of_other_modules_are_dropped(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    index = tmp_path / "mapper_0123" / "kernels.cast_rays-155.py311.nbi"
    index.parent.mkdir()
    index.touch()
    foreign = tmp_path / "other_0123" / "solver_of_another_package.step-7.py311.nbi"
    foreign.parent.mkdir()
    foreign.touch()
    drop_stale_kernels()  # nothing says what these were compiled with
    assert not index.exists()
    index.touch()
    drop_stale_kernels()
    assert index.exists()
    next(tmp_path.glob("__pycache__/*")).write_text("other modules")
    drop_stale_kernels()
    assert not index.exists()
    assert foreign.exists()
