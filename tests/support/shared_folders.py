"""Folders that are filled once for all worker processes of a test session."""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.files import digest_of


@contextmanager
def shared_folder(factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], None]) -> Iterator[Path]:
    """Give a folder that the first process to ask for it has filled, and which no test may change.

    Args:
        factory: Pytest's; a worker's own folder of it lies in the session's.
        name: The folder's path within the session's shared folder.
        fill: Makes the folder at the path it is given, which does not exist; other processes wait for it.

    Yields:
        The folder. Whoever needs to change something works on a copy.

    Raises:
        AssertionError: On leaving, if a file of the folder has changed since it was filled.
    """
    own = factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared" / name
    folder.parent.mkdir(parents=True, exist_ok=True)
    filled = folder.with_name(f"{folder.name}.sha256")
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # until it is closed
        if not filled.exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a process that failed half-way
            fill(folder)
            filled.write_text(digest_of(folder))
    yield folder
    assert digest_of(folder) == filled.read_text(), f"a test has changed {folder}, which others read"
