"""Builds by a caller's own odometry: an object of the protocol, or poses that the run keeps."""

import shutil

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.odometry.base import Odometry
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.pipeline.append import append
from mapper.pipeline.build import build
from mapper.pipeline.fuse import fuse
from mapper.run.folder import open_run
from mapper.sources import open_source

OWN = load_config(settings={"odometry": {"kind": "own", "name": "Borrowed"}, "mcap.frame_times": False})


class Borrowed:
    """The toolkit's own odometry behind a class of which the toolkit knows nothing."""

    def __init__(self):
        self.inner = build_frame_odometry(LocalMapConfig())
        self.tracked = 0

    def read(self, entry):
        return self.inner.read(entry)

    def track(self, observation):
        self.tracked += 1
        return self.inner.track(observation)

    def view(self, observation, twist=None, /):
        return self.inner.view(observation, twist)

    def matches(self):
        return self.inner.matches()

    def finish(self):
        return self.inner.finish()


@pytest.fixture(scope="module")
def by_object(desk_log, tmp_path_factory):
    odometry = Borrowed()
    assert isinstance(odometry, Odometry)
    run = build(open_source(desk_log), OWN, tmp_path_factory.mktemp("own") / "run", odometry=odometry)
    assert odometry.tracked == 31
    return run


def test_an_object_of_the_protocol_tracks_as_if_it_were_ours(by_object, desk_run):
    for name in ("trajectory.tum", "graph.g2o", "map.octree", "cloud.ply"):
        assert (by_object.path / name).read_bytes() == (desk_run.path / name).read_bytes(), name
    assert by_object.config.odometry.kind == "own"
    assert by_object.config.odometry.name == "Borrowed"


def test_maps_are_made_again_without_it(by_object, tmp_path):
    copy = open_run(shutil.copytree(by_object.path, tmp_path / "run"))
    fused = fuse(copy.open_log(), copy, copy.config)
    assert (fused.path / "map.octree").read_bytes() == (by_object.path / "map.octree").read_bytes()


def test_what_needs_it_again_says_so(by_object, desk_log, tmp_path):
    with pytest.raises(ConfigError, match=r"kind=own: Borrowed odometry is an object of the program"):
        append(open_source(desk_log), by_object, by_object.config, tmp_path / "both")
    with pytest.raises(ConfigError, match=r"odometry\.kind=own"):
        build(open_source(desk_log), OWN, tmp_path / "run")


def test_poses_are_kept_in_the_run_and_found_where_it_is_moved_to(desk_log, tmp_path):
    log = open_source(desk_log)
    poses = Trajectory(log.truth.stamps_ns, log.truth.T_world_body)
    settings = {"odometry": {"kind": "given", "path": tmp_path / "run" / "odometry.tum"}}
    run = build(log, load_config(settings=settings), tmp_path / "run", odometry=poses)
    assert ate_rmse_m(run.trajectory, poses) < 0.01
    kept = run.file("odometry.tum")
    assert "odometry.tum" in run.manifest.files

    moved = open_run(run.path.rename(tmp_path / "elsewhere"))
    assert moved.config.odometry.path == tmp_path / "elsewhere" / kept.name
    again = build(log, moved.config, tmp_path / "again")
    np.testing.assert_allclose(again.trajectory.T_world_body, moved.trajectory.T_world_body, atol=1e-9)
