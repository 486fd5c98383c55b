"""Plausibility of depth as that of the images: whether outlines in depth lie on edges of brightness."""

from collections.abc import Callable, Iterable, Mapping
from itertools import permutations
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import RgbdFrame

Pixels: TypeAlias = NDArray[np.float32]

_WIDTH_PX, _MOST_PX, _NEAR_PX = 320, 48, 4
"""Width to which images are reduced, the largest shift that is tried there, and the largest that is none."""
OUTLINE_STEP, _FAR_M = 1.08, 1e6
"""Ratio of two neighbouring depths between which an outline lies; and what unknown depth is replaced by."""
_FEWEST_PX, _MOST_SHARE, _FEWEST_FRAMES = 200, 0.05, 4
"""Pixels of outlines: fewer tell nothing, and of more the most are noise."""
_LEAST_CONTRAST, _LEAST_GRADIENT = 4.0, 20.0
"""95th percentile of the gradient in its median, and in itself (a step of 5 grey levels): 2.1 and 12 of noise
alone, and less where a JPEG smooths it; 4.8 and 45 and more of rooms with texture."""
_LEAST_SCORE, _TIMES_BETTER, SOUND_SCORE = 0.4, 1.4, 0.7
"""Registered depth has its best score within 1 px of no shift, 0.6 standard deviations of brightness or more.
Moved by 12 px, that score is 1.4 to 5 times the best within 4 px; registered 0.7."""
_TIMES_OTHERS = 2.0
"""Score in that of other frames' depth: 3.4 and more if registered, 0 to 2.2 if of another time or camera;
and in that of flipped depth: 1.8 to 7 if registered, 0.1 to 0.6 if it ought to be flipped."""
_FLIPS: Mapping[str, Callable[[Pixels], Pixels]] = {
    "": lambda edges: edges,
    "mirrored": np.fliplr,
    "put upside down": np.flipud,
    "turned by 180°": lambda edges: edges[::-1, ::-1],
}


def why_flipped(frames: Iterable[RgbdFrame]) -> str | None:
    """Return that depth is mirrored or turned against the images, which no pose undoes; None if it is not."""
    pairs = [both for _, both in _outlined(frames)]
    scores = [
        (np.mean([_scores(gradient, flip(edges), _NEAR_PX) for gradient, edges in pairs], axis=0).max(), how)
        for how, flip in _FLIPS.items()
        if pairs
    ]
    best, how = max(scores, default=(0.0, ""))
    if not how or best < max(SOUND_SCORE, _TIMES_OTHERS * scores[0][0]):
        return None
    return f"depth: its edges lie on those of the images if it is {how}; flip it, or the images"


def outline_warnings(frames: Iterable[RgbdFrame]) -> list[str]:
    """Return that depth does not lie on the images that it belongs to, in a sentence.

    Outlines of what stands before something else are edges of brightness too. The gradient of brightness at
    those of depth is averaged over frames for every shift of the images; it is largest at the true one.
    """
    found = _outlined(frames)
    pairs = [both for _, both in found]
    if not found:
        return []
    score = np.mean([_scores(*both, _MOST_PX) for both in pairs], axis=0)
    around = slice(_MOST_PX - _NEAR_PX, _MOST_PX + _NEAR_PX + 1)
    near = float(score[around, around].max())
    if score.max() >= max(_LEAST_SCORE, _TIMES_BETTER * near):
        row, column = np.unravel_index(score.argmax(), score.shape)
        x_px, y_px = (found[0][0] / _WIDTH_PX * (int(k) - _MOST_PX) for k in (column, row))
        return [
            f"depth: its edges lie on those of the images if it is moved by {x_px:.0f}, {y_px:.0f} px "
            "(columns, rows): is it registered to colour, and of the same time? export registered depth, or "
            "give the depth camera: source.camera.depth_intrinsics_px and depth_in_color"
        ]
    if near >= SOUND_SCORE:
        return []
    crossed = [(gradient, edges) for (gradient, _), (_, edges) in permutations(pairs, 2)]
    own, others = (np.mean([_scores(*both, _NEAR_PX).max() for both in some]) for some in (pairs, crossed))
    if own < min(_LEAST_SCORE, _TIMES_OTHERS * others):
        return [
            "depth: its edges lie on those of the images no better than other frames' depth; is it "
            "of the same time (source.depth_offset_s), and of the same camera?"
        ]
    return []


def _outlined(frames: Iterable[RgbdFrame]) -> list[tuple[int, tuple[Pixels, Pixels]]]:
    """Return width and outlines of the frames that have some; none of too few frames."""
    found = [(frame.camera.width_px, both) for frame in frames if (both := outlines(frame)) is not None]
    return found if len(found) >= _FEWEST_FRAMES else []


def outlines(frame: RgbdFrame) -> tuple[Pixels, Pixels] | None:
    """Return the gradient of brightness in standard deviations from its mean, and 1 at outlines in depth.

    None of a frame with few of either.
    """
    camera = frame.camera
    if camera.width_px < _WIDTH_PX:
        return None
    size_px = _WIDTH_PX, round(camera.height_px * _WIDTH_PX / camera.width_px)
    edges = _depth_edges(frame.depth_m, size_px)
    grey = cv2.resize(frame.gray, size_px, interpolation=cv2.INTER_AREA).astype(np.float32)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    usual, most = np.percentile(gradient, (50.0, 95.0))
    least = max(_LEAST_GRADIENT, _LEAST_CONTRAST * usual)
    if not _FEWEST_PX <= edges.sum() <= _MOST_SHARE * edges.size or most < least:
        return None
    gradient = np.minimum(gradient, float(most))
    return (gradient - gradient.mean()) / gradient.std(), edges


def may_be_depth(image: Pixels) -> bool:
    """Return whether (H, W) numbers, 0 for none, have as few outlines as depth: grey images have more."""
    size_px = _WIDTH_PX, round(image.shape[0] * _WIDTH_PX / image.shape[1])
    return bool(_depth_edges(image, size_px).mean() <= _MOST_SHARE)


def _depth_edges(depth_m: Pixels, size_px: tuple[int, int]) -> Pixels:
    """Return 1 at outlines in depth, in an image of this size."""
    depth_m = cv2.resize(depth_m, size_px, interpolation=cv2.INTER_NEAREST)
    around = np.ones((3, 3), np.uint8)
    nearest_m = cv2.erode(np.where(depth_m > 0.0, depth_m, np.float32(_FAR_M)), around)
    is_edge = (depth_m > 0.0) & (cv2.dilate(depth_m, around) > OUTLINE_STEP * nearest_m)
    edges: Pixels = is_edge.astype(np.float32)
    return edges


def _scores(gradient: Pixels, edges: Pixels, most_px: int) -> Pixels:
    """Return the mean gradient at edges, for each shift (rows, columns) of these."""
    sums, counts = (
        cv2.matchTemplate(np.pad(image, most_px), edges, cv2.TM_CCORR)
        for image in (gradient, np.ones_like(gradient))
    )
    scores: Pixels = sums / np.maximum(counts, _FEWEST_PX)
    return scores
