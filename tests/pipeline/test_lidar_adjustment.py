"""Poses of LiDAR logs, adjusted to the surfaces that scans share where other points show a gain."""

from dataclasses import replace

import pytest

from mapper.config.loading import load_config, overridden
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.pipeline import build as building
from mapper.pipeline.lidar_adjustment import adjust_tracking
from mapper.pipeline.solve import solve
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.simulation.config import LIDAR_SCENES
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from tests.support.paths import DATA


def ate_m(log, tracking):
    return evaluate(tracking.trajectory(), log.truth).ate_m


def test_rooms_are_more_accurate_and_the_manifest_says_so(tmp_path, monkeypatch):
    write_lidar_log(tmp_path / "log", LIDAR_SCENES["flat"].model_copy(update={"duration_s": 20.0, "seed": 1}))
    log = open_source(tmp_path / "log")
    solved = []

    def adjust(source, tracking, config, **arguments):
        solved.append((tracking, config))
        return adjust_tracking(source, tracking, config, **arguments)

    monkeypatch.setattr(building, "adjust_tracking", adjust)
    run = building.build(log, load_config(None, sensor="lidar"), tmp_path / "run")

    ((tracking, config),) = solved
    assert evaluate(run).ate_m < 0.7 * ate_m(log, tracking)
    record = run.manifest.solve.planes
    assert record.is_kept
    assert record.thinner_sigmas > 3.0
    assert record.thickness_m < record.thickness_before_m
    assert 0.0 < record.moved_m < 0.1
    left, no_record = adjust_tracking(log, tracking, overridden(config, ["graph.planes=off"]))
    assert no_record is None
    assert left.graph is tracking.graph


def test_a_real_courtyard_is_not_less_accurate():
    if not (DATA / "courtyard_2hz").exists():
        pytest.skip("no courtyard_2hz")
    log = open_source(DATA / "courtyard_2hz", SourceConfig(last_frame=79))
    config = load_config(None, sensor="lidar")
    tracking = track_log(log, config, progress=SILENT)
    solved = replace(tracking, graph=solve(tracking.graph, tracking.loops, config.graph).graph)

    adjusted, record = adjust_tracking(log, solved, config)

    assert ate_m(log, adjusted) < 1.05 * ate_m(log, solved)
    assert record.surfaces > 500
    assert record.is_kept or adjusted.graph is solved.graph


def test_images_are_not_adjusted(desk_run):
    assert desk_run.manifest.solve.planes is None
