"""Detectors: contract for every one of them, and the parts that uniform ORB is made of."""

from concurrent.futures import ThreadPoolExecutor
from typing import get_args

import cv2
import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.features.base import Features
from mapper.features.config import DetectorConfig, OrbConfig, SurfConfig, UniformOrbConfig
from mapper.features.factory import build_detector
from mapper.features.uniform_orb_kernels import corners, fast_scores, orientations, spread

EVERY_DETECTOR = [member() for member in get_args(get_args(DetectorConfig)[0])]
every_detector = pytest.mark.parametrize("config", EVERY_DETECTOR, ids=lambda config: config.kind)


def texture(seed: int, *, contrast: float = 1.0) -> np.ndarray:
    """Patches of every size and grey level: (240, 320) uint8."""
    rng = np.random.default_rng(seed)
    image = np.full((240, 320), 128.0)
    for size in rng.integers(4, 40, size=400):
        x, y = rng.integers(-10, 320), rng.integers(-10, 240)
        image[max(y, 0) : y + size, max(x, 0) : x + size] = rng.integers(0, 256)
    image = cv2.GaussianBlur(image, (3, 3), 0.8)
    return (128.0 + contrast * (image - 128.0)).round().astype(np.uint8)


def same(a: Features, b: Features) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in Features.__slots__)


@every_detector
def test_features_lie_in_the_image_and_have_a_row_each(config):
    features = build_detector(config).detect(texture(0))

    assert 150 <= len(features) <= config.max_features
    assert (features.pixels >= 0).all()
    assert (features.pixels < [320, 240]).all()
    assert (features.octave >= 0).all()
    assert (np.abs(features.angle_rad) <= 2 * np.pi + 1e-3).all()
    assert len(np.unique(features.descriptors, axis=0)) > 0.9 * len(features)


@every_detector
def test_an_image_without_texture_has_no_features(config):
    features = build_detector(config).detect(np.full((240, 320), 90, np.uint8))

    assert len(features) == 0
    assert features.descriptors.shape[1] == build_detector(config).detect(texture(0)).descriptors.shape[1]


@every_detector
def test_an_image_too_small_for_any_feature_has_none(config):
    assert len(build_detector(config).detect(texture(0)[:6, :6].copy())) == 0


@every_detector
def test_features_are_the_same_in_any_thread_and_order(config):
    detector = build_detector(config)
    images = [texture(seed, contrast=0.2 + 0.2 * seed) for seed in range(4)]
    alone = [detector.detect(image) for image in images]

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(detector.detect, reversed(images)))

    assert all(same(a, b) for a, b in zip(alone, reversed(together), strict=True))


@every_detector
def test_features_follow_a_shifted_image(config):
    image = texture(3)
    detector = build_detector(config)

    still, moved = detector.detect(image), detector.detect(np.roll(image, (0, 12), axis=(0, 1)))

    shifted = still.pixels + np.float32([12, 0])
    inside = (shifted[:, 0] > 60) & (shifted[:, 0] < 260) & (np.abs(shifted[:, 1] - 120) < 60)
    gaps = np.linalg.norm(shifted[inside, None] - moved.pixels[None], axis=2).min(axis=1)
    assert (gaps < 1.5).mean() > 0.6


def nearest(a: np.ndarray, b: np.ndarray, *, within_px: float) -> np.ndarray:
    """Differences of pixels from their nearest ones among others, where these are close: (K, 2)."""
    apart = b[None] - a[:, None]
    best = np.linalg.norm(apart, axis=2).argmin(axis=1)
    difference = apart[np.arange(len(a)), best]
    return difference[np.linalg.norm(difference, axis=1) < within_px]


def test_uniform_orb_finds_mirrored_features_at_mirrored_pixels_in_every_octave():
    image = texture(5)
    detector = build_detector(UniformOrbConfig(max_features=2000))

    straight, mirrored = detector.detect(image), detector.detect(image[::-1, ::-1].copy())

    back = np.float32([319, 239]) - mirrored.pixels
    for octave in range(8):
        a, b = straight.pixels[straight.octave == octave], back[mirrored.octave == octave]
        differences = nearest(a, b, within_px=1.5 * 1.2**octave)
        assert len(differences) > 30
        # Levels of whole pixels taken for the scale factor's put them up to a pixel apart.
        assert (np.abs(np.median(differences, axis=0)) < 0.1).all()


