import cv2
import numpy as np
import pytest

from mapper.core.back_projection import back_project
from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan, ray_table
from mapper.core.geometry import apply, exp
from mapper.sources.calibration import FREIBURG

PLAIN = PinholeCamera(64, 48, 60.0, 61.0, 31.5, 23.5)
FR1 = FREIBURG["1"].camera(width_px=640, height_px=480)


def frame(depth_m, camera=PLAIN, **more):
    image = np.random.default_rng(0).integers(0, 256, (*depth_m.shape, 3), dtype=np.uint8)
    return RgbdFrame(7, image, depth_m.astype(np.float32), camera, **more)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx_px": 0.0}, "focal lengths > 0"),
        ({"fy_px": -1.0}, "focal lengths > 0"),
        ({"cx_px": np.nan}, "finite"),
        ({"distortion": (np.inf, 0, 0, 0, 0)}, "finite"),
        ({"width_px": 0}, "0×48 px has no pixels"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change, message):
    good = {"width_px": 64, "height_px": 48, "fx_px": 60.0, "fy_px": 60.0, "cx_px": 0.0, "cy_px": 0.0}
    with pytest.raises(DataError, match=message):
        PinholeCamera(**{**good, **change})


def test_projection_follows_the_pinhole_equations():
    pixels = PLAIN.project(np.array([[0.5, -0.25, 2.0]]))
    np.testing.assert_allclose(pixels, [[60 * 0.25 + 31.5, 61 * -0.125 + 23.5]])
    np.testing.assert_allclose(PLAIN.matrix @ [0.25, -0.125, 1.0], [*pixels[0], 1.0])


def test_undistortion_undoes_opencvs_distortion_to_the_corners():
    columns, rows = np.meshgrid(np.arange(0, 640, 13.0), np.arange(0, 480, 11.0))
    measured = np.column_stack([columns.ravel(), rows.ravel()])
    ideal = FR1.undistort(measured)
    rays = np.column_stack([FR1.rays(ideal), np.ones(len(ideal))])
    again, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), FR1.matrix, np.array(FR1.distortion))
    np.testing.assert_allclose(again.reshape(-1, 2), measured, atol=1e-4)
    assert np.abs(ideal - measured).max() > 2.0, "freiburg1 does distort"


def test_without_distortion_or_pixels_nothing_moves():
    pixels = np.array([[3.0, 4.0]])
    np.testing.assert_array_equal(PLAIN.undistort(pixels), pixels)
    assert FR1.undistort(np.zeros((0, 2))).shape == (0, 2)


def test_rays_project_back_to_their_pixels():
    rays = ray_table(PLAIN).reshape(-1, 2)
    points = 3.0 * np.column_stack([rays, np.ones(len(rays))])
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    np.testing.assert_allclose(
        PLAIN.project(points), np.column_stack([columns.ravel(), rows.ravel()]), atol=1e-5
    )


@pytest.mark.parametrize(
    ("points", "more", "message"),
    [
        (np.zeros((4, 2), np.float32), {}, r"scan 5: points \(4, 2\), want \(N, 3\)"),
        (np.zeros((4, 3)), {}, "points are float64, want float32"),
        (np.full((1, 3), np.nan, np.float32), {}, "points are not finite"),
        (np.array([[np.inf, -np.inf, 0]], np.float32), {}, "points are not finite"),
        (np.zeros((4, 3), np.float32), {"colors": np.zeros((3, 3), np.uint8)}, r"colors \(3, 3\)"),
        (np.zeros((4, 3), np.float32), {"times_s": np.zeros(3, np.float32)}, r"times \(3,\), want \(4,\)"),
    ],
)
def test_a_malformed_scan_is_refused(points, more, message):
    with pytest.raises(DataError, match=message):
        Scan(5, points, **more)


def test_a_frame_whose_images_differ_in_size_is_refused():
    image, depth_m = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32)
    with pytest.raises(DataError, match=r"frame 1: image \(48, 63, 3\), the camera has \(48, 64\)"):
        RgbdFrame(1, image[:, 1:], depth_m, PLAIN)
    with pytest.raises(DataError, match=r"frame 1: depth \(47, 64\)"):
        RgbdFrame(1, image, depth_m[1:], PLAIN)
    with pytest.raises(DataError, match="T_body_camera is not a rigid motion"):
        RgbdFrame(1, image, depth_m, PLAIN, 2.0 * np.eye(4))


