"""SURF: its Hessian against sums of pixels, OpenCV's values, and images that known homographies relate."""

import cv2
import numpy as np
import pytest

from mapper.features.base import Features
from mapper.features.config import SurfConfig
from mapper.features.fast_hessian import interest_points
from mapper.features.matching import match_mutual
from mapper.features.surf import Surf

# Column, row, filter size, angle in degrees, response, and numbers 16 to 23 of the descriptor, of features
# of different sizes and ranks that OpenCV 3.4.2, the last release on PyPI with SURF, finds in `rectangles()`.
OPENCV = (
    (226.158, 98.279, 33, 155.069, 55284.184, (0.001, -0.035, 0.045, 0.037, 0.057, 0.056, 0.433, 0.402)),
    (114.391, 132.033, 33, 177.501, 26662.527, (0.013, 0.007, 0.014, 0.008, -0.155, -0.200, 0.167, 0.203)),
    (252.426, 190.305, 26, 168.250, 16749.158, (-0.015, -0.004, 0.015, 0.004, 0.409, 0.015, 0.409, 0.137)),
    (169.093, 173.327, 21, 72.768, 10733.346, (0.010, -0.065, 0.023, 0.088, 0.269, -0.046, 0.440, 0.264)),
    (27.713, 113.934, 22, 2.965, 5360.220, (-0.004, -0.028, 0.004, 0.029, 0.185, -0.086, 0.253, 0.342)),
    (193.739, 166.352, 12, 269.077, 751.515, (0.001, -0.076, 0.001, 0.076, -0.206, -0.264, 0.248, 0.264)),
    (27.474, 98.788, 16, 267.225, 432.445, (-0.018, 0.085, 0.019, 0.086, 0.295, 0.057, 0.537, 0.063)),
)
OPENCV_COUNT = 444
"""How many it finds with a Hessian threshold of 400."""

EVERYTHING = SurfConfig(max_features=100_000, threshold=400.0, min_threshold=400.0)


def rectangles() -> np.ndarray:
    """Rectangles of every size and grey level: (240, 320) uint8."""
    rng = np.random.default_rng(5)
    image = np.full((240, 320), 128, np.uint8)
    for size in rng.integers(4, 60, size=300):
        x, y = rng.integers(-10, 320), rng.integers(-10, 240)
        image[max(y, 0) : y + size, max(x, 0) : x + size] = rng.integers(0, 256)
    return image


def photo(seed: int) -> np.ndarray:
    """Smooth noise of many scales: (480, 640) uint8."""
    rng = np.random.default_rng(seed)
    image = np.zeros((480, 640))
    for sigma in (1.5, 3.0, 6.0, 12.0, 24.0):
        layer = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), sigma)
        image += layer / layer.std()
    return np.clip(128 + 22 * image, 0, 255).astype(np.uint8)


def blob(column: float, row: float, sigma_px: float, *, height: float = 200.0) -> np.ndarray:
    y, x = np.mgrid[0:200, 0:220]
    bump = np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * sigma_px**2))
    return (20 + max(-height, 0) + height * bump).round().astype(np.uint8)


def determinant(image: np.ndarray, size: int, top: int, left: int) -> float:
    """Return the determinant of a filter's means, from the pixels: the boxes of a 9 px filter, scaled."""

    def mean(x0: int, y0: int, x1: int, y1: int) -> float:
        a, b, c, d = (round(edge * size / 9) for edge in (x0, y0, x1, y1))
        return float(image[top + b : top + d, left + a : left + c].mean())

    dxx = mean(0, 2, 3, 7) - 2 * mean(3, 2, 6, 7) + mean(6, 2, 9, 7)
    dyy = mean(2, 0, 7, 3) - 2 * mean(2, 3, 7, 6) + mean(2, 6, 7, 9)
    dxy = mean(1, 1, 4, 4) - mean(5, 1, 8, 4) - mean(1, 5, 4, 8) + mean(5, 5, 8, 8)
    return dxx * dyy - 0.81 * dxy**2


def turned(features: Features) -> np.ndarray:
    return np.degrees(features.angle_rad) % 360.0


@pytest.mark.parametrize("expected", OPENCV, ids=lambda row: f"size {row[2]}")
def test_features_are_opencvs(expected):
    column, row, size, angle_deg, response, numbers = expected
    image = rectangles()
    features = Surf(EVERYTHING).detect(image)
    points = interest_points(image, octaves=4, layers=3, threshold=400.0)

    k = np.linalg.norm(features.pixels - [column, row], axis=1).argmin()

    assert features.pixels[k] == pytest.approx([column, row], abs=2e-3)
    assert turned(features)[k] == pytest.approx(angle_deg, abs=0.05)
    assert features.response[k] == pytest.approx(response, rel=1e-5)
    assert features.descriptors[k, 16:24] == pytest.approx(numbers, abs=0.02)
    assert points[np.linalg.norm(points[:, :2] - [column, row], axis=1).argmin(), 2] == size


