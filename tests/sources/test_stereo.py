"""Stereo pairs: rectified and matched as they are read, of data sets' folders and of recordings."""

import re

import cv2
import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.geometry import angle_between, apply, inverse, transform
from mapper.sensing.stereo import stereo_depth_m
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig, TopicsConfig
from mapper.sources.writers import left_out, write_log
from tests.support.recordings import changed, transforms, write
from tests.support.stereo_rig import (
    BARREL,
    FISHEYE,
    NORMAL_WORLD,
    OFFSET_M,
    RECTIFIED,
    SIZE_PX,
    T_IMU_LEFT,
    camera_chain,
    poses_world,
    projections,
    recorded,
    write_euroc,
    write_imu,
    write_kitti,
    write_kitti_drive,
    write_kitti_navigation,
)

RECT = ("/stereo/left/image_rect", "/stereo/right/image_rect")
RAW = ("/stereo/left/image_raw", "/stereo/right/image_raw")


def off_wall_m(frame, T_world_body):
    """Return the distances of a frame's points from the wall; most pixels have one."""
    points_world = apply(T_world_body, frame.scan().points_body.astype(np.float64))
    assert len(points_world) > 0.6 * frame.depth_m.size
    return points_world @ NORMAL_WORLD - OFFSET_M


def assert_shows_wall(log, poses=None):
    poses = log.truth.T_world_body if poses is None else poses
    for frame, T_world_body in zip(log, poses, strict=True):
        off_m = off_wall_m(frame, T_world_body)
        assert abs(np.median(off_m)) < 0.01
        sigma_m = log.depth_noise.quadratic_per_m * OFFSET_M**2
        assert np.percentile(np.abs(off_m), 90) < 1.5 * sigma_m


def rectification(cameras):
    """Return both rotations and both projections of OpenCV's rectification."""
    left, right = cameras
    T_right_left = inverse(right.T_left_camera)
    return cv2.stereoRectify(
        *(left.matrix, np.array(left.distortion), right.matrix, np.array(right.distortion)),
        *(SIZE_PX, T_right_left[:3, :3].copy(), T_right_left[:3, 3:].copy()),
    )[:4]


def turned_by_rectifying(cameras):
    """Return T_left_rectified."""
    return transform(rectification(cameras)[0].T, np.zeros(3))


@pytest.mark.parametrize(("cameras", "kalibr"), [(BARREL, False), (FISHEYE, True)])
def test_euroc_folder_shows_the_wall_from_the_true_poses(tmp_path, cameras, kalibr):
    log = open_source(write_euroc(tmp_path / "log", cameras, kalibr=kalibr))
    assert (log.kind, log.sensor, len(log)) == ("euroc", "rgbd", 2)
    assert_shows_wall(log)
    camera = log[0].camera
    assert camera.fx_px == camera.fy_px
    baseline_m = np.linalg.norm(cameras[1].T_left_camera[:3, 3])
    assert log.depth_noise.quadratic_per_m == pytest.approx(0.3 / (camera.fx_px * baseline_m), rel=1e-3)


def test_fisheyes_of_sixteen_bits_show_the_wall_by_their_own_sensor_yaml(tmp_path):
    folder = write_euroc(tmp_path / "log", FISHEYE)
    for path in folder.glob("mav0/cam*/sensor.yaml"):
        path.write_text(path.read_text().replace("radial-tangential", "equidistant"))
    for path in folder.glob("mav0/cam*/data/*.png"):
        cv2.imwrite(f"{path}", cv2.imread(f"{path}", cv2.IMREAD_GRAYSCALE).astype(np.uint16) << 8)
    assert_shows_wall(open_source(folder))


