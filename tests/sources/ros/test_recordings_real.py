"""Real logs as recordings, where they are: path and depth of the folder, and the scans of kiss-icp."""

import numpy as np
import pytest
from kiss_icp.datasets.rosbag import RosbagDataset

from mapper.config.loading import load_config
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.writers import write_log
from tests.support.depth_cameras import write_unregistered
from tests.support.paths import DATA


def log_or_skip(name):
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA / name} is not here")
    return DATA / name


def test_fr1_xyz_gives_the_identical_trajectory(tmp_path):
    config = load_config(None, ["loops.kind=none"])
    source = open_source(log_or_skip("tum_fr1_xyz"), SourceConfig(last_frame=30))
    expected = track_log(source, config, progress=SILENT).trajectory()
    assert len(expected) == 31
    for kind in ("mcap", "bag"):
        assert write_log(source, tmp_path / f"xyz.{kind}", kind=kind) == []
        again = open_source(tmp_path / f"xyz.{kind}", SourceConfig())
        found = track_log(again, config, progress=SILENT).trajectory()
        np.testing.assert_array_equal(found.stamps_ns, expected.stamps_ns)
        np.testing.assert_array_equal(found.T_world_body, expected.T_world_body)


def test_fr1_xyz_seen_by_a_depth_camera_beside_colour_s_has_the_same_depth(tmp_path):
    registered = open_source(log_or_skip("tum_fr1_xyz"), SourceConfig(last_frame=60, stride=30))
    write_unregistered(tmp_path / "bag", registered)
    for wanted, found in zip(registered, open_source(tmp_path / "bag"), strict=True):
        measured = wanted.depth_m > 0.0
        both = measured & (found.depth_m > 0.0)
        assert both.sum() > 0.995 * measured.sum()
        assert np.isclose(found.depth_m, wanted.depth_m, rtol=0.01)[both].mean() > 0.99


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_kitti_gives_the_scans_that_kiss_icp_reads(tmp_path, kind):
    path = tmp_path / f"kitti.{kind}"
    source = open_source(log_or_skip("kitti_00"), SourceConfig(last_frame=5))
    write_log(source, path, kind=kind)
    ours, theirs = open_source(path), RosbagDataset(path, "/points")
    assert len(ours) == len(theirs) == len(source)
    for i, (entry, expected) in enumerate(zip(ours.entries(), source.entries(), strict=True)):
        points, _ = theirs[i]
        scan = entry.load()
        assert abs(round(theirs.get_frames_timestamps()[i] * 1e9) - entry.stamp_ns) <= 1
        np.testing.assert_array_equal(scan.points_body, points)
        np.testing.assert_array_equal(scan.points_body, expected.load().points_body)
