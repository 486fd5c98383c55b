"""Doubts of RGB-D frames: what speaks against a tracked pose, measured against what is usual in this log."""

import math
from collections import deque

import numpy as np

from mapper.core.geometry import Array, Transform, inverse, log
from mapper.odometry.local_map.displaced_surfaces import DisplacedSurfaces
from mapper.odometry.local_map.doubt import NO_DOUBT, Doubt
from mapper.odometry.local_map.earlier_depth import Displacement
from mapper.odometry.local_map.pose_information import largest_sigma
from mapper.odometry.local_map.pose_tracker import TrackedPose

_MEMORY = 100
"""Undoubted frames whose medians are the usual."""
_FEWEST = 10
"""With fewer of them nothing is known to be usual."""
_LOOSE_M = 0.025
"""A translation this uncertain is doubtful where the usual is far better: 1 % of a view 2 to 3 m deep."""
_LOOSE_RATIO = 4.0
_LOOSE_RAD = 0.01
"""Turn that moves what is 2.5 m away by as much."""
_LOW_AGREEMENT = 0.5
"""Share of the usual agreement below which a pose is doubtful, however many features agree."""
_JUMP_RATIO = 8.0
"""Deviation from constant velocity, relative to the usual per second, that is a jump. The 99th percentile of
right poses is 3 to 6."""
_SUPPORT_AGREEMENT, _SUPPORT_RATIO = 0.85, 2.0
"""A jump is believed if the agreement is at least this share of the usual, and the uncertainty at most this
multiple, and nothing in view moves by itself: fast motions are real."""
_MIN_EXCESS, _APART = 4.0, 2.0
"""When the image fits the predicted motion better than the one found by so many standard errors of the mean
over its cells, and they are so many times as far apart as usual, what was found may be the motion of
something else; unless they are less apart than a translation or a turn is uncertain that is not doubtful."""