def test_euroc_readings_come_with_their_mounting(tmp_path):
    folder = write_euroc(tmp_path / "log", BARREL)
    write_imu(folder, 50)
    log = open_source(folder / "mav0")
    R_body_imu, felt_mps2 = log.gyroscope.R_body_imu, log.accelerations.acceleration_mps2
    left_turned = angle_between(R_body_imu, T_IMU_LEFT[:3, :3].T)
    assert left_turned < 0.05  # the rectified camera is little turned against the raw one
    up_body = log.truth.T_world_body[0, :3, :3].T @ [0.0, -1.0, 0.0]
    np.testing.assert_allclose(felt_mps2[0] / 9.81, up_body, atol=1e-6)
    assert log.accelerations.are_axes_stated


def test_kitti_sequence_shows_the_wall_from_its_poses_or_from_those_beside_its_data_set(tmp_path):
    sequence = write_kitti(tmp_path / "dataset/sequences/03")
    log = open_source(sequence)
    assert (log.kind, log.stamps_ns.tolist()) == ("kitti-stereo", [0, 100_000_000])
    assert_shows_wall(log)
    np.testing.assert_array_equal(log[0].gray, cv2.imread(str(sequence / "image_0/000000.png"), 0))
    (tmp_path / "dataset/poses").mkdir()
    (sequence / "poses.txt").rename(tmp_path / "dataset/poses/03.txt")
    log = open_source(tmp_path / "dataset")
    assert (log.kind, log.name, len(log)) == ("kitti-stereo", "03", 2)
    assert_shows_wall(log)
    write_kitti(tmp_path / "dataset/sequences/04")
    with pytest.raises(SourceError, match="sequences/03"):
        open_source(tmp_path / "dataset")


@pytest.mark.parametrize("numbers", [(0, 1), (2, 3)])
def test_kitti_drive_without_scans_shows_the_wall(tmp_path, numbers):
    drive = write_kitti_drive(tmp_path / "2011_09_26", numbers=numbers)
    antenna = write_kitti_navigation(drive)
    for opened in (drive, drive.parent):
        log = open_source(opened)
        assert (log.kind, log.name) == ("kitti-stereo", "2011_09_26_drive_0001_sync")
        assert log.stamps_ns.tolist() == [1317042145050360375, 1317042145150360375]
        assert_shows_wall(log, poses_world(2))
        assert [frame.depth_delay_s for frame in log] == [0.0, 0.0]
        np.testing.assert_allclose(log.gnss.antenna_body, antenna, atol=1e-6)
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    assert open_source(drive).gnss.antenna_body is None
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(SourceError, match=r"calib_cam_to_cam\.txt"):
        open_source(drive)


def test_kitti_drive_that_is_not_rectified_is_by_its_calibration(tmp_path):
    drive = write_kitti_drive(tmp_path / "2011_09_26", BARREL, is_rectified=False)
    log = open_source(drive)
    assert log.stamps_ns.tolist() == [1317042145050360375, 1317042145150360375]
    assert_shows_wall(log, [T @ turned_by_rectifying(BARREL) for T in poses_world(2)])
    (drive / "image_00/data/0000000000.png").write_bytes(b"no image")
    assert_shows_wall(open_source(drive)[1:], [poses_world(2)[1] @ turned_by_rectifying(BARREL)])


def test_converted_log_has_the_same_depth(tmp_path):
    log = open_source(write_kitti(tmp_path / "00"))
    write_log(log, tmp_path / "tum", kind="tum")
    assert len(left_out(log, "tum")) == 1  # the noise of its depth
    for found, wanted in zip(open_source(tmp_path / "tum"), log, strict=True):
        np.testing.assert_allclose(found.depth_m, wanted.depth_m, atol=1e-3)
        np.testing.assert_array_equal(found.image, wanted.image)


def test_rectified_topics_have_the_baseline_in_their_projections(tmp_path):
    log = open_source(write(tmp_path / "bag", recorded(RECTIFIED, RECT, projections=projections(0.12))))
    assert_shows_wall(log, poses_world(2))
    assert RECT[1] in log.choices[0]


