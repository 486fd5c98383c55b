"""Logs as MCAP files and bags and back: nothing that the target has room for is lost."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.frames import Scan
from mapper.sources import open_source
from mapper.sources.ros.encode_ros import cloud_message
from mapper.sources.writers import write_log
from tests.support.tum_logs import CALIBRATION, FIRST_NS

KINDS = ["mcap", "bag"]


def assert_same_frames(source, again):
    assert len(again) == len(source)
    for entry, other in zip(source.entries(), again.entries(), strict=True):
        assert (other.stamp_ns, other.depth_stamp_ns) == (entry.stamp_ns, entry.depth_stamp_ns)
        assert other.files.colour.read_bytes() == entry.files.colour.read_bytes()
        for colour in (True, False):
            frame, expected = other.load(colour=colour), entry.load(colour=colour)
            np.testing.assert_array_equal(frame.image, expected.image)
            np.testing.assert_array_equal(frame.depth_m, expected.depth_m)
            assert frame.camera == expected.camera
        np.testing.assert_array_equal(other.scan().points_body, entry.scan().points_body)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ending", [".png", ".jpg"])
@pytest.mark.parametrize("depth_factor", [5000, 1000])
def test_every_frame_stamp_and_pose_comes_back(tiny_tum_log, tmp_path, kind, ending, depth_factor):
    log = tiny_tum_log(4, ending=ending)
    distortion = "distortion = [0.1, -0.2, 0.001, 0.002, 0.05]\n"
    (log / "calibration.toml").write_text(f"{CALIBRATION}depth_factor = {depth_factor}\n{distortion}")
    (log / "accelerometer.txt").write_text("1305031102.1 0.1 0.2 9.81\n1305031102.2 0.1 0.25 9.8\n")
    source, out = open_source(log), tmp_path / f"again.{kind}"
    progress = []
    assert write_log(source, out, kind=kind, on_progress=progress.append) == []
    assert progress == [1, 2, 3, 4]
    again = open_source(out)
    assert_same_frames(source, again)
    assert again.truth.stamps_ns.tolist() == source.truth.stamps_ns.tolist()
    np.testing.assert_array_equal(again.truth.positions_world, source.truth.positions_world)
    np.testing.assert_allclose(again.truth.T_world_body, source.truth.T_world_body, atol=1e-15)
    assert again.accelerations.stamps_ns.tolist() == source.accelerations.stamps_ns.tolist()
    np.testing.assert_array_equal(
        again.accelerations.acceleration_mps2, source.accelerations.acceleration_mps2
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("depth_factor", [1000, 5000])
def test_a_tum_folder_comes_back_byte_by_byte_but_for_depth_of_other_units(
    tiny_tum_log, tmp_path, kind, depth_factor
):
    log = tiny_tum_log(3, ending=".jpg")
    (log / "calibration.toml").write_text(f"{CALIBRATION}depth_factor = {depth_factor}\n")
    write_log(open_source(log), tmp_path / f"log.{kind}", kind=kind)
    write_log(open_source(tmp_path / f"log.{kind}"), tmp_path / "again", kind="tum")
    source, again = open_source(log), open_source(tmp_path / "again")
    assert next(again.entries()).files.depth_units_per_m == depth_factor
    assert_same_frames(source, again)
    images = sorted(path.relative_to(log) for path in log.glob("*/*"))
    assert len(images) == 6
    for image in images:
        is_same = (tmp_path / "again" / image).read_bytes() == (log / image).read_bytes()
        assert is_same or (depth_factor != 1000 and image.parts[0] == "depth")


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_log_gives_the_same_bytes(tiny_tum_log, tmp_path, kind):
    source = open_source(tiny_tum_log(3))
    for name in ("a", "b"):
        write_log(source, tmp_path / f"{name}.{kind}", kind=kind)
    assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()


def kitti_log(folder, n=3):
    (folder / "velodyne").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for i in range(n):
        records = rng.uniform(-30.0, 30.0, (2000, 4)).astype("<f4")
        records[:, 3] = 0.0
        records.tofile(folder / f"velodyne/{i:06d}.bin")
    (folder / "times.txt").write_text("".join(f"{1700000000 + 0.1 * i:.9f}\n" for i in range(n)))
    pose = "1 0 0 {} 0 1 0 0 0 0 1 0\n"
    (folder / "poses.txt").write_text("".join(pose.format(float(i)) for i in range(n)))
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_scans_come_back_byte_by_byte(tmp_path, kind):
    log = kitti_log(tmp_path / "log")
    source = open_source(log)
    write_log(source, tmp_path / f"log.{kind}", kind=kind)
    middle = open_source(tmp_path / f"log.{kind}")
    assert middle.sensor == "lidar"
    assert [e.stamp_ns for e in middle.entries()] == [e.stamp_ns for e in source.entries()]
    np.testing.assert_array_equal(middle.truth.T_world_body, source.truth.T_world_body)
    write_log(middle, tmp_path / "again", kind="kitti")
    for path in sorted(log.glob("velodyne/*.bin")):
        assert (tmp_path / "again/velodyne" / path.name).read_bytes() == path.read_bytes()
    again = open_source(tmp_path / "again")
    assert [e.stamp_ns for e in again.entries()] == [e.stamp_ns for e in source.entries()]
    np.testing.assert_array_equal(again.truth.T_world_body, source.truth.T_world_body)


def test_points_keep_their_times(tmp_path):
    from tests.support.recordings import write

    times_s = np.linspace(0.0, 0.1, 100, dtype=np.float32)
    points = np.random.default_rng(0).uniform(1.0, 9.0, (100, 3)).astype(np.float32)
    scans = [Scan(FIRST_NS + i * 10**8, points, times_s=times_s) for i in range(2)]
    messages = [cloud_message("/points", scan, frame="lidar") for scan in scans]
    log = write(tmp_path / "log.mcap", messages)
    write_log(open_source(log), tmp_path / "kitti", kind="kitti")
    for source in (open_source(log), open_source(tmp_path / "kitti")):
        scan = next(source.entries()).load()
        np.testing.assert_array_equal(scan.points_body, points)
        np.testing.assert_allclose(scan.times_s, times_s, atol=1e-9)


def test_a_target_for_another_sensor_or_with_another_name_is_refused(tiny_tum_log, tmp_path):
    images, scans = open_source(tiny_tum_log(2)), open_source(kitti_log(tmp_path / "scans"))
    with pytest.raises(SourceError, match="images, not scans; KITTI folders hold scans"):
        write_log(images, tmp_path / "a", kind="kitti")
    assert not (tmp_path / "a").exists()
    with pytest.raises(SourceError, match="TUM and mbag hold RGB-D frames"):
        write_log(scans, tmp_path / "b", kind="tum")
    with pytest.raises(SourceError, match=r"log.bag: give a name that ends in .mcap"):
        write_log(images, tmp_path / "log.bag", kind="mcap")
