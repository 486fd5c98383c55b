"""One thread per library: processes and threads of our own already fill the machine."""

import os

_LIMITS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


def one_thread_per_library() -> None:
    """Limit libraries to one thread where the user has set no other number; they read it when loaded.

    Small matrices are slower with several threads.
    """
    for name in _LIMITS:
        os.environ.setdefault(name, "1")
