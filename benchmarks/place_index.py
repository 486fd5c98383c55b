"""Place recognition: queries against the number of keyframes, words per image, matching guided by words.

    python benchmarks/place_index.py [--keyframes 10000] [--features 1000] [--data ../shared/data]

Times are CPU time. Keyframes are bags of words drawn as often as the shipped vocabulary's training images had
them; queries look like the first keyframes again, and have to find them. The peer of the index is a
scan of all vectors with the compiled ``similarity``; matching by word is compared with ``match_mutual_bits``
on neighbouring frames of fr1/xyz, or of a synthetic walk where that is missing.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mapper.features.config import UniformOrbConfig
from mapper.features.factory import build_detector
from mapper.features.hamming import Bits, match_mutual_bits, pack
from mapper.places.config import PlacesConfig
from mapper.places.index import PlaceIndex
from mapper.places.vocabulary import Vocabulary, WordVector, load_vocabulary, similarity
from mapper.places.word_matching import match_by_word
from mapper.simulation import CameraSimulator
from mapper.simulation.config import SynthConfig
from mapper.sources import open_source
from mapper.sources.config import SourceConfig

QUERIES = 20
SEEN_AGAIN_RATIO = 0.5  # of a revisit's words, as measured on synthetic revisits
PAIRS = 20
MAX_HAMMING, MAX_RATIO = 64, 0.85


def cpu_ms(work: Callable[[], object]) -> float:
    """Return the CPU milliseconds of a call."""
    began = time.process_time()
    work()
    return 1e3 * (time.process_time() - began)


def likely_words(vocabulary: Vocabulary) -> np.ndarray:
    """Return how likely each word is, from the share of training images that had it (Poisson)."""
    rate = -np.log1p(-np.minimum(np.exp(-vocabulary.idf), 0.99))
    return rate / rate.sum()


def walk(vocabulary: Vocabulary, keyframes: int, features: int) -> tuple[list[WordVector], list[WordVector]]:
    """Return keyframes, and revisits that share half of their words with the first ones."""
    rng = np.random.default_rng(0)
    likely, shape = likely_words(vocabulary), (keyframes + QUERIES, features)
    words = rng.choice(vocabulary.words, shape, p=likely).astype(np.int32)
    shared = round(SEEN_AGAIN_RATIO * features)
    words[keyframes:, :shared] = words[:QUERIES, :shared]
    vectors = [vocabulary.vector(image) for image in words]
    return vectors[:keyframes], vectors[keyframes:]


def compare_queries(vocabulary: Vocabulary, keyframes: int, features: int) -> None:
    """Print a line per size of the index."""
    vectors, revisits = walk(vocabulary, keyframes, features)
    index = PlaceIndex(vocabulary)
    print(f"{'keyframes':>10} {'add ms':>8} {'query ms':>9} {'scan ms':>9} {'ratio':>7} {'found':>6}")
    for size in (QUERIES, 100, 300, 1000, 3000, 10_000, 30_000):
        if size > keyframes:
            break
        more = vectors[len(index) : size]
        add_ms = cpu_ms(lambda more=more: add_all(index, more)) / len(more)
        query_ms = cpu_ms(lambda: [ask(index, vector) for vector in revisits]) / QUERIES
        some = revisits[: max(QUERIES * 300 // size, 2)]
        scan_ms = cpu_ms(lambda some=some, size=size: [scan(vectors[:size], one) for one in some]) / len(some)
        best = [ask(index, vector)[0] for vector in revisits]
        for vector, answer in zip(some, best, strict=False):  # the same answer, or the times mean nothing
            scores = scan(vectors[:size], vector)
            if answer != (int(np.argmax(scores)), max(scores)):
                raise SystemExit(f"{size} keyframes: the index says {answer}, the scan {max(scores)}")
        if size == QUERIES:  # what came before was compiled
            continue
        found = sum(answer[0] == i for i, answer in enumerate(best))
        print(
            f"{size:10} {add_ms:8.3f} {query_ms:9.3f} {scan_ms:9.2f} {scan_ms / query_ms:6.1f}× "
            f"{found:3}/{QUERIES}"
        )


def add_all(index: PlaceIndex, vectors: list[WordVector]) -> None:
    """Add vectors under their number."""
    for vector in vectors:
        index.add(len(index), vector)


def ask(index: PlaceIndex, vector: WordVector) -> list[tuple[int, float]]:
    """Query as loop closure does."""
    return index.query(vector, min_similarity=PlacesConfig().min_similarity, limit=4)


def scan(vectors: list[WordVector], vector: WordVector) -> list[float]:
    """Compare with every vector."""
    return [similarity(vector, other) for other in vectors]


def frames(data: Path) -> tuple[str, list[Bits]]:
    """Return where pairs of neighbouring frames come from, and their descriptors, pair after pair."""
    if (data / "rgb.txt").exists():
        entries = list(open_source(data, SourceConfig(stride=10)).entries())
    else:
        config = SynthConfig(seed=3, frame_rate_hz=3.0, duration_s=15.0)
        entries = list(CameraSimulator(config).log().entries())
    detector = build_detector(UniformOrbConfig())
    chosen = [entries[i * (len(entries) - 2) // PAIRS + j] for i in range(PAIRS) for j in range(2)]
    return data.name, [pack(detector.detect(entry.load(colour=False).gray).descriptors) for entry in chosen]


def compare_matching(vocabulary: Vocabulary, bits: list[Bits]) -> None:
    """Print the time of words and, per level, time and recall of guided matching."""
    vocabulary.words_of(bits[0][:1])  # compiled now, not when it is timed
    match_mutual_bits(bits[0][:1], bits[1], MAX_HAMMING, MAX_RATIO)
    words_ms = cpu_ms(lambda: [vocabulary.words_of(image) for image in bits]) / len(bits)
    print(f"words of {len(bits[0])} descriptors: {words_ms:.3f} ms")
    pairs = list(zip(bits[::2], bits[1::2], strict=True))
    everywhere = [match_mutual_bits(a, b, MAX_HAMMING, MAX_RATIO) for a, b in pairs]
    all_ms = cpu_ms(lambda: [match_mutual_bits(a, b, MAX_HAMMING, MAX_RATIO) for a, b in pairs]) / len(pairs)
    total = sum(int((matched >= 0).sum()) for matched in everywhere)
    print(f"{'matching':>10} {'ms':>8} {'faster':>8} {'matches':>8} {'recall':>7} {'same':>6}")
    print(f"{'everywhere':>10} {all_ms:8.3f} {'':8} {total:8}")
    for level in range(1, vocabulary.levels + 1):
        nodes = [vocabulary.ancestors_of(vocabulary.words_of(image), level=level) for image in bits]
        sides = list(zip(bits[::2], nodes[::2], bits[1::2], nodes[1::2], strict=True))

        def guided(sides=sides) -> list[np.ndarray]:
            return [match_by_word(*side, max_hamming=MAX_HAMMING, max_ratio=MAX_RATIO) for side in sides]

        matched = guided()
        level_ms = cpu_ms(guided) / len(pairs)
        found = sum(int((m >= 0).sum()) for m in matched)
        same = sum(int(((m == e) & (m >= 0)).sum()) for m, e in zip(matched, everywhere, strict=True))
        print(
            f"{f'level {level}':>10} {level_ms:8.3f} {all_ms / level_ms:7.1f}× {found:8} "
            f"{same / total:6.1%} {same / found:6.1%}"
        )


def main() -> None:
    """Query, match, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--features", type=int, default=1000)
    shared = Path(__file__).parents[2] / "shared/data/tum_fr1_xyz"
    parser.add_argument("--data", type=Path, default=shared, help="log whose frames are matched")
    arguments = parser.parse_args()
    vocabulary = load_vocabulary()
    name, bits = frames(arguments.data)
    print(f"{PAIRS} pairs of {name}")
    compare_matching(vocabulary, bits)
    compare_queries(vocabulary, arguments.keyframes, arguments.features)


if __name__ == "__main__":
    main()
