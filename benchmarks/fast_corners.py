"""FAST corners with two thresholds: the kernels of uniform ORB compared with OpenCV's detector.

    python benchmarks/fast_corners.py [--data ../shared/data] [--images 20]

CPU milliseconds of one thread per 640×480 image of fr1/xyz, at the finest level of its pyramid, and how many
corners are the same.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.features.config import UniformOrbConfig
from mapper.features.fast import RADIUS_PX, Pixels, corners, fast_scores

CONFIG = UniformOrbConfig()
MARGIN_PX = 19


def ours(gray: Image) -> Pixels:
    """Return the corners by ``mapper.features.fast``."""
    scores = fast_scores(gray, CONFIG.min_threshold, MARGIN_PX)
    return corners(scores, CONFIG.threshold, CONFIG.cell_px, MARGIN_PX)[0]


def opencv_at_once(gray: Image) -> Pixels:
    """Return the corners at the lower threshold; choosing among those of each cell would come on top."""
    return _pixels(cv2.FastFeatureDetector.create(CONFIG.min_threshold).detect(gray))


def opencv_by_cell(gray: Image) -> Pixels:
    """Return the corners of each cell at the lower threshold where the higher finds none, as published."""
    thresholds = CONFIG.threshold, CONFIG.min_threshold
    strict, lenient = (cv2.FastFeatureDetector.create(threshold) for threshold in thresholds)
    rows, columns = (range(MARGIN_PX, size - MARGIN_PX, CONFIG.cell_px) for size in gray.shape)
    found = []
    for top in rows:
        for left in columns:
            bottom, right = min(top + CONFIG.cell_px, rows.stop), min(left + CONFIG.cell_px, columns.stop)
            cell = gray[top - RADIUS_PX : bottom + RADIUS_PX, left - RADIUS_PX : right + RADIUS_PX]
            origin = np.array([left, top]) - RADIUS_PX
            found.append(origin + _pixels(strict.detect(cell) or lenient.detect(cell)))
    return np.concatenate(found)


def _pixels(keypoints: "tuple[cv2.KeyPoint, ...]") -> NDArray[np.int64]:
    return np.reshape(cv2.KeyPoint.convert(keypoints), (-1, 2)).astype(np.int64)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--images", type=int, default=20)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    files = sorted((arguments.data / "tum_fr1_xyz/rgb").iterdir())[: 10 * arguments.images : 10]
    images = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    usual = [set(map(tuple, ours(gray).tolist())) for gray in images]
    for method in (ours, opencv_at_once, opencv_by_cell):
        times_ms, same, count = [], 0, 0
        for gray, before in zip(images, usual, strict=True):
            began = time.process_time()
            pixels = method(gray)
            times_ms.append(1e3 * (time.process_time() - began))
            same += len(before & set(map(tuple, pixels.tolist())))
            count += len(pixels)
        print(f"{method.__name__:16} {np.median(times_ms):6.2f} ms  {count} corners, {same} as ours")


if __name__ == "__main__":
    main()
