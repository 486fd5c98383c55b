"""KISS-Matcher: one thread, so that the same clouds give the same answer."""

import os
import subprocess
import sys

import pytest

THREADS = """
import ctypes
import numpy as np
from mapper.core.frames import Scan
from mapper.registration.config import KissMatcherConfig
from mapper.registration.factory import aligner_to
points = np.random.default_rng(0).uniform(-3.0, 3.0, (3000, 3)).astype(np.float32)
scan = Scan(0, points, np.zeros(3))
aligner_to(scan, KissMatcherConfig()).align(scan, np.eye(4))
with open("/proc/self/maps") as maps:
    openmp = next(line.split()[-1] for line in maps if "kiss_matcher.libs/libgomp" in line)
print(ctypes.CDLL(openmp).omp_get_max_threads())
"""


@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2, reason="Linux, two cores"
)
def test_the_library_has_one_thread():
    pytest.importorskip("kiss_matcher")
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, "-c", THREADS], capture_output=True, text=True, env=environment, check=True
    )
    assert done.stdout.split()[-1] == "1"