@pytest.mark.parametrize("kind", ["surf", "sift", "orb", "akaze"])
def test_threshold_falls_until_a_faint_image_gives_enough(kind):
    config = next(c for c in EVERY_DETECTOR if c.kind == kind)
    faint = texture(1, contrast=0.12)

    eager = build_detector(config).detect(faint)
    strict = build_detector(config.model_copy(update={"min_threshold": config.threshold})).detect(faint)

    assert len(eager) > len(strict)


def test_a_larger_limit_does_not_lower_the_threshold():
    image = texture(1)

    few, many = (build_detector(SurfConfig(max_features=n)).detect(image) for n in (1000, 5000))

    assert 300 < len(few) < 1000
    assert same(few, many)


def test_features_refuse_rows_that_differ():
    features = build_detector(OrbConfig()).detect(texture(0))

    with pytest.raises(DataError, match="descriptors"):
        Features(
            features.pixels, features.octave, features.angle_rad, features.response, features.descriptors[1:]
        )


@pytest.mark.parametrize("threshold", [7, 20])
def test_fast_corners_are_opencvs(threshold):
    image = texture(2)
    oracle = cv2.FastFeatureDetector.create(threshold, nonmaxSuppression=False).detect(image)

    rows, columns = np.nonzero(fast_scores(image, threshold, 3))

    assert {(x, y) for x, y in zip(columns, rows, strict=True)} == {k.pt for k in oracle}


def test_fast_score_is_the_last_threshold_at_which_a_corner_remains():
    image = texture(2)
    scores = fast_scores(image, 7, 3)
    y, x = np.argwhere(scores > 40)[0]

    assert fast_scores(image, int(scores[y, x]), 3)[y, x] == scores[y, x]
    assert fast_scores(image, int(scores[y, x]) + 1, 3)[y, x] == 0


def test_weak_corners_come_only_from_cells_without_strong_ones():
    scores = np.zeros((70, 70), np.uint8)
    scores[10, 10], scores[20, 20] = 30, 10  # one cell
    scores[50, 50], scores[60, 55] = 10, 9  # another

    pixels, strength = corners(scores, 20, 30, 3)

    assert pixels.tolist() == [[10, 10], [50, 50], [55, 60]]
    assert strength.tolist() == [30, 10, 9]


def test_of_equal_neighbours_one_corner_remains():
    scores = np.zeros((20, 20), np.uint8)
    scores[8, 8:10] = 15
    scores[9, 8] = 15

    assert corners(scores, 20, 30, 3)[0].tolist() == [[8, 8]]


def test_orientation_points_to_the_bright_side():
    image = np.zeros((60, 60), np.uint8)
    image[31:, :] = 200  # bright below, and rows grow downwards

    assert orientations(image, np.array([[30, 30]], np.int32))[0] == pytest.approx(np.pi / 2)


def test_quadtree_keeps_the_strongest_of_every_node():
    pixels = np.array([(1, 1), (2, 1), (90, 3), (5, 80), (95, 90), (96, 91)], np.int32)
    strength = np.array([5, 9, 4, 3, 8, 2], np.uint8)

    assert spread(pixels, strength, 100, 100, 4).tolist() == [1, 2, 3, 4]


@pytest.mark.parametrize("wanted", [1, 7, 50, 333])
def test_quadtree_never_gives_more_than_wanted_and_nearly_as_many(wanted):
    rng = np.random.default_rng(wanted)
    pixels = rng.integers(0, 640, size=(2000, 2)).astype(np.int32)

    kept = spread(pixels, rng.integers(1, 255, 2000).astype(np.uint8), 640, 640, wanted)

    assert wanted - 3 <= len(kept) <= wanted
    assert len(np.unique(kept)) == len(kept)


def test_uniform_orb_reaches_parts_that_orb_leaves_out():
    image = texture(4)
    image[:, 160:] = (128 + 0.15 * (image[:, 160:].astype(float) - 128)).astype(np.uint8)  # a dim half
    config = UniformOrbConfig(max_features=300)

    uniform = build_detector(config).detect(image)
    plain = build_detector(OrbConfig(max_features=300)).detect(image)

    assert (uniform.pixels[:, 0] > 170).mean() > 2 * (plain.pixels[:, 0] > 170).mean()
    assert (uniform.pixels[:, 0] > 170).mean() > 0.2
