"""What a run tells about the distortion of its depth images."""

import pytest

from mapper.config.loading import load_config
from mapper.core.trajectory import Trajectory
from mapper.pipeline.build import build
from mapper.pipeline.distortion_warnings import distortion_warnings
from mapper.pipeline.fuse import fuse
from mapper.sources import open_source
from mapper.sources.chained import chained
from mapper.sources.config import SourceConfig
from mapper.sources.selection import selected
from mapper.sources.writers import write_log
from tests.support.bent_depth import bent_log, poses, smooth_error

SETTINGS = ("odometry.kind=given", "loops.kind=none", "octree.resolution_m=0.1")


@pytest.fixture(scope="module")
def bent():
    return bent_log(error_per_m=smooth_error(0.0022))


@pytest.fixture(scope="module")
def run(bent, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bent")
    write_log(bent, folder / "log", kind="tum")
    log, config = open_source(folder / "log"), load_config(None, SETTINGS)
    return build(log, config, folder / "run", odometry=Trajectory(log.stamps_ns, poses(len(log))))


def of_distortion(warnings):
    return [warning for warning in warnings if warning.kind == "camera"]


def test_a_run_tells_that_depth_is_bent_once(run):
    (warning,) = of_distortion(run.manifest.warnings)
    assert warning.sentence.startswith("depth images are bent, all in the same way: planes are off by ")
    assert warning.suggestion == "--set source.undistort_depth=true"
    assert warning.weight == "note"
    again = fuse(run.open_log(), run, run.config)
    assert again.manifest.warnings == run.manifest.warnings


def test_an_error_of_a_large_share_of_the_depth_is_a_doubt():
    (warning,) = distortion_warnings(bent_log(error_per_m=smooth_error(0.011), sigma_per_m=0.001))
    assert warning.weight == "doubt"
    assert "(a doubt from 0.7% on)" in warning.sentence


def test_exact_depth_is_not_mentioned():
    assert distortion_warnings(bent_log()) == []


def test_what_the_setting_did_is_told(bent):
    on = SourceConfig(undistort_depth=True)
    (done,) = distortion_warnings(selected(bent, on))
    assert done.sentence.endswith("is removed")
    (nothing,) = distortion_warnings(selected(bent_log(), on))
    assert nothing.sentence == "no distortion of depth images was found; they are used as recorded"
    assert (done.weight, done.suggestion, nothing.weight) == ("note", "", "note")


def test_each_log_of_a_chain_is_judged_by_itself(bent):
    (warning,) = distortion_warnings(chained(bent_log(), bent))
    assert warning.sentence.startswith("memory: depth images are bent")
    (warning,) = distortion_warnings(chained(bent, bent_log()))
    assert warning.sentence.startswith("depth images are bent")
