"""Doubts of RGB-D frames: tests of a tracked pose against the medians of this log."""

import math
from dataclasses import dataclass

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Transform, inverse, log
from mapper.core.running_median import RunningMedian
from mapper.odometry.keyframes.depth_comparison import Displacement
from mapper.odometry.keyframes.pose_tracker import TrackedPose

_MEMORY = 100
"""Undoubted frames over which medians are taken."""
_FEWEST = 10
"""With fewer of them the medians are not known."""
_JUMP_RATIO = 8.0
"""Deviation from constant velocity, relative to the usual per second, that is a jump. The 99th percentile of
right poses is 3 to 6."""
_MOST_DISPLACED = 0.5
"""When a larger share of the surfaces that two images have in common lies elsewhere, the pose is doubtful. A
real desk's edges give up to 0.48 under right poses."""


@dataclass(frozen=True, slots=True)
class Assessment:
    """Doubts about a pose, with the error that they suggest.

    Attributes:
        doubts: Reasons why it may be wrong; empty if there is none.
        sigma_rad: Standard deviation of the rotation about each axis.
        sigma_m: Standard deviation of the translation along each axis.
    """

    doubts: tuple[Doubt, ...] = ()
    sigma_rad: float = 0.0
    sigma_m: float = 0.0


UNDOUBTED = Assessment()


class FrameDoubts:
    """Running medians of a log's figures of tracking, and the tests of new frames against them."""

    def __init__(self) -> None:
        names = ("jump_rad_s", "jump_m_s", "speed_rad_s", "speed_m_s")
        self._figures = {name: RunningMedian(memory=_MEMORY, fewest=_FEWEST) for name in names}
        self._shown_since_ns = 0

    def assess(
        self,
        tracked_pose: TrackedPose,
        covariance: Array,
        last: TrackedPose,
        T_camera_world_predicted: Transform | None,
        displaced: Displacement,
        *,
        repeats: bool,
    ) -> Assessment:
        """Return the doubts of a frame; the figures of undoubted ones become part of the usual.

        Args:
            tracked_pose: Of the frame.
            covariance: (6, 6) of its pose from the features that agree, (rotation, translation).
            last: The tracked frame before it.
            T_camera_world_predicted: (4, 4) by constant velocity; None if nothing predicts it.
            displaced: Surfaces that lie elsewhere by this pose than in an earlier frame.
            repeats: Whether its image is that of the frame before.
        """
        stamp_ns = tracked_pose.observation.stamp_ns
        elapsed_s = 1e-9 * (stamp_ns - last.observation.stamp_ns)
        sigma_rad, sigma_m = (_largest_sigma(covariance[k : k + 3, k : k + 3]) for k in (0, 3))
        speed = _motion(tracked_pose.T_camera_world, last.T_camera_world)
        jump = (math.nan, math.nan)
        if T_camera_world_predicted is not None:
            jump = _motion(tracked_pose.T_camera_world, T_camera_world_predicted)
        if not repeats:
            self._shown_since_ns = stamp_ns
        shown_s = 1e-9 * (stamp_ns - self._shown_since_ns)

        doubts = list(tracked_pose.doubts)
        if tracked_pose.depth is not None:  # landmarks were few, so the medians of their figures say nothing
            return Assessment(tuple(doubts), sigma_rad, sigma_m) if doubts else UNDOUBTED
        doubts += self._jumps(jump, elapsed_s)
        if shown_s > 0.0:
            doubts.append(Doubt("repeated image", f"the image has been the same for {shown_s:.2f} s"))
        if displaced.ratio > _MOST_DISPLACED:
            doubts.append(
                Doubt(
                    "elsewhere",
                    f"{displaced.ratio:.0%} of the surfaces lie elsewhere than "
                    f"{displaced.since_s:.1f} s before",
                )
            )
            sigma_m = max(sigma_m, displaced.distance_m)
        if doubts:
            # How far off it may be: as far as the prediction says, or as the camera moves in the time.
            off = [
                max(abs(miss) if math.isfinite(miss) else 0.0, self._median(name) * shown_s)
                for miss, name in zip(jump, ("speed_rad_s", "speed_m_s"), strict=True)
            ]
            return Assessment(tuple(doubts), max(off[0], sigma_rad), max(off[1], sigma_m))
        if elapsed_s > 0.0:
            self._learn(speed_rad_s=speed[0] / elapsed_s, speed_m_s=speed[1] / elapsed_s)
            if T_camera_world_predicted is not None:
                self._learn(jump_rad_s=jump[0] / elapsed_s, jump_m_s=jump[1] / elapsed_s)
        return UNDOUBTED

    def _jumps(self, jump: tuple[float, float], elapsed_s: float) -> list[Doubt]:
        usual_rad, usual_m = (self._median(name) * elapsed_s for name in ("jump_rad_s", "jump_m_s"))
        doubts = []
        if usual_rad and jump[0] > _JUMP_RATIO * usual_rad:
            doubts.append(
                Doubt(
                    "jump",
                    f"turn {math.degrees(jump[0]):.1f}° off the predicted one, "
                    f"{math.degrees(usual_rad):.1f}° is usual",
                )
            )
        if usual_m and jump[1] > _JUMP_RATIO * usual_m:
            doubts.append(
                Doubt("jump", f"jump of {jump[1]:.2f} m off the predicted place, {usual_m:.2f} m is usual")
            )
        return doubts

    def _median(self, name: str) -> float:
        return self._figures[name].median

    def _learn(self, **figures: float) -> None:
        for name, figure in figures.items():
            self._figures[name].add(figure)


def _motion(T_camera_world: Transform, T_before_world: Transform) -> tuple[float, float]:
    """Return the angle and the distance between two poses of the camera."""
    rotation_rad, translation_m = log(T_camera_world @ inverse(T_before_world))
    return float(np.linalg.norm(rotation_rad)), float(np.linalg.norm(translation_m))


def _largest_sigma(covariance: Array) -> float:
    return math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