@pytest.mark.parametrize(
    "names", ["rig/{port,starboard}", "usb_port1/{left,right}", "cam0/{left,right}", "rig/{l,r}"]
)
def test_pairs_are_found_by_the_last_word_for_a_side(tmp_path, names):
    head, _, sides = names.partition("{")
    topics = tuple(f"/{head}{side}/image_rect" for side in sides.strip("}").split(","))
    log = open_source(write(tmp_path / "a.mcap", recorded(RECTIFIED, topics, projections=projections(0.12))))
    assert_shows_wall(log, poses_world(2))


def test_each_image_of_a_namespace_has_the_calibration_that_shares_its_words(tmp_path):
    messages = recorded(RECTIFIED, ("/a/image_rect", "/b/image_rect"), projections=projections(0.12))
    names = {
        "/a/": ("/rig/image_rect_l", "/rig/camera_info_l"),
        "/b/": ("/rig/image_rect_r", "/rig/camera_info_r"),
    }
    named = [one._replace(topic=names[one.topic[:3]]["camera_info" in one.topic]) for one in messages]
    assert_shows_wall(open_source(write(tmp_path / "a.mcap", named)), poses_world(2))


def test_raw_topics_are_rectified_by_their_calibrations(tmp_path):
    R_left, R_right, P_left, P_right = rectification(BARREL)
    messages = recorded(BARREL, RAW, projections=(P_left, P_right), rotations=(R_left, R_right))
    log = open_source(write(tmp_path / "raw.bag", messages))
    assert_shows_wall(log, [T @ turned_by_rectifying(BARREL) for T in poses_world(2)])


def test_tf_says_where_the_right_camera_is(tmp_path):
    messages = recorded(RECTIFIED, RECT, projections=projections(0.0))
    place = transforms(("optical0", "optical1", RECTIFIED[1].T_left_camera))
    assert_shows_wall(open_source(write(tmp_path / "with.mcap", [place, *messages])), poses_world(2))
    with pytest.raises(SourceError, match="tf"):
        open_source(write(tmp_path / "without.mcap", messages))


@pytest.mark.parametrize(
    ("cameras", "has_imu", "topics"),
    [
        (BARREL, True, ("/cam0", "/cam1")),
        (FISHEYE, False, ("/cam0", "/cam1")),
        (BARREL, False, ("/other0", "/other1")),  # recorded under other names: by the order of the file
        (BARREL, True, ("/cam1", "/cam0")),
    ],
)
def test_kalibrs_file_describes_the_cameras_of_a_recording(tmp_path, cameras, has_imu, topics):
    names = ("/cam0/image_raw", "/cam1/image_raw")
    messages = recorded(cameras, names, projections=projections(0.1))
    write(tmp_path / "a.bag", [one for one in messages if one.topic in names])
    described = cameras[::-1] if topics == ("/cam1", "/cam0") else cameras
    (tmp_path / "my-camchain-imucam.yaml").write_text(camera_chain(described, has_imu=has_imu, topics=topics))
    log = open_source(tmp_path / "a.bag")
    assert_shows_wall(log, [T @ turned_by_rectifying(cameras) for T in poses_world(2)])


@pytest.mark.parametrize("case", ["zeros", "left alone", "third of another lens", "Windows"])
def test_kalibrs_file_counts_unless_both_cameras_are_calibrated(tmp_path, case):
    names = ("/cam0/image_raw", "/cam1/image_raw")
    messages = recorded(BARREL, names, projections=projections(0.1))
    if case == "zeros":  # as drivers publish that have no calibration
        zeros = {"k": np.zeros(9), "p": np.zeros(12), "d": np.zeros(0)}
        messages = [one if one.topic in names else changed(one, **zeros) for one in messages]
    else:
        kept = (*names, "/cam0/camera_info") if case == "left alone" else names
        messages = [one for one in messages if one.topic in kept]
    write(tmp_path / "a.bag", messages)
    with pytest.raises(SourceError, match=r"no calibration .*camchain"):
        open_source(tmp_path / "a.bag")
    text = camera_chain(BARREL)
    if case == "third of another lens":
        text += "cam2:\n  camera_model: omni\n  rostopic: /cam2/image_raw\n"
    if case == "Windows":
        text = text.replace("\n", "\r\n")
    (tmp_path / "camchain.yaml").write_bytes(text.encode())
    assert_shows_wall(
        open_source(tmp_path / "a.bag"), [T @ turned_by_rectifying(BARREL) for T in poses_world(2)]
    )


