"""`mapper register`: one registration, told step by step and written down."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader

from mapper.config.register import register_config
from mapper.core.errors import ConfigError
from mapper.core.frames import Scan
from mapper.core.geometry import apply, exp, inverse
from mapper.evaluators.compare.registration import register, registration_text
from mapper.odometry.config import IsvdOdometryConfig
from mapper.registration.config import GicpConfig
from mapper.registration.hough.config import HoughGicpConfig
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources import open_source
from mapper.sources.scan_folders.scans import read_scan
from tests.support.command_line import mapper

T_TURNED = exp(np.array([0.0, 0.0, 1.2]), np.array([3.0, -2.0, 0.0]))


def write_kitti(path, points):
    np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(path)
    return path


@pytest.fixture(scope="module")
def street():
    sensor = LidarSensorConfig(rings=48, azimuth_steps=600, motion_distortion=False)
    return LidarSimulator(STREET.model_copy(update={"seed": 4, "duration_s": 1.0, "sensor": sensor}))


@pytest.fixture(scope="module")
def clouds(street, tmp_path_factory):
    """Two files of one street, the second turned, and the exact motion from it to the first."""
    folder = tmp_path_factory.mktemp("clouds")
    target, source = street.observe(0), street.observe(4)
    T_world_body = street.truth.T_world_body
    turned = apply(T_TURNED, source.points_body.astype(np.float64))
    T_target_source = inverse(T_world_body[0]) @ T_world_body[4] @ inverse(T_TURNED)
    return (
        write_kitti(folder / "target.bin", target.points_body),
        write_kitti(folder / "source.bin", turned),
        T_target_source,
    )


def test_a_turned_scan_is_found_without_a_guess_and_all_is_written(clouds, tmp_path):
    target, source, T_target_source = clouds
    out = tmp_path / "registered"

    result = mapper("register", source, target, "--out", out)
    words = ["hough-gicp", "trusted  yes", "xyz", "rpy", "MHD", "MPD", "before", "Hough", "refined", "vote"]
    for word in words:
        assert word in result.stdout
    record = json.loads((out / "manifest.json").read_text())
    found = np.array(record["T_target_source"])
    assert np.linalg.norm((inverse(T_target_source) @ found)[:3, 3]) < 0.1
    assert record["trusted"]
    assert record["config"]["registration"]["kind"] == "hough-gicp"
    before, hough, after = record["stages"]
    assert after["mpd_m"] <= hough["mpd_m"] < before["mpd_m"]
    aligned = read_scan(out / "aligned.ply").points_body
    assert np.allclose(aligned, apply(found, read_scan(source).points_body.astype(np.float64)), atol=1e-4)
    assert (out / "registration.png").read_bytes().startswith(b"\x89PNG")
    with (out / "registration.mcap").open("rb") as file:
        told = [
            (channel.topic, message.log_time) for _, channel, message in make_reader(file).iter_messages()
        ]
    assert told.count(("/map/target", 0)) == 1
    assert [stamp_ns for topic, stamp_ns in told if topic == "/map/source"] == [0, 10**9, 2 * 10**9]


def test_a_guess_and_a_knob_reach_the_method(clouds):
    target, source, T_target_source = clouds
    yaw_deg = np.degrees(np.arctan2(T_target_source[1, 0], T_target_source[0, 0]))
    x, y, z = T_target_source[:3, 3]
    guess = f"{x + 0.3} {y - 0.2} {z} 0 0 {yaw_deg + 2.0}"

    asked = (source, target, "--method", "gicp", "--guess", guess)

    assert "trusted  yes" in mapper("register", *asked).stdout
    strict = mapper("register", *asked, "--set", "registration.acceptance.min_agreeing_ratio=1", status=1)
    assert "less than 100%" in strict.stderr


def test_what_is_not_trusted_is_written_all_the_same_and_told_in_one_line(clouds, tmp_path):
    target, source, _ = clouds
    out = tmp_path / "wrong"

    wrong = ("--method", "icp", "--guess", "20 20 0 0 0 0")
    result = mapper("register", source, target, *wrong, "--out", out, "--quiet", status=1)
    assert len(result.stderr.splitlines()) == 1
    assert "source.bin on " in result.stderr
    assert "not trusted: " in result.stderr
    assert result.stdout == ""
    record = json.loads((out / "manifest.json").read_text())
    assert not record["trusted"]
    assert record["reason"] in result.stderr


def test_clouds_that_never_meet_leave_nothing_refined(street):
    far = exp(np.zeros(3), np.array([500.0, 0.0, 0.0]))
    registered = register(street.observe(0), street.observe(1), GicpConfig(), far)
    assert [stage.name for stage in registered.stages] == ["before"]
    assert "do not overlap" in registration_text(registered)
    assert "xyz" not in registration_text(registered)


def test_frames_of_a_log_are_named_by_their_number(desk_log):
    for method in ("isvd", "gicp"):
        result = mapper("register", f"{desk_log}@2", f"{desk_log}@0", "--method", method)
        assert f"method   {method}" in result.stdout


def test_a_cameras_frame_beside_a_cloud_file_is_a_cameras_still(desk_log, tmp_path):
    cloud, out = tmp_path / "cloud.npy", tmp_path / "registered"
    first = next(open_source(desk_log).entries()).scan()
    np.save(cloud, first.points_body)
    for source, target in ((f"{desk_log}@1", cloud), (cloud, f"{desk_log}@1")):
        mapper("register", source, target, "--method", "gicp", "--out", out, "--overwrite")
        record = json.loads((out / "manifest.json").read_text())
        assert record["config"]["registration"]["voxel_m"] == 0.05
        assert "a camera's frame has it ahead" in mapper("register", source, target, status=1).stderr


def test_clouds_in_other_units_are_scaled_as_told(clouds, tmp_path):
    target, source, T_target_source = clouds
    in_mm = []
    for path in (source, target):
        in_mm.append(tmp_path / path.with_suffix(".npy").name)
        np.save(in_mm[-1], 1000.0 * read_scan(path).points_body)
    out = tmp_path / "registered"

    refused = mapper("register", *in_mm, status=1)
    assert "--set source.cloud_scale=0.001" in refused.stderr
    mapper("register", *in_mm, "--set", "source.cloud_scale=0.001", "--out", out)
    found = np.array(json.loads((out / "manifest.json").read_text())["T_target_source"])
    assert np.linalg.norm((inverse(T_target_source) @ found)[:3, 3]) < 0.1


def test_it_can_be_watched_in_rerun(clouds, tmp_path):
    target, source, _ = clouds
    recording = tmp_path / "registered.rrd"
    mapper("register", source, target, "--rerun", recording, "--quiet")
    assert recording.read_bytes().startswith(b"RRF2")
    assert "exists already" in mapper("register", source, target, "--rerun", recording, status=1).stderr
    assert "want FILE.rrd" in mapper("register", source, target, "--rerun", "somewhere", status=1).stderr


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("{log}@999", "{log}@0"), "want a frame of {log} from @0 to @"),
        (("{log}@x", "{log}@0"), "want a frame of"),
        (("{log}", "{log}@0"), "is a folder; name a log's frame, as in"),
        (("{log}@1", "{log}@0", "--method", "magic"), "method magic: want one of hough-gicp"),
        (("{log}@1", "{log}@0", "--method", "gicp", "--guess", "1 2 3"), "3 numbers; want"),
        (("{log}@1", "{log}@0", "--guess", "1 2 3 0 0 0"), "hough-gicp has no use for one"),
        (
            ("{log}@1", "{log}@0"),
            "needs z up, and a camera's frame has it ahead; choose icp, plane-icp, gicp",
        ),
        (
            ("{log}@1", "{log}@0", "--method", "icp", "--set", "registration.nonsense=1"),
            "registration.icp.nonsense: unknown; known are ",
        ),
    ],
)
def test_a_mistake_is_one_line(arguments, complaint, desk_log):
    result = mapper("register", *(argument.format(log=desk_log) for argument in arguments), status=1)
    assert complaint.format(log=desk_log) in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_isvd_says_that_it_needs_images():
    scan = Scan(0, np.zeros((3, 3), np.float32))
    with pytest.raises(ConfigError, match="isvd matches images"):
        register(scan, scan, IsvdOdometryConfig(), np.eye(4))


def test_a_method_is_scaled_to_what_the_sensor_sees():
    assert register_config("gicp", "lidar").registration.voxel_m == 0.3
    assert register_config("gicp", "rgbd").registration.voxel_m == 0.05
    assert register_config("hough-gicp", "lidar").registration == HoughGicpConfig()