def test_a_scan_holds_every_measured_pixel_at_its_place_and_colour():
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(0.5, 6.0, (48, 64)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.3] = 0.0
    depth_m[0, 0], depth_m[4, 6] = -1.0, np.nan
    T_body_camera = exp(np.array([0.3, -1.0, 0.2]), np.array([0.1, 0.2, 0.3]))
    shot = frame(depth_m, T_body_camera=T_body_camera)
    scan = shot.scan(stride_px=2, max_depth_m=4.0)

    rows, columns = np.nonzero((depth_m > 0) & (depth_m <= 4.0))
    kept = (rows % 2 == 0) & (columns % 2 == 0)
    rows, columns = rows[kept], columns[kept]
    z = depth_m[rows, columns].astype(np.float64)
    points_camera = np.column_stack([(columns - 31.5) / 60.0 * z, (rows - 23.5) / 61.0 * z, z])
    np.testing.assert_allclose(scan.points_body, apply(T_body_camera, points_camera), atol=2e-6)
    np.testing.assert_array_equal(scan.colors, shot.image[rows, columns])
    np.testing.assert_array_equal(scan.origin_body, T_body_camera[:3, 3])
    assert scan.scan() is scan


def test_a_frame_without_any_depth_gives_an_empty_scan():
    assert frame(np.zeros((48, 64))).scan().points_body.shape == (0, 3)


def test_grey_and_colour_of_a_frame_agree():
    shot = frame(np.ones((48, 64)))
    np.testing.assert_array_equal(shot.gray, cv2.cvtColor(shot.image, cv2.COLOR_RGB2GRAY))
    assert shot.rgb is shot.image
    grey = RgbdFrame(7, shot.gray, shot.depth_m, PLAIN)
    np.testing.assert_array_equal(grey.rgb, np.dstack([shot.gray] * 3))
    assert grey.gray is grey.image
    assert grey.scan().colors is None


def test_distorting_undoes_undistorting():
    camera = PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    pixels = np.random.default_rng(0).uniform([0.0, 0.0], [639.0, 479.0], (500, 2))
    np.testing.assert_allclose(camera.distort(camera.undistort(pixels)), pixels, atol=1e-3)
    plain = PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3)
    np.testing.assert_array_equal(plain.distort(pixels), pixels)


CAMERA = PinholeCamera(7, 5, 6.0, 6.5, 3.1, 2.2, (0.1, -0.05, 0.001, 0.002, 0.0))
T_BODY_CAMERA = exp(np.array([0.1, -0.4, 0.3]), np.array([1.0, -2.0, 0.5]))


@pytest.fixture
def depth_m():
    depth = np.random.default_rng(3).uniform(0.5, 6.0, (5, 7)).astype(np.float32)
    depth[1, 2], depth[4, 6], depth[0, 0] = 0.0, np.nan, -1.0
    return depth


@pytest.mark.parametrize("stride_px", [1, 2, 3])
def test_points_project_back_onto_their_pixels(depth_m, stride_px):
    points_body = back_project(
        depth_m, ray_table(CAMERA), T_BODY_CAMERA, stride_px=stride_px, max_depth_m=5.0
    )

    rows, columns = np.mgrid[0:5:stride_px, 0:7:stride_px]
    kept = [(c, r) for c, r in zip(columns.ravel(), rows.ravel(), strict=True) if 0.0 < depth_m[r, c] <= 5.0]
    points_camera = apply(np.linalg.inv(T_BODY_CAMERA), points_body.astype(np.float64))
    assert len(points_body) == len(kept)
    np.testing.assert_allclose(points_camera[:, 2], [depth_m[r, c] for c, r in kept], atol=1e-5)
    np.testing.assert_allclose(CAMERA.project(points_camera), CAMERA.undistort(np.array(kept)), atol=1e-4)
