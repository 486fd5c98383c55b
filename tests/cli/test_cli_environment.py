"""What the command line tells numba and OpenCV, and what it asks of them."""

import os
import subprocess
import sys
from types import SimpleNamespace

from mapper.cli.environment import note_compilation


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
