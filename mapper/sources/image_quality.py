"""Quality of an RGB-D log's images for tracking: blur, exposure, and how much neighbouring ones share."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image, RgbdFrame
from mapper.core.geometry import spread_indices
from mapper.runtime.ordered_map import ordered_map

_WIDTH_PX, _SMALL_PX = 640, 320
"""Widths to which images are reduced: for their edges, and for features. Narrower ones are not judged."""
_EVERY_LINE, _ALONG_PX, _LEAST_STEP, _FEWEST_PX = 4, 31, 40, 200
"""Rows and columns whose edges are measured, the length along them in which an edge is one, its grey levels,
and pixels by edges without which an image has none."""
_BLURRED, _MOST_BLURRED = 1.0 / 80.0, 0.3
"""Width of edges in that of the image from which it is blurred: 1/110 at most in real logs. Moved by 15 px of
640 while it is exposed, 1/65: ATE of fr1_xyz 4.8 → 5.1 mm, of fr3_teddy 4.3 → 6.9; by 25 px 6.4 and 10.4."""
_SATURATED_LEVEL, _MOST_SATURATED = 250, 0.4
"""A JPEG's white is not 255. Saturated pixels, share of an image: at most 0.24 in real logs; 0.44 with twice
the light and 0.64 to 0.81 with four times (ATE of fr1_xyz 4.8 → 7.0 mm)."""
_BRIGHTEST_PERCENT, _LEAST_BRIGHT = 95.0, 50.0
"""Grey level that the brightest twentieth exceeds: 190 and more in real logs, 65 to 82 with a third of the
light, and 32 to 41 with a sixth (ATE of fr1_xyz 4.8 → 7.7 mm, of fr3_teddy 4.3 → 9.2)."""
_PAIRS, _FEWEST_MATCHES, _FEWEST_FEATURES, _AGREE_PX = 40, 12, 100, 8.0
"""Pairs of neighbouring images, and matches that agree on one motion, to within parallax, by which an overlap
is known; a pair with features and without these shares nothing, and one without features is not judged."""
_LOW_PERCENT, _LEAST_OVERLAP = 20.0, 0.73
"""Overlap that a fifth of the pairs stay below: fr3_cabinet at 1.5 Hz 0.86, and every 10th frame of fr1_xyz
and fr3_teddy 0.77, which are tracked as well as all; of every 20th 0.59 (ATE 4.8 → 23 mm) and 0.69 (lost)."""


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """What the images of a log are like.

    Attributes:
        looked_at: Number of images.
        edges_px: Median width of their edges, pixels of the image; None where none has any.
        blurred: Number of images whose edges are wider than a sharp image's.
        saturated: Share of the pixels that are white, of the median image.
        brightest: Grey level of 255 that the brightest twentieth of the pixels exceeds, in the median image.
        overlap: Share of the view that neighbouring images have in common, median; None where unknown.
        least_overlap: The least of it.
        least_overlap_frame: First frame of that pair.
        advice: Sentences on what to record in another way next time.
    """

    looked_at: int
    edges_px: float | None
    blurred: int
    saturated: float
    brightest: float
    overlap: float | None
    least_overlap: float | None
    least_overlap_frame: int | None
    advice: tuple[str, ...]


class ImageChecks:
    """Measurements on the images of a log that are loaded, in any thread and any order."""

    def __init__(self, frames: int) -> None:
        """Start with none of ``frames`` images."""
        self._firsts = spread_indices(max(frames - 1, 0), _PAIRS).tolist()
        self._wanted = {k for first in self._firsts for k in (first, first + 1)}
        self._measured: dict[int, tuple[float, float, float, float]] = {}
        self._small: dict[int, Image] = {}

    @property
    def missing(self) -> list[int]:
        """Frames of pairs that were not loaded yet; none where no image is judged."""
        return sorted(self._wanted - self._measured.keys()) if self._measured else []

    def add(self, index: int, frame: RgbdFrame) -> None:
        """Measure frame ``index`` of the log."""
        gray = frame.gray
        if gray.shape[1] < _SMALL_PX:
            return
        self._measured[index] = (
            _edge_share(gray),
            float((gray >= _SATURATED_LEVEL).mean()),
            float(np.percentile(gray[::_EVERY_LINE], _BRIGHTEST_PERCENT)),
            gray.shape[1],
        )
        if index in self._wanted:
            self._small[index] = _reduced(gray, _SMALL_PX)

    def quality(self) -> ImageQuality | None:
        """Return what the images are like; None if none was large enough."""
        if not self._measured:
            return None
        edges, saturated, brightest, width_px = np.array(list(self._measured.values())).T
        edges = edges[np.isfinite(edges)]
        firsts = [k for k in self._firsts if k in self._small and k + 1 in self._small]
        overlaps = dict(zip(firsts, ordered_map(self._overlap, firsts), strict=True))
        known = {first: share for first, share in overlaps.items() if share is not None}
        least = min(known, key=known.__getitem__, default=None)
        return ImageQuality(
            looked_at=len(self._measured),
            edges_px=float(np.median(edges) * np.median(width_px)) if len(edges) else None,
            blurred=int((edges > _BLURRED).sum()),
            saturated=float(np.median(saturated)),
            brightest=float(np.median(brightest)),
            overlap=float(np.median(list(known.values()))) if known else None,
            least_overlap=None if least is None else known[least],
            least_overlap_frame=least,
            advice=tuple(_advice(edges, saturated, brightest, list(known.values()))),
        )

    def _overlap(self, first: int) -> float | None:
        return _overlap(self._small[first], self._small[first + 1])


def _advice(
    edges: NDArray[np.float64],
    saturated: NDArray[np.float64],
    brightest: NDArray[np.float64],
    overlaps: Sequence[float],
) -> Iterator[str]:
    blurred = int((edges > _BLURRED).sum())
    is_dark = np.median(brightest) < _LEAST_BRIGHT
    if blurred > _MOST_BLURRED * len(edges):
        yield f"{blurred} of {len(edges)} images are blurred: move more slowly, or expose for a shorter time"
    if is_dark:
        yield "the images are dark: more light, a longer exposure, or more gain"
    if np.median(saturated) > _MOST_SATURATED:
        yield "much of the images is saturated and shows no texture: less light, or a shorter exposure"
    low = float(np.percentile(overlaps, _LOW_PERCENT)) if overlaps else 1.0
    if low < _LEAST_OVERLAP and not is_dark:
        yield (
            f"a fifth of the neighbouring images have {low:.0%} of the view or less in common, or too few "
            "features: record more images a second, or move more slowly"
        )


def _reduced(gray: Image, width_px: int) -> Image:
    """Return an image of at most some width."""
    height, width = gray.shape
    if width <= width_px:
        return gray
    size = width_px, max(1, round(height * width_px / width))
    reduced: Image = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return reduced


def _edge_share(gray: Image) -> float:
    """Return the median width of edges across rows or columns, whichever is wider, in the image's width.

    An edge is as wide as its step divided by its steepest slope. NaN where there are no edges.
    """
    image = _reduced(gray, _WIDTH_PX)
    window = np.ones((1, _ALONG_PX), np.uint8)
    widths_px = []
    for lines in (image[::_EVERY_LINE], np.ascontiguousarray(image[:, ::_EVERY_LINE].T)):
        step = cv2.subtract(cv2.dilate(lines, window), cv2.erode(lines, window))
        slope = cv2.dilate(cv2.absdiff(lines[:, 1:], lines[:, :-1]), window)
        is_edge = step[:, 1:] > _LEAST_STEP
        if is_edge.sum() >= _FEWEST_PX:
            widths_px.append(np.median(step[:, 1:][is_edge] / slope[is_edge]))
    return float(max(widths_px, default=np.nan)) / float(image.shape[1])


def _overlap(one: Image, other: Image) -> float | None:
    """Return the share of the view that two images have in common; None if they have too few features.

    By the similarity (rotation, scale, shift) that most matches of ORB features agree with.
    """
    orb = cv2.ORB.create(fastThreshold=5)  # default 20: too few features in rooms with little texture
    (points, descriptors), (points_other, descriptors_other) = (
        orb.detectAndCompute(image, None) for image in (one, other)
    )
    if min(len(points), len(points_other)) < _FEWEST_FEATURES:
        return None
    matches = cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True).match(descriptors, descriptors_other)
    found, agreeing = cv2.estimateAffinePartial2D(
        np.array([points[match.queryIdx].pt for match in matches]),
        np.array([points_other[match.trainIdx].pt for match in matches]),
        ransacReprojThreshold=_AGREE_PX,
    )
    if found is None or agreeing.sum() < _FEWEST_MATCHES:
        return 0.0
    height, width = one.shape
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32)
    moved = (corners @ found[:, :2].T + found[:, 2]).astype(np.float32)
    common_px2, _ = cv2.intersectConvexConvex(corners, moved)
    larger_px2 = max(float(width * height), float(cv2.contourArea(moved)))
    return float(common_px2) / larger_px2
