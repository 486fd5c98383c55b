"""Places recognised by visual words, and features matched under them."""

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.features.config import UniformOrbConfig
from mapper.features.factory import build_detector
from mapper.features.hamming import match_mutual_bits, pack
from mapper.places.config import PlacesConfig, VocabularyConfig
from mapper.places.index import PlaceIndex, match_by_word
from mapper.places.training import train
from mapper.places.vocabulary import ONE, WordVector, load_vocabulary
from mapper.simulation import CameraSimulator
from mapper.simulation.config import SynthConfig
from tests.support.descriptors import noisy, random_bits

MATCHING = {"max_hamming": 64, "max_ratio": 0.85}


@pytest.fixture(scope="module")
def vocabulary():
    rng = np.random.default_rng(0)
    images = [random_bits(rng, 40) for _ in range(10)]
    return train(images, config=VocabularyConfig(branching=5, levels=3), trained_on="noise", rng=rng)


@pytest.fixture(scope="module")
def vectors(vocabulary):
    """Of 600 images of 30 words each: enough for the index to grow twice."""
    rng = np.random.default_rng(1)
    return [vocabulary.vector(rng.integers(0, vocabulary.words, 30)) for _ in range(600)]


@pytest.fixture(scope="module")
def index(vocabulary, vectors):
    index = PlaceIndex(vocabulary)
    for number, vector in enumerate(vectors):
        index.add(1000 + number, vector)
    return index


def similarity(a, b, words):
    """Equation 10 of Zhao et al. 2020, in whole units of a weight."""
    f_a, f_b = np.zeros((2, words), np.int64)
    f_a[a.ids], f_b[b.ids] = a.weights, b.weights
    return (abs(f_a) + abs(f_b) - abs(f_a - f_b)).sum() / 2 / ONE


@pytest.mark.parametrize("before", [None, 0, 1, 300, 599, 10_000])
@pytest.mark.parametrize("min_similarity", [0.0, 0.3])
def test_a_query_equals_comparing_with_everything(vocabulary, index, vectors, before, min_similarity):
    for asked in vectors[:5]:
        scores = [similarity(asked, vector, vocabulary.words) for vector in vectors[:before]]
        expected = [(1000 + i, s) for i, s in enumerate(scores) if s >= min_similarity and s > 0]
        expected.sort(key=lambda pair: (-pair[1], pair[0]))

        found = index.query(asked, min_similarity=min_similarity, limit=10, before=before)

        assert found == expected[:10]


def test_an_outstanding_place_is_found_at_any_similarity(vocabulary, index, vectors):
    strangers = np.setdiff1d(np.arange(vocabulary.words), vectors[7].ids)[:12]
    mixed = vocabulary.vector(np.concatenate([vectors[7].ids[:18], strangers]))
    assert index.query(mixed, min_similarity=0.9, limit=3) == []
    assert index.query(mixed, min_similarity=0.9, limit=1, min_deviations=3.0)[0][0] == 1007
    assert index.query(mixed, min_similarity=0.9, limit=1, min_deviations=50.0) == []


def test_among_a_few_places_none_is_outstanding(index, vectors):
    assert index.query(vectors[5], min_similarity=1.1, limit=1, min_deviations=0.0, before=29) == []
    assert index.query(vectors[5], min_similarity=1.1, limit=1, min_deviations=0.0, before=30)


def test_of_equals_the_earlier_comes_first(vocabulary, vectors):
    index = PlaceIndex(vocabulary)
    for node in (7, 3, 5):
        index.add(node, vectors[0])
    assert [node for node, _ in index.query(vectors[0], min_similarity=0.5, limit=2)] == [7, 3]


def test_an_image_without_features_is_similar_to_none(vocabulary, vectors):
    index = PlaceIndex(vocabulary)
    blank = vocabulary.vector(np.empty(0, np.int32))
    index.add(0, blank)
    index.add(1, vectors[0])
    assert len(index) == 2
    assert index.query(blank, min_similarity=0.0, limit=5) == []
    assert index.query(vectors[0], min_similarity=0.0, limit=5) == [(1, 1.0)]


def test_what_does_not_belong_is_refused(vocabulary, vectors):
    index = PlaceIndex(vocabulary)
    index.add(4, vectors[0])
    foreign = WordVector(np.array([vocabulary.words], np.int32), np.array([ONE], np.uint16))
    with pytest.raises(DataError, match="node 4 is in it already"):
        index.add(4, vectors[1])
    for use in (lambda: index.add(5, foreign), lambda: index.query(foreign, min_similarity=0.1, limit=1)):
        with pytest.raises(DataError, match=f"word {vocabulary.words} of another vocabulary"):
            use()
    assert len(index) == 1


