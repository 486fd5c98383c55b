"""Training of a vocabulary by hierarchical k-means++ on bits (Nistér & Stewénius 2006)."""

from collections.abc import Sequence
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, VocabularyError
from mapper.core.frames import RgbdFrame
from mapper.features.factory import build_detector
from mapper.features.hamming import Bits, pack
from mapper.places.config import VocabularyConfig
from mapper.places.kernels import k_majority, seed_centres
from mapper.places.vocabulary import Vocabulary, WordTree
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import FrameRef, Log, Skipped

MIN_IMAGES = 2
"""With one image every word would be in all images and weigh nothing."""


def descriptors_of(source: Log, config: VocabularyConfig, *, progress: Progress = SILENT) -> list[Bits]:
    """Return (N_i, 4) uint64 descriptors of each of up to ``frames_per_log`` evenly spaced frames.

    Frames that cannot be read are reported and left out.

    Raises:
        VocabularyError: The log has no images.
    """
    detector = build_detector(config.detector)

    def detect(entry: FrameRef) -> Bits | Skipped:
        try:
            frame = entry.load(colour=False)
        except FrameError as error:
            return Skipped(entry.stamp_ns, str(error))
        if not isinstance(frame, RgbdFrame):
            raise VocabularyError(f"{source.path}: holds scans without images, and only images have words")
        return pack(detector.detect(frame.gray).descriptors)

    is_used = np.zeros(len(source), bool)
    is_used[np.linspace(0, len(source) - 1, config.frames_per_log).round().astype(np.intp)] = True
    total = int(is_used.sum())
    images: list[Bits] = []
    with progress.stage("detect") as report:
        entries = compress(source.entries(), is_used)
        for done, result in enumerate(ordered_map(detect, entries), start=1):
            report(done, total)
            if isinstance(result, Skipped):
                progress.note(f"skipped: {result.reason}")
            else:
                images.append(result)
    return images


def train(
    images: Sequence[Bits],
    *,
    config: VocabularyConfig,
    trained_on: str,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> Vocabulary:
    """Return a vocabulary of the images' descriptors, weighted by inverse document frequency.

    Args:
        images: (N_i, 4) uint64 descriptors of each image.
        config: Shape of the tree.
        trained_on: One line that describes the images.
        rng: Source of the seeds of k-means++.
        progress: Receiver of progress reports.

    Raises:
        VocabularyError: Fewer than two images have descriptors.
    """
    images = [bits for bits in images if len(bits)]
    if len(images) < MIN_IMAGES:
        raise VocabularyError(
            f"nothing to train on: {len(images)} images have features, want at least {MIN_IMAGES}"
        )
    tree = grow(np.concatenate(images), config=config, rng=rng, progress=progress)
    return Vocabulary(tree, _inverse_document_frequency(tree, images), trained_on)


def grow(
    bits: Bits, *, config: VocabularyConfig, rng: np.random.Generator, progress: Progress = SILENT
) -> WordTree:
    """Return the tree of clusters of (N, 4) descriptors, split level by level."""
    centres, children = [np.zeros((1, 4), np.uint64)], []
    clusters = [np.arange(len(bits))]
    with progress.stage("cluster") as report:
        for level in range(config.levels):
            parts: list[NDArray[np.intp]] = []
            done = level * len(bits)
            for members in clusters:
                middles, split = _split(bits, members, config=config, rng=rng)
                centres.append(middles)
                children.append(len(split))
                parts += split
                done += len(members)
                report(done, config.levels * len(bits))
            clusters = parts
    children += [0] * len(clusters)
    return WordTree(np.concatenate(centres), np.array(children, np.uint8))


def _split(
    bits: Bits, members: NDArray[np.intp], *, config: VocabularyConfig, rng: np.random.Generator
) -> tuple[Bits, list[NDArray[np.intp]]]:
    """Return the centres and the members of a cluster's parts; none if all members are equal."""
    own = bits[members]
    seeds = seed_centres(own, rng.random(config.branching))
    if len(seeds) == 1:
        return seeds[:0], []
    centres, cluster = k_majority(own, seeds, config.max_iterations)
    kept, sizes = np.unique(cluster, return_counts=True)
    order = np.argsort(cluster, kind="stable")
    return centres[kept], np.split(members[order], np.cumsum(sizes)[:-1])


def _inverse_document_frequency(tree: WordTree, images: Sequence[Bits]) -> NDArray[np.float64]:
    """Return (W,) ln(N / N_w) for N images, of which N_w have the word; at least one counts."""
    having = np.zeros(len(tree.leaves), np.int64)
    for bits in images:
        having[np.unique(tree.words_of(bits))] += 1
    return np.log(len(images) / np.maximum(having, 1))
