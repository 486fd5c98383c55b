import cv2
import numpy as np
import pytest

from mapper.core.frames import PinholeCamera
from mapper.sources.lens import POLYNOMIAL_MODELS, Lens, lens_model

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
    rays = lens.rays(CAMERA)
    assert rays.shape == (120, 160, 2)
    ideal = rays[rows, columns] * (131.0, 130.0) + (79.5, 59.5)
    np.testing.assert_allclose(projected(lens, *ideal.T), np.column_stack([columns, rows]), atol=0.01)


@pytest.mark.parametrize(
    ("name", "count", "is_polynomial", "is_known"),
    [
        ("", 5, True, True),
        ("", 8, True, True),
        ("", 4, False, False),
        ("none", 5, True, True),
        ("Plumb Bob", 5, True, True),
        ("radtan", 4, True, True),
        ("equidistant", 4, False, True),
        ("double_sphere", 5, False, False),
        ("plumb_bob", 7, True, False),
        ("equidistant", 5, False, False),
        ("rational_polynomial", 9, True, False),
    ],
)
def test_a_model_is_known_by_any_spelling_and_without_a_name_by_its_number_of_coefficients(
    name, count, is_polynomial, is_known
):
    model = lens_model(name, count)
    assert (model in POLYNOMIAL_MODELS) == is_polynomial
    assert Lens(model, (0.1,) * count).is_known == is_known