@pytest.mark.parametrize("are_infos_exchanged", [False, True])
def test_exchanged_topics_are_named_and_read_by_the_setting_that_is_named(tmp_path, are_infos_exchanged):
    other = {one.replace("left", "right"): one for one in (RECT[0], "/stereo/left/camera_info")}
    other |= {left: right for right, left in other.items()}
    messages = [
        one._replace(topic=other[one.topic]) if are_infos_exchanged or one.topic in RECT else one
        for one in recorded(RECTIFIED, RECT, projections=projections(0.12))
    ]
    path = write(tmp_path / "bag", messages)
    with pytest.raises(SourceError, match="left and right have changed places"):
        open_source(path)
    log = open_source(path, SourceConfig(topics=TopicsConfig(color=RECT[1])))
    assert_shows_wall(log, poses_world(2))


def test_exchanged_folders_are_named(tmp_path):
    folder = write_kitti(tmp_path / "00")
    for old, new in (("image_0", "other"), ("image_1", "image_0"), ("other", "image_1")):
        (folder / old).rename(folder / new)
    with pytest.raises(SourceError, match="left and right have changed places"):
        open_source(folder)


def test_what_is_missing_or_swapped_is_named(tmp_path):
    messages = recorded(RECTIFIED, RECT, projections=projections(0.12))
    with pytest.raises(SourceError, match="/stereo/right/image_rect"):
        open_source(
            write(tmp_path / "a", [one for one in messages if one.topic != "/stereo/right/camera_info"])
        )
    assert_shows_wall(
        open_source(write(tmp_path / "b", recorded(RECTIFIED, RECT, projections=projections(-0.12)))),
        poses_world(2),
    )
    folder = write_euroc(tmp_path / "c", BARREL)
    (folder / "mav0/cam1/sensor.yaml").unlink()
    with pytest.raises(SourceError, match="camchain"):
        open_source(folder)
    folder = write_euroc(tmp_path / "far", BARREL)
    file = folder / "mav0/cam1/sensor.yaml"
    numbers = re.search(r"data: *\[[^]]*\]", file.read_text())[0].split(",")
    file.write_text(
        re.sub(
            r"data: *\[[^]]*\]", ",".join([*numbers[:3], " 1e200", *numbers[4:]]), file.read_text(), count=1
        )
    )
    with pytest.raises(SourceError, match="no rigid motion"):
        open_source(folder)
    folder = write_euroc(tmp_path / "d", BARREL[::-1])
    with pytest.raises(SourceError, match="right"):
        open_source(folder)
    with pytest.raises(SourceError, match=r"source\.camera"):
        open_source(folder, SourceConfig(camera=CameraConfig(depth_factor=1000.0)))
    folder = write_kitti(tmp_path / "flat")
    file = folder / "calib.txt"
    file.write_text(re.sub(r"(?m)^P0: *\S+", "P0: 0", file.read_text()))
    with pytest.raises(SourceError, match="focal length"):
        open_source(folder)
    folder = write_kitti(tmp_path / "e")
    (folder / "image_1/000001.png").unlink()
    with pytest.raises(SourceError, match="image_1"):
        open_source(folder)


def test_points_that_the_right_camera_does_not_see_have_no_depth():
    left = np.random.default_rng(1).integers(0, 255, (60, 160), np.uint8)
    left = cv2.GaussianBlur(left, (0, 0), 1.0)
    right = np.roll(left, -8, axis=1)
    right[:, -8:] = 0
    depth_m = stereo_depth_m(left, right, focal_baseline_px_m=16.0)
    assert (depth_m[:, :32] == 0.0).all()
    assert np.median(depth_m[:, 40:]) == pytest.approx(2.0, abs=0.01)