def test_there_are_as_many_features_as_opencv_finds():
    assert len(Surf(EVERYTHING).detect(rectangles())) == pytest.approx(OPENCV_COUNT, abs=2)


@pytest.mark.parametrize("octave", [0, 1, 2])
def test_responses_are_determinants_of_means(octave):
    image, step = photo(octave), 1 << octave
    points = interest_points(image, octaves=4, layers=1, threshold=50.0)
    at_sample = points[(points[:, 2] > 12 * step) & (points[:, 2] < 18 * step)][:5]
    size = 15 * step

    for column, row, _, response in at_sample:
        first = [round((centre - 0.5 * (size - 1)) / step) * step for centre in (row, column)]
        around = [
            determinant(image, size, first[0] + i * step, first[1] + j * step)
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        ]
        assert np.abs(np.array(around) / response - 1.0).min() < 1e-4
    assert len(at_sample) == 5


@pytest.mark.parametrize("height", [200.0, -200.0])
@pytest.mark.parametrize("sigma_px", [2.5, 3.5, 7.0, 14.0])
def test_a_blob_is_found_between_pixels_at_its_scale(sigma_px, height):
    column, row = 110.3, 101.6
    image = blob(column, row, sigma_px, height=height)

    x, y, size_px, _ = max(interest_points(image, octaves=4, layers=3, threshold=50.0), key=lambda p: p[3])

    assert x == pytest.approx(column, abs=0.05 * sigma_px)
    assert y == pytest.approx(row, abs=0.05 * sigma_px)
    assert size_px * 1.2 / 9.0 == pytest.approx(0.75 * sigma_px, rel=0.15)  # box filters see blobs smaller


def test_the_threshold_has_opencvs_scale():
    image = photo(3)
    strong, all_of_them = (
        interest_points(image, octaves=4, layers=3, threshold=threshold) for threshold in (500.0, 50.0)
    )

    assert 0 < len(strong) < len(all_of_them)
    assert np.array_equal(strong, all_of_them[all_of_them[:, 3] > 500.0])


@pytest.mark.parametrize(
    ("angle_deg", "zoom"), [(0.0, 1.0), (30.0, 1.0), (90.0, 1.0), (0.0, 0.75), (200.0, 1.3), (45.0, 0.6)]
)
def test_features_are_found_again_in_a_turned_and_scaled_image(angle_deg, zoom):
    image = photo(7)
    M = cv2.getRotationMatrix2D((320.0, 240.0), -angle_deg, zoom)  # clockwise on the screen, as angles are
    surf = Surf(SurfConfig(threshold=200.0, min_threshold=200.0))
    before = surf.detect(image)
    after = surf.detect(cv2.warpAffine(image, M, (640, 480), borderValue=128))

    pairs = match_mutual(before, after, max_ratio=0.8)
    mapped = before.pixels[pairs[:, 0]] @ M[:, :2].T + M[:, 2]
    misses_px = after.pixels[pairs[:, 1]] - mapped
    right = np.linalg.norm(misses_px, axis=1) < 3.0 * max(zoom, 1.0)
    turns = (turned(after)[pairs[:, 1]] - turned(before)[pairs[:, 0]] - angle_deg)[right]
    turns = (turns + 180.0) % 360.0 - 180.0

    assert len(pairs) > 100
    assert right.mean() > 0.95
    assert np.median(np.abs(misses_px[right])) < 0.4
    assert np.abs(misses_px[right].mean(axis=0)).max() < 0.1
    assert np.median(np.abs(turns)) < 6.0  # the window of 60° turns by 5°
    assert abs(np.median(turns)) < 1.5


def test_features_are_found_again_under_a_known_homography():
    image = photo(9)
    H = np.array([[0.92, 0.11, 20.0], [-0.06, 0.97, 14.0], [1.2e-4, -0.8e-4, 1.0]])
    surf = Surf(SurfConfig(threshold=200.0, min_threshold=200.0))
    before, after = surf.detect(image), surf.detect(cv2.warpPerspective(image, H, (640, 480)))

    pairs = match_mutual(before, after, max_ratio=0.8)
    mapped = cv2.perspectiveTransform(before.pixels[None, pairs[:, 0]], H)[0]
    right = np.linalg.norm(after.pixels[pairs[:, 1]] - mapped, axis=1) < 2.0

    assert len(pairs) > 300
    assert right.mean() > 0.97


def test_features_are_those_with_the_highest_response():
    image = photo(5)
    few, many = (Surf(SurfConfig(max_features=n)).detect(image) for n in (50, 1000))

    assert np.array_equal(few.response, many.response[:50])
    assert (np.diff(many.response) <= 0).all()


@pytest.mark.parametrize("shape", [(20, 20), (40, 300), (1, 640), (64, 64)])
def test_images_of_any_shape_are_read(shape):
    features = Surf(EVERYTHING).detect(np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8))

    assert (features.pixels >= 0).all()
    assert (features.pixels < shape[::-1]).all()
    assert np.linalg.norm(features.descriptors, axis=1) == pytest.approx(1.0, abs=1e-4)
