"""Plausibility of a log's stamps: their rate, and the order in which they put the images."""

from functools import cache

import cv2
import numpy as np

from mapper.core.errors import FrameError
from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array, spread_indices
from mapper.core.timebase import NS_PER_S
from mapper.sources.base import Log

_MAX_RATE_HZ = 1000.0
_MAX_INTERVAL_S = 15.0
"""Milliseconds taken for seconds are more, up to 66 frames a second."""
_UNEVEN = 0.1
"""Median deviation of intervals in their median: less by a sensor's clock, more where one moves a tripod."""
_DATED_NS, _LONGEST_S = 10**9 * NS_PER_S, 3600.0
"""Stamps since 2001 are seconds, in which scans come one by one; a device's count of µs has longer ones."""
_PLACES, _ALL_PLACES = 6, 100
"""Places of half a log at which two consecutive images are compared; more where these are unlike."""
_LEAST_FRAMES = 4 * _PLACES
_SIZE_PX = (32, 24)
_UNLIKE = 0.9
"""Difference of consecutive images in that of any two: 0.2 to 0.6 down to 1.5 Hz, 0.84 of every 15th of 30 Hz
while the camera is shaken, and 0.96 to 1.05 where stamps are shuffled."""
_LESS_ALIKE = 2.0
"""Difference of consecutive images in that from the one most alike: an order exists, and it is another."""


def time_warnings(log: Log) -> list[str]:
    """Return what is implausible about a log's stamps, a sentence each; a few images are read."""
    return [*_rate_warnings(log), *_order_warnings(log)]


def _rate_warnings(log: Log) -> list[str]:
    apart_s = np.diff(log.stamps_ns) / NS_PER_S if len(log) > 1 else np.ones(1)
    usual_s = float(np.median(apart_s))
    if usual_s * _MAX_RATE_HZ < 1.0:
        return [
            f"stamps: frames come every {usual_s:.2g} s, which no camera or LiDAR does; are they of another "
            "unit, or those of the file system?"
        ]
    is_even = float(np.median(np.abs(apart_s - usual_s))) < _UNEVEN * usual_s
    is_dated = log.stamps_ns[0] > _DATED_NS and usual_s < _LONGEST_S
    if usual_s > _MAX_INTERVAL_S and is_even and not is_dated:
        return [
            f"stamps: frames come every {usual_s:.3g} s, in which a moving sensor sees nothing again; are "
            "they milliseconds, microseconds or nanoseconds? want seconds"
        ]
    return []


def _order_warnings(log: Log) -> list[str]:
    """Return that the consecutive images of a half are no more alike than any two, while others are."""
    if log.sensor != "rgbd":
        return []
    indices = np.arange(len(log))
    parts = {" of the first half": indices[: len(log) // 2], " of the second half": indices[len(log) // 2 :]}
    if len(log) < 2 * _LEAST_FRAMES:
        parts = {"": indices}
    ratios = {where: ratio for where, part in parts.items() if (ratio := _unlikeness(log.subset(part)))}
    if not ratios:
        return []
    where = next(iter(ratios)) if len(ratios) < len(parts) else ""
    return [
        f"stamps: consecutive images{where} are no more alike than any two, though each has another that is "
        f"{max(ratios.values()):.1f} times as like it; are the stamps those of other images (sorted by text, "
        "or shuffled)?"
    ]


def _unlikeness(log: Log) -> float | None:
    """Return how much less alike consecutive images are than the most alike ones; None if they follow."""
    if len(log) < _LEAST_FRAMES:
        return None

    @cache
    def view(index: int) -> Array | None:
        return _view(log, index)

    for places in (_PLACES, _ALL_PLACES):
        first = spread_indices(len(log) - 1, places).tolist()
        pairs = [(k, k + 1) for k in first if view(k) is not None and view(k + 1) is not None]
        if len(pairs) < _PLACES - 1:
            return None
        indices = np.unique(pairs)
        views = np.array([view(k) for k in indices.tolist()])
        between = np.array([np.sqrt(((views - one) ** 2).mean(axis=1)) for one in views])
        apart = np.abs(np.subtract.outer(indices, indices))
        begins, ends = np.searchsorted(indices, pairs).T
        consecutive = between[begins, ends]
        if np.median(consecutive) < _UNLIKE * np.median(between[apart > 1]):
            return None
    nearest = np.where(apart > 1, between, np.inf).min(axis=1)
    ratio = float(np.median(consecutive) / max(np.median(nearest), 1e-9))
    return ratio if ratio >= _LESS_ALIKE else None


def _view(log: Log, index: int) -> Array | None:
    """Return a small image without its mean and contrast; None where it cannot be read."""
    try:
        frame = log.entry_at(index).load(colour=False)
    except FrameError:
        return None
    assert isinstance(frame, RgbdFrame)
    small = cv2.resize(frame.gray, _SIZE_PX, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()
    return np.asarray((small - small.mean()) / max(float(small.std()), 1.0), np.float64)
