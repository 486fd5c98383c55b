"""Cost of searching sessions in each other: one query per keyframe, in an index of all earlier sessions.

    python benchmarks/session_search.py [--sessions 200] [--keyframes 100]

Only descriptors are simulated: images of 1000 words drawn from the vocabulary, scans of random heights.
Verification does not grow with the number of sessions: at most 300 pairs of places for each.
"""

import argparse
from collections.abc import Callable
from time import process_time
from typing import TypeVar

import numpy as np

from mapper.places.config import ScanContextConfig
from mapper.places.index import PlaceIndex
from mapper.places.scan_context import ScanContexts, scan_context
from mapper.places.vocabulary import load_vocabulary

Place = TypeVar("Place")

_WORDS_PER_IMAGE = 1000
_POINTS_PER_SCAN = 4000
_MOST_SIMILAR = 12


def main() -> None:
    """Print the CPU seconds that all queries of so many sessions take, by sensor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--keyframes", type=int, default=100)
    arguments = parser.parse_args()
    sessions, keyframes = arguments.sessions, arguments.keyframes
    steps = [count for count in (12, 25, 50, 100, 200, 400, 800) if count <= sessions]
    images, scans = _images(steps, keyframes), _scans(steps, keyframes)
    print("| sessions | keyframes | RGB-D: all queries | one | LiDAR: all queries | one |")
    for count, (of_images, one_image), (of_scans, one_scan) in zip(steps, images, scans, strict=True):
        print(
            f"| {count} | {count * keyframes} | {of_images:.1f} s | {1e3 * one_image:.2f} ms "
            f"| {of_scans:.1f} s | {1e3 * one_scan:.2f} ms |"
        )


def _images(steps: list[int], keyframes: int) -> list[tuple[float, float]]:
    """Return ``_query_times`` of images."""
    rng, vocabulary = np.random.default_rng(0), load_vocabulary()
    index = PlaceIndex(vocabulary)
    return _query_times(
        steps,
        keyframes,
        lambda: vocabulary.vector(rng.integers(0, vocabulary.words, _WORDS_PER_IMAGE).astype(np.int32)),
        lambda vector: index.query(vector, min_similarity=0.32, min_deviations=3.0, limit=_MOST_SIMILAR),
        index.add,
    )


def _scans(steps: list[int], keyframes: int) -> list[tuple[float, float]]:
    """Return ``_query_times`` of scans."""
    rng, config = np.random.default_rng(0), ScanContextConfig()
    spread = np.array([config.reach_m / 2.0, config.reach_m / 2.0, 3.0])
    index = ScanContexts(config)
    return _query_times(
        steps,
        keyframes,
        lambda: scan_context(np.abs(rng.normal(0.0, 1.0, (_POINTS_PER_SCAN, 3))) * spread, config),
        lambda context: index.query(context, np.ones(len(index), np.bool_), limit=_MOST_SIMILAR),
        index.add,
    )


def _query_times(
    steps: list[int],
    keyframes: int,
    describe: Callable[[], Place],
    query: Callable[[Place], object],
    add: Callable[[int, Place], object],
) -> list[tuple[float, float]]:
    """Return the seconds of all queries, and of one of the last session, after so many sessions."""
    total_s, result = 0.0, []
    for session in range(max(steps)):
        places = [describe() for _ in range(keyframes)]
        start_s = process_time()
        for place in places:
            query(place)
        spent_s = process_time() - start_s
        total_s += spent_s
        for number, place in enumerate(places):
            add(session * keyframes + number, place)
        if session + 1 in steps:
            result.append((total_s, spent_s / keyframes))
    return result


if __name__ == "__main__":
    main()
