"""What tests of two sessions share: a run of the first half of a walk, and a log of another flat."""

from pathlib import Path

import pytest

from mapper.config.loading import load_config
from mapper.pipeline.build import build
from mapper.run.folder import Run
from mapper.sources import open_source
from tests.support.desk import MANY_KEYFRAMES, write_log_of_another_flat


@pytest.fixture(scope="session")
def first(desk_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run of the first half of the walk; tests that change it work on a copy."""
    config = load_config(None, [*MANY_KEYFRAMES, "source.last_frame=15"])
    return build(open_source(desk_log, config.source), config, tmp_path_factory.mktemp("first") / "run")


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of another flat."""
    log = tmp_path_factory.mktemp("synthetic") / "elsewhere"
    write_log_of_another_flat(log)
    return log
