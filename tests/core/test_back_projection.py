import numpy as np
import pytest

from mapper.core.back_projection import back_project
from mapper.core.frames import PinholeCamera, RgbdFrame, ray_table
from mapper.core.geometry import apply, exp

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


def test_colours_belong_to_their_points(depth_m):
    image = np.random.default_rng(4).integers(0, 255, (5, 7, 3), dtype=np.uint8)

    scan = RgbdFrame(0, image, depth_m, CAMERA, T_BODY_CAMERA).scan(max_depth_m=5.0)

    rows, columns = np.nonzero((depth_m > 0.0) & (depth_m <= 5.0))
    np.testing.assert_array_equal(scan.colors, image[rows, columns])
    assert len(scan.points_body) == len(rows)


def test_a_grey_image_gives_no_colours(depth_m):
    assert RgbdFrame(0, np.zeros((5, 7), np.uint8), depth_m, CAMERA).scan().colors is None


def test_an_empty_depth_image_gives_an_empty_scan():
    scan = RgbdFrame(0, np.zeros((5, 7), np.uint8), np.zeros((5, 7), np.float32), CAMERA).scan()
    assert scan.points_body.shape == (0, 3)
