"""Spikes: frames that step off the path around them, which comes back within a few frames."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, rotation_log
from mapper.core.timebase import NS_PER_S
from mapper.odometry.base import FrameResult
from mapper.sensing.gyroscope import Gyroscope

_MOST_FRAMES = 5
_RATIO = 8.0
"""Steps off the path and back, in the log's median ones over as many frames: as for jumps while tracking."""
_LEAST_M, _LEAST_RAD = 0.1, np.radians(5.0)
_CARRIED_MPS2, _CARRIED_RADPS2 = 4.0, 10.0
"""Accelerations with which sensors are carried: within seconds a car swerves, and a head looks aside. By an
acceleration a, what has returned after a time t went at most a·t²/8 aside."""


class _Spike(NamedTuple):
    """Frames first … last of a path.

    ``size`` is their step off it, as a multiple of the limit; the sigmas are that step, for rotation and
    translation.
    """

    size: float
    first: int
    last: int
    sigmas: tuple[float, float]
    text: str


def with_doubtful_spikes(
    tracks: Sequence[FrameResult], gyroscope: Gyroscope | None = None
) -> list[FrameResult]:
    """Return results of which those are doubtful that step off the path and back by far more than is usual.

    While a log is tracked, a jump that all features support is believed. In both directions of time it is
    measured against the motion around it: no sensor is carried aside and back between a few frames. Turns are
    measured against the gyroscope. Such a frame's covariance grows by the square of the step, so that its
    neighbours place it.

    Args:
        tracks: Results of a log's frames, in time order.
        gyroscope: Angular velocities of the body; None if they are not known.
    """
    placed = [k for k, track in enumerate(tracks) if track.node is not None]
    if not placed:
        return list(tracks)
    stamps_ns = np.array([tracks[k].stamp_ns for k in placed])
    times_s = (stamps_ns - tracks[0].stamp_ns) / NS_PER_S
    T_world_body = np.array([tracks[k].T_world_body for k in placed])
    R_expected = T_world_body[:-1, :3, :3]
    if gyroscope is not None:
        turned, known = gyroscope.rotations(stamps_ns[:-1], stamps_ns[1:], np.zeros(3), 1.0)
        R_expected = np.where(known[:, None, None], R_expected @ turned, R_expected)
    turns = [rotation_log(b @ a.T) for a, b in zip(R_expected, T_world_body[1:, :3, :3], strict=True)]
    found = [
        *_spikes(T_world_body[:, :3, 3], times_s, _LEAST_M, _CARRIED_MPS2, is_turn=False),
        *_spikes(
            np.cumsum([np.zeros(3), *turns], axis=0), times_s, _LEAST_RAD, _CARRIED_RADPS2, is_turn=True
        ),
    ]
    changed, taken = list(tracks), np.zeros(len(placed), np.bool_)
    for spike in sorted(found, reverse=True):
        if taken[spike.first - 1 : spike.last + 2].any():
            continue  # next to a spike, right frames stand out too
        taken[spike.first : spike.last + 1] = True
        for k in placed[spike.first : spike.last + 1]:
            if not tracks[k].doubts:
                changed[k] = _doubted(tracks[k], spike)
    return changed


def _doubted(track: FrameResult, spike: _Spike) -> FrameResult:
    covariance = track.covariance
    if covariance is not None and not track.is_keyframe:
        covariance = covariance + np.diag(np.repeat(np.square(spike.sigmas), 3))
    return replace(track, doubts=(Doubt("jump", spike.text),), covariance=covariance)


def _spikes(path: Array, times_s: Array, least: float, carried: float, *, is_turn: bool) -> Iterator[_Spike]:
    """Yield the spikes of an (N, 3) path, of each number of frames, beyond an acceleration."""
    for frames in range(1, _MOST_FRAMES + 1):
        a = np.arange(1, len(path) - frames - 2)  # each end has a neighbour outside, which tells the motion
        b = a + frames + 1
        if not len(a):
            return
        gap_s = (times_s[b] - times_s[a])[:, None]
        steps = np.diff(path, axis=0) / np.diff(times_s)[:, None]
        rate = (path[b] - path[a]) / gap_s
        off = (steps[a] - rate) * (times_s[a + 1] - times_s[a])[:, None]
        back = (steps[b - 1] - rate) * (times_s[b] - times_s[b - 1])[:, None]
        size = np.minimum(np.linalg.norm(off, axis=1), np.linalg.norm(back, axis=1))
        moved = 0.5 * (steps[a - 1] + steps[b]) * gap_s
        returns = (np.linalg.norm(path[b] - path[a] - moved, axis=1) < size) & (
            (off * back).sum(axis=1) < 0.0
        )
        usual = float(np.median(size))
        limits = np.maximum(max(_RATIO * usual, least), 0.125 * carried * gap_s[:, 0] ** 2)
        for k in np.flatnonzero((size > limits) & returns).tolist():
            step = float(size[k])
            named = [f"{np.degrees(x):.1f}°" if is_turn else f"{x:.2f} m" for x in (step, usual)]
            text = f"{named[0]} off the path and back within {frames + 1} frames, {named[1]} is usual"
            sigmas = (step, 0.0) if is_turn else (0.0, step)
            yield _Spike(step / float(limits[k]), k + 2, k + 1 + frames, sigmas, text)
