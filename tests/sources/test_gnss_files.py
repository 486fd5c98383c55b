"""GNSS fixes beside a log: our own table, and the oxts folder of KITTI's raw drives."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.geodesy import GeodeticOrigin
from mapper.sensing.gnss import GnssFixes
from mapper.sources import open_source
from mapper.sources.gnss_files import read_gnss, write_gnss

ORIGIN = GeodeticOrigin(49.0, 8.4, 115.0)
# The first packet of 2011_09_26_drive_0001, shortened to the digits that matter here.
PACKET = (
    "49.015003823272 8.4342971002335 116.43032836914 0.035752 0.00903 -2.6087069803847 -6.811441479104 "
    "-11.275641809511 13.172716663769 -0.12475264293164 -0.032919903047354 0.44519814145418 0.12262487412962 "
    "9.8010177001339 0.45096083202 0.15001055 9.8 -0.0008 -0.0167 0.0088 -0.00099 -0.0166 0.0089 "
    "0.19921351667516 0.07 4 11 6 4 4"
)


def test_fixes_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(5)
    root = rng.normal(size=(4, 3, 3))
    covariances = root @ root.transpose(0, 2, 1) + np.eye(3)
    covariances[2] = np.nan
    fixes = GnssFixes(
        "/fix",
        np.arange(4) * 200_000_001,
        ORIGIN.geodetic(rng.normal(size=(4, 3))),
        covariances,
        np.array([0, 1, 2, 0], np.int8),
        np.array([0.1, -0.25, 1.0]),
    )
    write_gnss(tmp_path, fixes)
    read, notes = read_gnss(tmp_path)
    assert len(notes) == 1
    assert read.stamps_ns.tolist() == fixes.stamps_ns.tolist()
    np.testing.assert_array_equal(read.geodetic, fixes.geodetic)
    np.testing.assert_allclose(read.covariances_enu, fixes.covariances_enu, rtol=1e-15)
    np.testing.assert_array_equal(read.status, fixes.status)
    np.testing.assert_array_equal(read.antenna_body, fixes.antenna_body)


def test_a_table_may_have_no_covariances_and_be_out_of_order(tmp_path):
    (tmp_path / "gnss.txt").write_text("2.5 49.0 8.4 115 0\n1.5 49.1 8.4 115 1\n3.5 0 0 0 -1\n")
    read, _ = read_gnss(tmp_path)
    assert read.stamps_ns.tolist() == [1_500_000_000, 2_500_000_000]
    assert read.status.tolist() == [1, 0]
    assert np.isnan(read.covariances_enu).all()
    assert read.antenna_body is None


def test_a_line_of_another_length_is_named(tmp_path):
    (tmp_path / "gnss.txt").write_text("1.5 49.0 8.4 115 0\n2.5 49.0 8.4\n")
    with pytest.raises(SourceError, match=r"gnss\.txt:2: 3 columns"):
        read_gnss(tmp_path)


@pytest.fixture
def drive(tmp_path):
    """A raw drive of three scans with five packets."""
    folder = tmp_path / "2011_09_26" / "drive"
    scans, packets = folder / "velodyne_points" / "data", folder / "oxts" / "data"
    scans.mkdir(parents=True)
    packets.mkdir(parents=True)
    times = [f"2011-09-26 13:02:25.{k}00000000" for k in range(5)]
    (folder / "velodyne_points/timestamps.txt").write_text("\n".join(times[:3]))
    (folder / "oxts/timestamps.txt").write_text("\n".join(times))
    for k in range(3):
        np.ones((9, 4), "<f4").tofile(scans / f"{k:010d}.bin")
    for k in range(5):
        words = PACKET.split()
        words[28] = "0" if k == 1 else words[28]
        (packets / f"{k:010d}.txt").write_text(" ".join(words))
    mounting = "calib_time: 25-May-2012\nR: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.8\n"
    (folder.parent / "calib_imu_to_velo.txt").write_text(mounting)
    return folder


def test_a_raw_drive_has_the_positions_of_its_navigation_system(drive):
    log = open_source(drive)
    assert len(log) == 3
    assert len(log.gnss) == 4  # one packet has no position
    assert log.gnss.stamps_ns[0] == log.stamps_ns[0]
    np.testing.assert_array_equal(log.gnss.geodetic[0], [49.015003823272, 8.4342971002335, 116.43032836914])
    assert log.gnss.sigmas_m == pytest.approx(0.19921351667516)
    assert set(log.gnss.status.tolist()) == {2}
    np.testing.assert_array_equal(log.gnss.antenna_body, [-0.81, 0.32, -0.8])
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    assert open_source(drive).gnss.antenna_body is None
    (drive / "oxts/data/0000000002.txt").write_text("1 2 3")
    with pytest.raises(SourceError, match=r"0000000002\.txt: 3 numbers"):
        open_source(drive)
