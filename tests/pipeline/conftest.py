"""What tests of pipelines share: halves of runs, builds that were stopped, and logs of other places."""

import shutil
from pathlib import Path

import pytest

from mapper.config.loading import load_config
from mapper.pipeline.build import build
from mapper.run.folder import Run
from mapper.runtime.atomic import partial_of
from mapper.simulation import write_tum_log
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from tests.support.desk import DESK, MANY_KEYFRAMES, write_log_of_another_flat
from tests.support.stopped_builds import StopAt, start, stopped


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


@pytest.fixture(scope="session")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of sixteen frames before a desk, for what is built again and again."""
    log = tmp_path_factory.mktemp("logs") / "short"
    write_tum_log(log, DESK.model_copy(update={"duration_s": 1.0, "width_px": 160, "height_px": 120}))
    return log


@pytest.fixture(scope="session")
def short_run(short_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run built of it."""
    return start(short_log, tmp_path_factory.mktemp("runs") / "short", checkpoint_s=None)


@pytest.fixture(scope="module")
def half(short_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A build of the short log that was stopped at frame 11; tests work on copies."""
    out = tmp_path_factory.mktemp("half") / "run"
    stopped(short_log, out, observer=StopAt(11))
    return out


@pytest.fixture
def unfinished(half: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    out = tmp_path / "run"
    shutil.copytree(partial_of(half), partial_of(out))
    return out


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of thirteen scans in a street."""
    folder = tmp_path_factory.mktemp("logs") / "street"
    sensor = LidarSensorConfig(rings=24, azimuth_steps=360)
    write_lidar_log(folder, STREET.model_copy(update={"duration_s": 1.2, "sensor": sensor}))
    return folder


@pytest.fixture(scope="module")
def street_run(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run built of it."""
    return start(street, tmp_path_factory.mktemp("runs") / "street", checkpoint_s=None)
