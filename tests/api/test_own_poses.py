"""Builds by a caller's function or poses, through ``mapper.build``."""

import numpy as np
import pytest

import mapper
from mapper.core.errors import ConfigError, DataError, TrackingError


def test_a_function_of_frames_drives_the_map(desk_log, tmp_path):
    log = mapper.open_log(desk_log)
    by_stamp = dict(zip(log.truth.stamps_ns.tolist(), log.truth.T_world_body, strict=True))
    calls = []

    def track(frame):
        calls.append(frame.stamp_ns)
        return None if len(calls) == 7 else by_stamp[frame.stamp_ns]

    run = mapper.build(log, out=tmp_path / "run", odometry=track)
    assert calls == log.stamps_ns.tolist()
    assert run.config.odometry.kind == "given"
    assert run.config.odometry.path_share == 0.01
    assert mapper.evaluate(run).ate_m < 0.01


def test_poses_do_too_with_settings_of_their_noise(desk_log, tmp_path):
    log = mapper.open_log(desk_log)
    run = mapper.build(
        log,
        out=tmp_path / "run",
        config=mapper.load_config(settings={"octree.resolution_m": 0.1, "odometry.kind": "isvd"}),
        odometry=log.truth,
        settings={"odometry": {"path_share": 0.0}, "loops.kind": "none"},
    )
    assert run.config.odometry.path_share == 0.0
    assert run.octree.resolution_m == 0.1
    assert mapper.evaluate(run).ate_m < 1e-6


@pytest.mark.parametrize(
    ("odometry", "error", "message"),
    [
        ("fast", ConfigError, "odometry: str is no odometry; want an object with read"),
        (lambda _frame: np.eye(3), DataError, r"a pose of shape \(3, 3\), want \(4, 4\)"),
        (lambda _frame: np.full((4, 4), np.nan), DataError, "not a finite rigid motion"),
        (lambda _frame: "here", DataError, r"want \(4, 4\)"),
        (lambda _frame: None, TrackingError, "placed 0 of 31 frames"),
    ],
)
def test_what_is_no_odometry_is_refused(desk_log, tmp_path, odometry, error, message):
    with pytest.raises(error, match=message):
        mapper.build(desk_log, out=tmp_path / "run", odometry=odometry)
    assert not list(tmp_path.iterdir())
