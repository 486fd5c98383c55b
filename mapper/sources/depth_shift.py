"""Plausibility of depth as registered to the images: whether edges of depth lie on edges of brightness."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import RgbdFrame

_WIDTH_PX, _MOST_PX = 320, 48
"""Width to which images are reduced, and the largest shift that is tried there."""
_STEP, _FAR_M = 1.08, 1e6
"""Ratio of two neighbouring depths between which an edge lies; and what unknown depth is replaced by."""
_FEWEST_EDGES_PX, _FEWEST_FRAMES = 200, 4
_NEAR_PX = 4
_LEAST_SCORE, _TIMES_BETTER = 0.4, 1.4
"""Registered depth has its best score within 1 px of no shift, 0.8 standard deviations of brightness or more,
but 0.05 where nothing has contrast. Moved by 12 px, that score is 1.4 to 5 times the best within 4 px."""


def shift_warnings(frames: Iterable[RgbdFrame]) -> list[str]:
    """Return that depth does not lie on the images that it belongs to, in a sentence.

    Outlines of what stands before something else are edges of brightness too. The gradient of brightness at
    the edges of depth is averaged over frames for every shift of the images; it is largest at the true one.
    """
    found = [(score, frame.camera.width_px) for frame in frames if (score := _scores(frame)) is not None]
    if len(found) < _FEWEST_FRAMES:
        return []
    score = np.mean([scores for scores, _ in found], axis=0)
    around = slice(_MOST_PX - _NEAR_PX, _MOST_PX + _NEAR_PX + 1)
    limit = max(_LEAST_SCORE, _TIMES_BETTER * float(score[around, around].max()))
    if score.max() < limit:
        return []
    row, column = np.unravel_index(score.argmax(), score.shape)
    scale = found[0][1] / _WIDTH_PX
    x_px, y_px = (scale * (int(k) - _MOST_PX) for k in (column, row))
    return [
        f"depth: its edges lie on those of the images if it is moved by {x_px:.0f}, {y_px:.0f} px (columns, "
        "rows): is it registered to colour, and of the same time? export registered depth, or give the depth "
        "camera: source.camera.depth_intrinsics_px and depth_in_color"
    ]


def _scores(frame: RgbdFrame) -> NDArray[np.float32] | None:
    """Return the mean gradient of brightness at edges of depth, for each shift (rows, columns) of these.

    It is in standard deviations from the image's mean; None of a frame with few edges.
    """
    if frame.camera.width_px < _WIDTH_PX:
        return None
    size_px = _WIDTH_PX, round(frame.camera.height_px * _WIDTH_PX / frame.camera.width_px)
    depth_m = cv2.resize(frame.depth_m, size_px, interpolation=cv2.INTER_NEAREST)
    around = np.ones((3, 3), np.uint8)
    nearest_m = cv2.erode(np.where(depth_m > 0.0, depth_m, np.float32(_FAR_M)), around)
    edges = ((depth_m > 0.0) & (cv2.dilate(depth_m, around) > _STEP * nearest_m)).astype(np.float32)
    if edges.sum() < _FEWEST_EDGES_PX:
        return None
    grey = cv2.resize(frame.gray, size_px, interpolation=cv2.INTER_AREA).astype(np.float32)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    gradient = np.minimum(gradient, np.percentile(gradient, 95.0))
    if (spread := float(gradient.std())) == 0.0:
        return None
    sums, counts = (
        cv2.matchTemplate(np.pad(image, _MOST_PX), edges, cv2.TM_CCORR)
        for image in ((gradient - gradient.mean()) / spread, np.ones_like(grey))
    )
    scores: NDArray[np.float32] = sums / np.maximum(counts, _FEWEST_EDGES_PX)
    return scores
