"""Images beside a LiDAR's scans: KITTI's two layouts, and recordings."""

import cv2
import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import PinholeCamera, Scan
from mapper.core.geometry import exp, inverse
from mapper.sources import open_source
from mapper.sources.ros.encode_ros import camera_info_message, cloud_message, image_message
from tests.support.recordings import transforms, write

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
T_CAMERA_LIDAR = exp(np.array([0.01, -0.02, 0.03]), np.array([0.2, -0.1, 0.05])) @ np.block(
    [
        [np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros((3, 1))],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
PERIOD_NS = 100_000_000


def picture(k):
    return np.full((48, 64, 3), (10 * k, 20, 30), np.uint8)


def points(k):
    return np.random.default_rng(k).uniform(2.0, 9.0, (400, 3)).astype(np.float32)


def text(*matrices):
    return "".join(f"{name}: {' '.join(f'{v:.9e}' for v in np.ravel(matrix))}\n" for name, matrix in matrices)


def write_kitti(folder, *, is_raw=False, scans=4):
    clouds, images = (
        folder / name
        for name in (("velodyne_points/data", "image_02/data") if is_raw else ("velodyne", "image_2"))
    )
    for one in (clouds, images):
        one.mkdir(parents=True)
    for k in range(scans):
        np.column_stack([points(k), np.zeros(400)]).astype(np.float32).tofile(clouds / f"{k:06d}.bin")
        cv2.imwrite(str(images / f"{k:06d}.png"), picture(k)[:, :, ::-1])
    beside_m = np.array([0.06, 0.0, 0.0])
    projection = np.column_stack([CAMERA.matrix, CAMERA.matrix @ beside_m])
    T_first_lidar = exp(np.zeros(3), -beside_m) @ T_CAMERA_LIDAR
    if is_raw:
        rectified = exp(np.array([0.002, 0.003, -0.001]), np.zeros(3))
        mounted = inverse(rectified) @ T_first_lidar
        cameras = text(("P_rect_02", projection), ("R_rect_00", rectified[:3, :3]))
        (folder.parent / "calib_cam_to_cam.txt").write_text("calib_time: 09-Jan-2012 13:57:47\n" + cameras)
        lidar = text(("R", mounted[:3, :3]), ("T", mounted[:3, 3]))
        (folder.parent / "calib_velo_to_cam.txt").write_text(lidar)
    else:
        (folder / "calib.txt").write_text(text(("P2", projection), ("Tr", T_first_lidar[:3])))
    return folder


@pytest.mark.parametrize("is_raw", [False, True])
def test_kitti_s_left_colour_camera_is_where_the_calibration_says(tmp_path, is_raw):
    log = open_source(write_kitti(tmp_path / "drive", is_raw=is_raw))

    (images,) = log.images
    assert log.has_colours
    assert images.camera == CAMERA
    np.testing.assert_allclose(images.T_body_camera, inverse(T_CAMERA_LIDAR), atol=1e-6)
    (sensor,) = log.sensors
    assert (sensor.frame, sensor.parent) == (images.name, log.body_frame)
    np.testing.assert_array_equal(sensor.T_parent_sensor, images.T_body_camera)
    np.testing.assert_array_equal(images.stamps_ns, log.stamps_ns)
    np.testing.assert_array_equal(images.image_at(3), picture(3))


def test_images_are_paired_by_name(tmp_path):
    folder = write_kitti(tmp_path / "drive")
    (folder / "image_2/000001.png").unlink()
    (images,) = open_source(folder).images
    np.testing.assert_array_equal(images.stamps_ns, open_source(folder).stamps_ns[[0, 2, 3]])
    np.testing.assert_array_equal(images.image_at(1), picture(2))


def test_a_damaged_first_image_costs_itself_alone(tmp_path):
    folder = write_kitti(tmp_path / "drive")
    (folder / "image_2/000000.png").write_bytes(b"no image")
    (images,) = open_source(folder).images
    np.testing.assert_array_equal(images.image_at(1), picture(1))
    with pytest.raises(FrameError):
        images.image_at(0)


@pytest.mark.parametrize("missing", ["Tr", "P2"])
def test_images_without_a_calibration_are_named_and_not_used(tmp_path, missing):
    folder = write_kitti(tmp_path / "drive")
    lines = (folder / "calib.txt").read_text().splitlines()
    (folder / "calib.txt").write_text("\n".join(line for line in lines if not line.startswith(missing)))
    log = open_source(folder)
    assert not log.images
    assert any("images that are not used" in note for note in log.notes)


def test_links_out_of_the_log_are_refused(tmp_path):
    folder = write_kitti(tmp_path / "drive")
    secret = tmp_path / "secret.png"
    (folder / "image_2/000002.png").rename(secret)
    (folder / "image_2/000002.png").symlink_to(secret)
    with pytest.raises(SourceError, match="link"):
        open_source(folder)


def recorded(path, *, told=True):
    messages = [transforms(("base", "lidar", exp(np.zeros(3), np.array([0.0, 0.0, 1.0]))))]
    if told:
        messages += [
            transforms(
                ("base", "optical", exp(np.zeros(3), np.array([0.0, 0.0, 1.0])) @ inverse(T_CAMERA_LIDAR))
            )
        ]
    for k in range(4):
        stamp_ns = (k + 1) * PERIOD_NS
        messages += [
            cloud_message("/lidar/points", Scan(stamp_ns, points(k)), frame="lidar"),
            image_message(
                stamp_ns + 5_000_000, "/front/image_raw", picture(k), encoding="rgb8", frame="optical"
            ),
            image_message(
                stamp_ns + 6_000_000, "/front/mono", picture(k)[:, :, 0], encoding="mono8", frame="optical"
            ),
            camera_info_message(stamp_ns + 5_000_000, "/front/camera_info", CAMERA, frame="optical"),
        ]
    return write(path, messages)


@pytest.mark.parametrize("name", ["log.mcap", "log.bag"])
def test_a_recording_s_camera_is_where_tf_says(tmp_path, name):
    log = open_source(recorded(tmp_path / name))

    (images,) = log.images
    assert (log.sensor, images.name, images.camera) == ("lidar", "/front/image_raw", CAMERA)
    np.testing.assert_allclose(images.T_body_camera, inverse(T_CAMERA_LIDAR), atol=1e-6)
    np.testing.assert_array_equal(images.stamps_ns, log.stamps_ns + 5_000_000)
    np.testing.assert_array_equal(images.image_at(2), picture(2))


def test_a_camera_that_tf_does_not_place_is_named(tmp_path):
    log = open_source(recorded(tmp_path / "log.mcap", told=False))
    assert not log.images
    assert any("/front/image_raw" in note for note in log.choices)
