"""Mutual nearest neighbours, the ratio test and the homography filter."""

import cv2
import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.features.base import Features
from mapper.features.hamming import match_mutual_bits, pack
from mapper.features.matching import homography_inliers, match_mutual


def features(descriptors: np.ndarray) -> Features:
    n = len(descriptors)
    zeros = np.zeros(n, np.float32)
    return Features(np.zeros((n, 2), np.float32), np.zeros(n, np.int32), zeros, zeros, descriptors)


def random_bits(seed: int, n: int, width: int = 32) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, width), dtype=np.uint8)


def random_numbers(seed: int, n: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 64)).astype(np.float32)


def brute_force(distances: np.ndarray, max_ratio: float) -> list[list[int]]:
    pairs = []
    for i, row in enumerate(distances):
        j = int(row.argmin())
        second = np.partition(row, 1)[1]
        if row[j] < max_ratio * second and int(distances[:, j].argmin()) == i:
            pairs.append([i, j])
    return pairs


@pytest.mark.parametrize("width", [32, 61], ids=["orb", "akaze"])
@pytest.mark.parametrize("max_ratio", [0.8, 0.95, 1.0])
def test_bits_match_like_the_definition(width, max_ratio):
    a, b = random_bits(0, 90, width), random_bits(1, 70, width)
    distances = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2).astype(float)

    pairs = match_mutual(features(a), features(b), max_ratio=max_ratio)

    assert pairs.tolist() == brute_force(distances, max_ratio)
    assert max_ratio < 0.9 or len(pairs) > 3


@pytest.mark.parametrize(("max_ratio", "max_hamming"), [(0.95, 256), (0.99, 104)])
def test_packed_bits_match_like_the_definition_up_to_a_distance(max_ratio, max_hamming):
    a, b = random_bits(0, 90), random_bits(1, 70)
    distances = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2).astype(float)
    wanted = [(i, j) for i, j in brute_force(distances, max_ratio) if distances[i, j] <= max_hamming]

    partner = match_mutual_bits(pack(a), pack(b), max_hamming, max_ratio)

    assert [(i, j) for i, j in enumerate(partner.tolist()) if j >= 0] == wanted
    assert len(wanted) > 3


@pytest.mark.parametrize("max_ratio", [0.8, 0.95, 1.0])
def test_numbers_match_like_the_definition(max_ratio):
    a, b = random_numbers(0, 90), random_numbers(1, 70)
    distances = np.linalg.norm(a[:, None].astype(float) - b[None], axis=2)

    pairs = match_mutual(features(a), features(b), max_ratio=max_ratio)

    assert pairs.tolist() == brute_force(distances, max_ratio)


@pytest.mark.parametrize("make", [random_bits, random_numbers], ids=["bits", "numbers"])
def test_a_shuffled_copy_is_matched_completely(make):
    descriptors = make(2, 200)
    order = np.random.default_rng(3).permutation(200)

    pairs = match_mutual(features(descriptors), features(descriptors[order]), max_ratio=0.8)

    assert len(pairs) == 200
    assert (order[pairs[:, 1]] == pairs[:, 0]).all()


def test_a_repeated_pattern_has_no_matches():
    descriptors = random_bits(4, 50)
    doubled = np.vstack([descriptors, descriptors])

    assert len(match_mutual(features(descriptors), features(doubled), max_ratio=0.9)) == 0


def test_nothing_matches_nothing():
    none, some = features(random_bits(0, 0)), features(random_bits(0, 5))

    assert match_mutual(none, some, max_ratio=0.8).shape == (0, 2)
    assert match_mutual(some, none, max_ratio=0.8).shape == (0, 2)


def test_descriptors_of_two_detectors_are_refused():
    with pytest.raises(DataError, match="different kinds"):
        match_mutual(features(random_bits(0, 5)), features(random_numbers(0, 5)), max_ratio=0.8)


def test_homography_separates_true_pairs_from_false_ones():
    rng = np.random.default_rng(5)
    H = np.array([[1.02, 0.05, 8.0], [-0.04, 0.98, -5.0], [1e-5, 2e-5, 1.0]])
    a = rng.uniform(0, 600, (200, 2))
    mapped = np.column_stack([a, np.ones(200)]) @ H.T
    b = mapped[:, :2] / mapped[:, 2:]
    b[120:] = rng.uniform(0, 600, (80, 2))

    mask = homography_inliers(a.astype(np.float32), b.astype(np.float32))
    again = homography_inliers(a.astype(np.float32), b.astype(np.float32))

    assert mask[:120].all()
    assert mask[120:].sum() <= 2
    assert (mask == again).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_another_seed_is_another_sample_of_the_same_pairs(seed):
    rng = np.random.default_rng(6)
    a = rng.uniform(0, 600, (200, 2)).astype(np.float32)
    b = (a + np.array([20.0, 5.0]) + rng.normal(0.0, 2.0, a.shape)).astype(np.float32)
    b[120:] = rng.uniform(0, 600, (80, 2))
    _, plain = cv2.findHomography(a, b, cv2.RANSAC, 4.0, maxIters=2000, confidence=0.995)

    mask = homography_inliers(a, b, seed=seed)

    assert mask[:120].mean() > 0.6
    assert mask[120:].mean() < 0.1
    assert (mask == plain.ravel()).all() == (seed == 0)


def test_three_pairs_make_no_homography():
    pixels = np.float32([[0, 0], [1, 0], [0, 1]])

    assert not homography_inliers(pixels, pixels).any()
