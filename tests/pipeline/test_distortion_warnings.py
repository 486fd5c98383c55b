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
    return bent_log(error_per_m=smooth_error(0.0022), sigma_per_m=0.001)


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
    assert warning.sentence.startswith("depth images were bent, all in the same way; the error of ")
    assert (warning.weight, warning.suggestion) == ("note", "")
    again = fuse(run.open_log(), run, run.config)
    assert again.manifest.warnings == run.manifest.warnings


def test_an_error_of_a_large_share_of_the_depth_is_a_doubt():
    (warning,) = distortion_warnings(bent_log(error_per_m=smooth_error(0.011), sigma_per_m=0.001))
    assert warning.weight == "doubt"
    assert "(a doubt from 0.7% on)" in warning.sentence


def test_exact_depth_is_not_mentioned():
    assert distortion_warnings(bent_log()) == []
    assert distortion_warnings(selected(bent_log(), SourceConfig())) == []


def test_what_is_left_in_the_depth_comes_with_the_setting_that_removes_it(bent):
    (left,) = distortion_warnings(selected(bent, SourceConfig(undistort_depth=False)))
    assert left.sentence.startswith("depth images are bent, all in the same way: planes are off by ")
    assert (left.weight, left.suggestion) == ("note", "--set source.undistort_depth=true")


def test_each_log_of_a_chain_is_judged_by_itself(bent):
    (warning,) = distortion_warnings(chained(bent_log(), bent))
    assert warning.sentence.startswith("memory: depth images are bent")
    (warning,) = distortion_warnings(chained(bent, bent_log()))
    assert warning.sentence.startswith("depth images are bent")