class FrameDoubts:
    """Running medians of a log's figures of tracking, and the tests of new frames against them."""

    def __init__(self) -> None:
        names = ("sigma_m", "agreement", "jump_rad_s", "jump_m_s", "speed_rad_s", "speed_m_s")
        self._figures: dict[str, deque[float]] = {name: deque(maxlen=_MEMORY) for name in names}
        self._surfaces = DisplacedSurfaces()
        self._shown_since_ns = 0

    def assess(
        self,
        tracked_pose: TrackedPose,
        covariance: Array,
        last: TrackedPose,
        T_camera_world_predicted: Transform | None,
        displaced: Displacement,
        excess_error: float,
    ) -> Doubt:
        """Return the doubts of a frame; the figures of undoubted ones become part of the usual.

        Args:
            tracked_pose: Of the frame.
            covariance: (6, 6) of its pose from the features that agree, (rotation, translation).
            last: The tracked frame before it.
            T_camera_world_predicted: (4, 4) by constant velocity; None if nothing predicts it.
            displaced: Surfaces that lie elsewhere by this pose than in an earlier frame.
            excess_error: Photometric error beyond that of the predicted motion, in standard errors.
        """
        stamp_ns = tracked_pose.observation.stamp_ns
        elapsed_s = 1e-9 * (stamp_ns - last.observation.stamp_ns)
        sigma_rad, sigma_m = (largest_sigma(covariance[k : k + 3, k : k + 3]) for k in (0, 3))
        speed = _motion(tracked_pose.T_camera_world, last.T_camera_world)
        jump = (-math.inf, -math.inf)
        if T_camera_world_predicted is not None:
            jump = _motion(tracked_pose.T_camera_world, T_camera_world_predicted)
        checksum = tracked_pose.observation.image_checksum
        if checksum is None or checksum != last.observation.image_checksum:
            self._shown_since_ns = stamp_ns
        shown_s = 1e-9 * (stamp_ns - self._shown_since_ns)

        phrases = list(tracked_pose.doubts)
        off_rad, off_m = max(jump[0], sigma_rad), max(jump[1], sigma_m)
        if shown_s > 0.0:
            moved_rad, moved_m = (self._usual(name) * shown_s for name in ("speed_rad_s", "speed_m_s"))
            phrases.append(f"the image has been the same for {shown_s:.2f} s")
            return Doubt(tuple(phrases), max(moved_rad, off_rad), max(moved_m, off_m), repeats=True)
        if tracked_pose.depth is not None:  # landmarks were few, so what is usual of them says nothing
            if _is_blind(tracked_pose) or _is_blind(last):  # a motion that is predicted alone predicts none
                return Doubt(tuple(phrases), sigma_rad, sigma_m) if phrases else NO_DOUBT
            if jumps := self._jumps(jump, elapsed_s):
                return Doubt((*phrases, *jumps), off_rad, off_m)
            if phrases:
                return Doubt(tuple(phrases), sigma_rad, sigma_m)
            self._learn_motion(speed, jump, elapsed_s)
            return NO_DOUBT
        usual_m, usual_agreement = self._usual("sigma_m"), self._usual("agreement")
        agreement = tracked_pose.agreement
        is_loose = sigma_m > max(_LOOSE_M, _LOOSE_RATIO * usual_m)
        if is_loose:
            phrases.append(
                f"{tracked_pose.inliers} features agree, which tell the translation to {sigma_m:.3f} m"
                + (f", {usual_m:.3f} m is usual" if usual_m else "")
            )
        is_contradicted = agreement < _LOW_AGREEMENT * usual_agreement
        if is_contradicted:
            phrases.append(f"{agreement:.0%} of the matches agree, {usual_agreement:.0%} is usual")
        is_supported = (
            agreement >= _SUPPORT_AGREEMENT * usual_agreement
            and sigma_m <= _SUPPORT_RATIO * usual_m
            and tracked_pose.few_move
        )
        jumps = [] if is_supported else self._jumps(jump, elapsed_s)
        phrases += jumps
        if elsewhere := self._surfaces.speak_against(tracked_pose, displaced):
            phrases.append(elsewhere)
            sigma_m = max(sigma_m, displaced.distance_m)
        is_apart = jump[0] > _LOOSE_RAD or jump[1] > _LOOSE_M
        if excess_error > _MIN_EXCESS and is_apart and self._exceeds_usual(jump, elapsed_s, _APART):
            is_contradicted = True
            phrases.append(
                f"the image fits the predicted motion better by {excess_error:.0f} standard errors"
            )
        if phrases:
            is_wild = is_loose and is_contradicted and bool(jumps)
            return Doubt(tuple(phrases), off_rad, max(off_m, sigma_m), is_wild=is_wild)
        self._learn(sigma_m=sigma_m, agreement=agreement)
        self._learn_motion(speed, jump, elapsed_s)
        return NO_DOUBT

    def in_hindsight(self, stamp_ns: int) -> Doubt:
        """Return what later frames say against an earlier one."""
        return self._surfaces.doubt_of_earlier(stamp_ns)

    def _exceeds_usual(self, jump: tuple[float, float], elapsed_s: float, ratio: float) -> bool:
        """Return whether the angle or the distance to the predicted pose is so many times the usual."""
        usual = self._usual_jump(elapsed_s)
        return any(miss > ratio * expected > 0.0 for miss, expected in zip(jump, usual, strict=True))

    def _jumps(self, jump: tuple[float, float], elapsed_s: float) -> list[str]:
        usual_rad, usual_m = self._usual_jump(elapsed_s)
        phrases = []
        if usual_rad and jump[0] > _JUMP_RATIO * usual_rad:
            phrases.append(
                f"turn {math.degrees(jump[0]):.1f}° off the predicted one, "
                f"{math.degrees(usual_rad):.1f}° is usual"
            )
        if usual_m and jump[1] > _JUMP_RATIO * usual_m:
            phrases.append(f"jump of {jump[1]:.2f} m off the predicted place, {usual_m:.2f} m is usual")
        return phrases

    def _usual_jump(self, elapsed_s: float) -> tuple[float, float]:
        """Return the usual angle and distance to the predicted pose after a time; 0 while unknown."""
        return self._usual("jump_rad_s") * elapsed_s, self._usual("jump_m_s") * elapsed_s

    def _usual(self, name: str) -> float:
        """Return the median of a figure; 0 while too little is known."""
        figures = self._figures[name]
        return float(np.median(figures)) if len(figures) >= _FEWEST else 0.0

    def _learn_motion(self, speed: tuple[float, float], jump: tuple[float, float], elapsed_s: float) -> None:
        if elapsed_s > 0.0:
            self._learn(speed_rad_s=speed[0] / elapsed_s, speed_m_s=speed[1] / elapsed_s)
            if math.isfinite(jump[0]):
                self._learn(jump_rad_s=jump[0] / elapsed_s, jump_m_s=jump[1] / elapsed_s)

    def _learn(self, **figures: float) -> None:
        for name, figure in figures.items():
            self._figures[name].append(figure)


def _is_blind(tracked_pose: TrackedPose) -> bool:
    """Return whether a part of the motion is predicted alone."""
    return tracked_pose.depth is not None and bool(tracked_pose.depth.unobservable)


def _motion(T_camera_world: Transform, T_before_world: Transform) -> tuple[float, float]:
    """Return the angle and the distance between two poses of the camera."""
    rotation_rad, translation_m = log(T_camera_world @ inverse(T_before_world))
    return float(np.linalg.norm(rotation_rad)), float(np.linalg.norm(translation_m))
