"""Fixtures for all tests: tiny recorded logs, a built run of one."""

import fcntl
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

from mapper.runtime.kernels import drop_stale_kernels
from tests.support.files import digest_of
from tests.support.tum_logs import write_tiny_log

if TYPE_CHECKING:
    from mapper.run.folder import Run  # heavy to import: tests of small things do without

hypothesis.settings.register_profile("no deadline", deadline=None)  # the machine may be busy
hypothesis.settings.load_profile("no deadline")
drop_stale_kernels()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first: begun last, they would leave the other worker processes idle."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


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


@contextmanager
def pictures_drawn(*, drawn: bool) -> Iterator[None]:
    """Let builds draw the pictures of their runs, or write a black pixel instead."""
    import cv2
    import numpy as np

    from mapper.export.cloud_picture import write_cloud_views
    from mapper.export.picture import write_summary

    pixel = cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes()
    with pytest.MonkeyPatch.context() as patch:
        for draw in (write_summary, write_cloud_views):
            instead = draw if drawn else lambda path, *_, **__: path.write_bytes(pixel)
            patch.setattr(f"mapper.pipeline.write_maps.{draw.__name__}", instead)
        yield


@pytest.fixture(scope="session", autouse=True)
def undrawn_builds() -> Iterator[None]:
    """Spare builds their pictures, a third of a small one's time; tests of small things load no builds."""
    if "mapper.pipeline.write_maps" not in sys.modules:
        yield
        return
    with pictures_drawn(drawn=False):
        yield


@pytest.fixture
def drawn_builds() -> Iterator[None]:
    """Let builds of a test draw their pictures."""
    with pictures_drawn(drawn=True):
        yield


@pytest.fixture
def tiny_tum_log(tmp_path: Path) -> Callable[..., Path]:
    """Make a TUM folder of ``n`` 64×48 frames with truth along x at 0.3 m/s."""

    def make(n: int = 5, *, folder: str = "log", ending: str = ".png") -> Path:
        return write_tiny_log(tmp_path / folder, n, ending=ending)

    return make


@pytest.fixture(scope="session")
def desk_log(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A synthetic TUM log of two seconds before a desk, with truth; tests that damage it work on a copy."""
    from tests.support.desk import write_desk_log

    with shared_folder(tmp_path_factory, "logs/desk", write_desk_log) as log:
        yield log


@pytest.fixture(scope="session")
def desk_run(desk_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator["Run"]:
    """The run built of the desk log with the defaults, repeatable; tests that change it work on a copy."""
    from mapper.run.folder import open_run
    from tests.support.desk import build_desk_run

    def fill(folder: Path) -> None:
        with pictures_drawn(drawn=True):
            build_desk_run(desk_log, folder)

    with shared_folder(tmp_path_factory, "runs/desk", fill) as run:
        yield open_run(run)
