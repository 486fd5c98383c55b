"""Windowed and exhaustive matching of binary descriptors."""

import numpy as np
import pytest

from mapper.features.hamming import hamming, match_mutual_bits, pack
from mapper.features.window_matching import GridFeatures, SearchWindows, match_windows, sort_into_grid

WIDTH, HEIGHT = 320, 240


@pytest.fixture
def scene():
    """Features at random pixels with random descriptors, sorted by cell."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform([0, 0], [WIDTH, HEIGHT], (400, 2))
    order, grid = sort_into_grid(pixels, width_px=WIDTH, height_px=HEIGHT)
    words = pack(rng.integers(0, 256, (400, 32), dtype=np.uint8))
    return pixels[order], rng.integers(0, 4, 400).astype(np.int32), words, grid


def search(scene, predicted, octave, words, *, radius_px=5.0, taken=None, max_hamming=64, max_ratio=0.9):
    pixels, octaves, features, grid = scene
    taken = np.zeros(len(pixels), bool) if taken is None else taken
    radii = np.full(len(predicted), radius_px)
    windows = SearchWindows(predicted, radii, octave, words)
    return match_windows(
        windows, GridFeatures(pixels, octaves, features, grid), taken, max_hamming, max_ratio
    )


def flipped(words, bits, rng):
    noisy = words.copy()
    for row in noisy:
        for bit in rng.choice(256, bits, replace=False):
            row[bit // 64] ^= np.uint64(1) << np.uint64(bit % 64)
    return noisy


def test_hamming_counts_differing_bits():
    rng = np.random.default_rng(0)
    a = rng.integers(0, 256, (5, 32), dtype=np.uint8)
    b = rng.integers(0, 256, (5, 32), dtype=np.uint8)
    for i in range(5):
        assert hamming(pack(a), i, pack(b), i) == np.unpackbits(a[i] ^ b[i]).sum()


def test_every_feature_is_found_near_its_own_pixel(scene):
    pixels, octave, words, _ = scene
    rng = np.random.default_rng(1)

    matched = search(scene, pixels + rng.uniform(-3, 3, pixels.shape), octave, flipped(words, 20, rng))

    assert (matched == np.arange(len(pixels))).all()


def test_a_feature_outside_the_window_or_octave_is_not_found(scene):
    pixels, octave, words, _ = scene
    assert (search(scene, pixels + np.array([8.0, 0.0]), octave, words) != np.arange(len(pixels))).all()
    assert (search(scene, pixels, octave + 2, words) != np.arange(len(pixels))).all()


def test_taken_features_are_left_alone(scene):
    pixels, octave, words, _ = scene
    taken = np.arange(len(pixels)) % 2 == 0
    matched = search(scene, pixels, octave, words, taken=taken)
    assert (matched[taken] == -1).all()
    assert (matched[~taken] == np.flatnonzero(~taken)).all()


def test_the_closer_of_two_rivals_gets_the_feature(scene):
    pixels, octave, words, _ = scene
    rng = np.random.default_rng(2)
    rivals = np.concatenate(
        [flipped(words[:1], 12, rng), flipped(words[:1], 3, rng), flipped(words[:1], 25, rng)]
    )

    matched = search(scene, np.repeat(pixels[:1], 3, axis=0), np.repeat(octave[:1], 3), rivals)

    assert matched.tolist() == [-1, 0, -1]


def test_pixels_outside_the_image_are_in_the_border_cells():
    pixels = np.array([[-3.0, 5.0], [WIDTH + 9.0, HEIGHT + 9.0], [50.0, 50.0]])
    order, grid = sort_into_grid(pixels, width_px=WIDTH, height_px=HEIGHT)
    assert sorted(order) == [0, 1, 2]
    assert grid.start[-1] == 3


def test_exhaustive_matching_is_mutual_and_survives_noise():
    rng = np.random.default_rng(4)
    words = pack(rng.integers(0, 256, (200, 32), dtype=np.uint8))
    shuffled = rng.permutation(200)

    matched = match_mutual_bits(words, flipped(words, 25, rng)[shuffled], 64, 0.85)

    assert (shuffled[matched] == np.arange(200)).all()


def test_exhaustive_matching_refuses_what_is_not_there():
    rng = np.random.default_rng(5)
    a = pack(rng.integers(0, 256, (50, 32), dtype=np.uint8))
    b = pack(rng.integers(0, 256, (50, 32), dtype=np.uint8))
    assert (match_mutual_bits(a, b, 64, 0.85) == -1).all()
    assert match_mutual_bits(a, b[:0], 64, 0.85).tolist() == [-1] * 50


@pytest.mark.parametrize("place", [(-3e4, 100.0), (3e4, 100.0), (100.0, -3e4), (100.0, 3e4), (-1e6, -1e6)])
def test_what_is_predicted_far_outside_the_image_reads_nothing(scene, place):
    """Interpreted, as compiled code would read out of bounds without a word."""
    pixels, octave, words, grid = scene
    windows = SearchWindows(np.array([place]), np.array([30.0]), octave[:1], words[:1])
    features = GridFeatures(pixels, octave, words, grid)
    matched = match_windows.py_func(windows, features, np.zeros(len(pixels), bool), 64, 0.9)
    assert matched.tolist() == [-1]
