import cv2
import numpy as np
import pytest

from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.sources.undistorted import Lens, UndistortedEntry

CAMERA = PinholeCamera(width_px=160, height_px=120, fx_px=131.0, fy_px=130.0, cx_px=79.5, cy_px=59.5)
AZURE = (0.52, -2.6, 0.0006, -0.0002, 1.5, 0.4, -2.42, 1.43)
FISHEYE = (-0.01, 0.02, -0.004, 0.001)


def projected(lens, columns, rows):
    """Pixels in the distorted image of the rays of a pinhole camera's pixels, by OpenCV's projection."""
    rays = np.column_stack([(columns - 79.5) / 131.0, (rows - 59.5) / 130.0, np.ones(len(columns))])
    no_motion, coefficients = np.zeros(3), np.array(lens.coefficients)
    if lens.is_fisheye:
        pixels, _ = cv2.fisheye.projectPoints(
            rays[:, None], no_motion, no_motion, CAMERA.matrix, coefficients
        )
    else:
        pixels, _ = cv2.projectPoints(rays, no_motion, no_motion, CAMERA.matrix, coefficients)
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize("lens", [Lens("rational_polynomial", AZURE), Lens("equidistant", FISHEYE)])
def test_a_pixel_is_read_where_the_lens_projects_its_ray(lens):
    columns, rows = np.array([0, 12, 80, 159]), np.array([0, 100, 60, 119])
    map_columns, map_rows = lens.maps(CAMERA)
    found = np.column_stack([map_columns[rows, columns], map_rows[rows, columns]])
    np.testing.assert_allclose(found, projected(lens, columns.astype(float), rows.astype(float)), atol=0.01)


def test_depth_keeps_its_values_and_colour_is_interpolated():
    lens = Lens("rational_polynomial", AZURE)
    depth_m = np.where(np.arange(160) < 80, np.float32(1.0), np.float32(3.0))[None].repeat(120, axis=0)
    image = np.where(np.arange(160) < 80, np.uint8(10), np.uint8(200))[None].repeat(120, axis=0)

    class Recorded:
        stamp_ns, files = 7, object()

        def load(self, *, colour):
            return RgbdFrame(7, image if colour else image.copy(), depth_m, CAMERA)

    entry = UndistortedEntry(Recorded(), lens.maps(CAMERA))
    frame = entry.load()
    assert set(np.unique(frame.depth_m)) <= {0.0, 1.0, 3.0}
    assert ((frame.image > 10) & (frame.image < 200)).any()
    assert entry.files is None
    assert len(entry.scan().points_body) == (frame.depth_m > 0.0).sum()


@pytest.mark.parametrize(
    ("model", "count"),
    [("double_sphere", 6), ("plumb_bob", 7), ("equidistant", 5), ("rational_polynomial", 9)],
)
def test_other_models_and_numbers_of_coefficients_are_not_known(model, count):
    assert not Lens(model, (0.1,) * count).is_known
