"""What the command line tells numba and OpenCV, and what it asks of them."""

import os
import subprocess
import sys

from mapper.cli.environment import has_compiled_code


def test_compiled_code_is_found_where_numba_keeps_it(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not has_compiled_code()
    (tmp_path / "mapper_0123").mkdir()
    (tmp_path / "mapper_0123" / "kernels.cast_rays-155.py311.nbi").touch()
    assert has_compiled_code()


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
