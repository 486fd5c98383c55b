"""Descriptors of a log's images, from which a vocabulary is trained."""

from itertools import compress

import numpy as np

from mapper.core.errors import FrameError, VocabularyError
from mapper.core.frames import RgbdFrame
from mapper.features.factory import build_detector
from mapper.features.hamming import Bits, pack
from mapper.places.config import VocabularyConfig
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import FrameRef, Log, Skipped

_WORKERS = 2


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
        for done, result in enumerate(ordered_map(detect, entries, workers=_WORKERS), start=1):
            report(done, total)
            if isinstance(result, Skipped):
                progress.note(f"skipped: {result.reason}")
            else:
                images.append(result)
    return images
