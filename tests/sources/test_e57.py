"""E57 files, written by pye57: scans with poses, colours and intensities, in one file or a file each."""

import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from tests.support.e57_files import POSES, fields, write

pye57 = pytest.importorskip("pye57")


def test_scans_of_a_file_are_in_the_scanner_s_frame_with_their_poses(tmp_path):
    made = [fields(seed) for seed in range(3)]
    log = open_source(write(tmp_path / "a.e57", *(data for _, data in made)))
    assert (log.kind, log.sensor, len(log), log.truth) == ("e57", "lidar", 3, None)
    np.testing.assert_allclose(log.device_poses.T_world_body, POSES, atol=1e-12)
    for (xyz, data), scan, entry in zip(made, log, log.entries(), strict=True):
        np.testing.assert_allclose(scan.points_body, xyz, atol=1e-5)
        np.testing.assert_allclose(scan.intensities, data["intensity"], atol=1e-6)
        np.testing.assert_array_equal(scan.colors[:, 1], data["colorGreen"])
        bare = entry.scan()
        np.testing.assert_array_equal(bare.points_body, scan.points_body)
        assert (bare.colors, bare.intensities) == (None, None)


def test_files_of_a_folder_are_a_scan_each_in_the_order_of_their_names(tmp_path):
    for seed in (2, 0, 1):
        write(tmp_path / f"station_{seed}.E57", fields(seed)[1])
    log = open_source(tmp_path, SourceConfig(rate_hz=0.5))
    assert log.stamps_ns.tolist() == [0, 2_000_000_000, 4_000_000_000]
    for seed, scan in enumerate(log):
        np.testing.assert_allclose(scan.points_body, fields(seed)[0], atol=1e-5)


def test_angles_become_points_and_what_is_too_far_is_left_out(tmp_path, monkeypatch):
    xyz, data = fields(4)
    level = np.hypot(xyz[:, 0], xyz[:, 1])
    angles = {
        "sphericalRange": np.linalg.norm(xyz, axis=1),
        "sphericalAzimuth": np.arctan2(xyz[:, 1], xyz[:, 0]),
        "sphericalElevation": np.arctan2(xyz[:, 2], level),
    }
    angles["sphericalRange"][:3] = 6e3
    log = open_source(write(tmp_path / "a.e57", data))
    monkeypatch.setattr(pye57.E57, "read_scan", lambda *_arguments, **_options: angles)  # it writes none
    scan = log[0]
    np.testing.assert_allclose(scan.points_body, xyz[3:], atol=1e-4)
    assert scan.far_returns == 3


def test_damaged_files_are_named(tmp_path):
    path = write(tmp_path / "a.e57", *(fields(seed, count=4000)[1] for seed in range(2)))
    whole = path.read_bytes()
    for kept in (0, 100, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:kept])
        with pytest.raises(SourceError, match=r"a\.e57"):
            open_source(path)
        assert path.stat().st_size == kept  # the library may remove what it cannot open
    path.write_bytes(whole)
    log = open_source(path)
    path.write_bytes(whole[:600] + bytes(1000) + whole[1600:])
    with pytest.raises((FrameError, SourceError), match=r"a\.e57"):
        log[0]
    empty = write(tmp_path / "b.e57", fields(1, count=3)[1])
    with pytest.raises(FrameError, match=r"b\.e57: scan 0: 3 points"):
        open_source(empty)[0]