def test_matching_under_the_root_is_matching_everywhere():
    rng = np.random.default_rng(2)
    a = random_bits(rng, 80)
    b = noisy(a, 30, rng)[rng.permutation(80)[:60]]
    root_a, root_b = np.zeros(80, np.int32), np.zeros(60, np.int32)

    matched = match_by_word(a, root_a, b, root_b, **MATCHING)

    assert (matched >= 0).sum() == 60
    assert (matched == match_mutual_bits(a, b, *MATCHING.values())).all()


def test_only_what_shares_a_node_is_compared():
    rng = np.random.default_rng(3)
    bits = random_bits(rng, 30)
    order = rng.permutation(30)
    nodes = rng.integers(0, 4, 30).astype(np.int32)
    moved = nodes.copy()
    moved[:10] += 4  # seen under another node the second time

    matched = match_by_word(bits, nodes, bits[order], moved[order], **MATCHING)

    assert (matched[:10] == -1).all()
    assert (order[matched[10:]] == np.arange(10, 30)).all()


def test_guided_matches_are_mutual_and_unambiguous():
    rng = np.random.default_rng(4)
    one = random_bits(rng, 1)
    twins = np.concatenate([noisy(one, 4, rng), noisy(one, 12, rng)])
    near, two = np.zeros(1, np.int32), np.zeros(2, np.int32)
    assert match_by_word(twins, two, one, near, **MATCHING).tolist() == [0, -1]
    equal = np.concatenate([one, one])
    assert match_by_word(noisy(one, 9, rng), near, equal, two, **MATCHING).tolist() == [-1]
    assert match_by_word(one, near, one[:0], near[:0], **MATCHING).tolist() == [-1]
    assert match_by_word(one[:0], near[:0], one, near, **MATCHING).tolist() == []


@pytest.fixture(scope="module")
def two_laps():
    """Twice round a flat that the vocabulary was not trained on: truth, and each frame's descriptors."""
    config = SynthConfig(
        seed=5, laps=2.0, frame_rate_hz=0.5, width_px=320, height_px=240, texture_px_per_m=128
    )
    source, detector = CameraSimulator(config).log(), build_detector(UniformOrbConfig())
    bits = [pack(detector.detect(entry.load(colour=False).gray).descriptors) for entry in source.entries()]
    return source.truth.T_world_body, bits


def test_the_shipped_vocabulary_recognises_a_place(two_laps):
    T_world_camera, bits = two_laps
    vocabulary = load_vocabulary()
    index = PlaceIndex(vocabulary)
    similarities = []
    for i, image in enumerate(bits):
        vector = vocabulary.vector(vocabulary.words_of(image))
        before = max(i - 3, 0)
        offset_m = np.linalg.norm(T_world_camera[:before, :3, 3] - T_world_camera[i, :3, 3], axis=1)
        cosine = T_world_camera[:before, :3, 2] @ T_world_camera[i, :3, 2]
        is_here = (offset_m < 0.5) & (cosine > np.cos(np.radians(20.0)))
        if is_here.any():
            ((place, likeness),) = index.query(vector, min_similarity=0.0, limit=1, before=before)
            assert is_here[place], f"frame {i} is taken for frame {place}"
            similarities.append(likeness)
        index.add(i, vector)
    assert len(similarities) >= 8
    assert np.mean(np.array(similarities) >= PlacesConfig().min_similarity) > 0.75


def test_guided_matches_of_images_agree_with_everywhere_s(two_laps):
    T_world_camera, bits = two_laps
    vocabulary = load_vocabulary()
    distance_m = np.linalg.norm(T_world_camera[0, :3, 3] - T_world_camera[4:, :3, 3], axis=1)
    a, b = bits[0], bits[4 + int(distance_m.argmin())]
    everywhere = match_mutual_bits(a, b, *MATCHING.values())

    nodes = (vocabulary.ancestors_of(vocabulary.words_of(image), level=1) for image in (a, b))
    guided = match_by_word(a, next(nodes), b, next(nodes), **MATCHING)

    both = (guided >= 0) & (everywhere >= 0)
    assert both.sum() > 0.6 * (everywhere >= 0).sum()
    assert (guided[both] == everywhere[both]).mean() > 0.95
