"""Libraries: extras that pip installs on demand, as in ``octree-mapper[viewer]``, and one thread for each."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from mapper.core.errors import DependencyError

DISTRIBUTION = "octree-mapper"
"""Name of this package in pip; it is imported as ``mapper``."""


@contextmanager
def extra(name: str, purpose: str) -> Iterator[None]:
    """Import libraries of an extra while inside.

    Args:
        name: Name of the extra, as in pyproject.toml.
        purpose: Use of the libraries, as a message begins.

    Raises:
        DependencyError: One of them is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise _missing(str(error.name), name, purpose) from None


def require(library: str, name: str, purpose: str) -> None:
    """Refuse a job at its start that will need a library of an extra; the library is not loaded.

    Args:
        library: Name by which the library is imported.
        name: Name of the extra.
        purpose: Use of the library, as a message begins.

    Raises:
        DependencyError: It is not installed.
    """
    if find_spec(library) is None:
        raise _missing(library, name, purpose)


def install_line(name: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install '{DISTRIBUTION}[{name}]'"


def _missing(library: str, name: str, purpose: str) -> DependencyError:
    return DependencyError(f"{purpose} needs {library}, which is not installed: {install_line(name)}")


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
