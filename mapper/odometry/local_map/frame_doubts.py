"""Doubts of RGB-D frames: figures of tracking that deviate from their median over the log."""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Transform, inverse, log
from mapper.core.timebase import NS_PER_S
from mapper.odometry.base import is_gap
from mapper.odometry.local_map.depth.earlier_depth import Displacement
from mapper.odometry.local_map.displaced_surfaces import DisplacedSurfaces
from mapper.odometry.local_map.pose.assessment import UNDOUBTED, Assessment
from mapper.odometry.local_map.pose.pose_information import largest_sigma
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose

_MEMORY = 100
"""Undoubted frames whose medians are the usual."""
_FEWEST = 10
"""With fewer of them there is no usual value."""
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
_MANY_MOVING, _JUMP_RATIO_AMONG_MOVING = 0.1, 5.0
"""The same while a larger share of the features moves: it is often the motion of something else then."""
_SUPPORT_AGREEMENT, _SUPPORT_RATIO = 0.85, 2.0
"""A jump is accepted if the agreement is at least this share of the usual, and the uncertainty at most this
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

    @property
    def usual_speed_m_s(self) -> float:
        """Median speed of the undoubted frames; 0 while too little is known."""
        return self._usual("speed_m_s")

    def assess(
        self,
        tracked_pose: TrackedPose,
        covariance: Array,
        last: TrackedPose,
        T_camera_world_predicted: Transform | None,
        displaced: Displacement,
        excess_error: float,
    ) -> Assessment:
        """Return the doubts of a frame; the figures of undoubted ones become part of the usual.

        Args:
            tracked_pose: Of the frame.
            covariance: (6, 6) of its pose from the features that agree, (rotation, translation).
            last: The tracked frame before it.
            T_camera_world_predicted: (4, 4) by constant velocity; None if nothing predicts it.
            displaced: Surfaces that lie elsewhere by this pose than in an earlier frame.
            excess_error: Photometric error beyond that of the predicted motion, in standard errors.
        """
        motion = _FrameMotion.of(tracked_pose, covariance, last, T_camera_world_predicted)
        if shown_s := self._shown_s(tracked_pose, last):
            return self._of_repeated_image(tracked_pose, motion, shown_s)
        if tracked_pose.depth is not None:
            assessed = self._of_depth(tracked_pose, last, motion)
        else:
            assessed = self._of_landmarks(tracked_pose, motion, displaced, excess_error)
        if not (assessed.doubts and motion.follows_gap):
            return assessed
        # Another place that looks alike may have been recognised.
        reach_rad, reach_m = (self._usual(name) * motion.elapsed_s for name in ("speed_rad_s", "speed_m_s"))
        return replace(
            assessed,
            sigma_rad=max(assessed.sigma_rad, reach_rad),
            sigma_m=max(assessed.sigma_m, reach_m),
        )

    def _shown_s(self, tracked_pose: TrackedPose, last: TrackedPose) -> float:
        """Return for how long the image has been the same; 0 if it is a new one."""
        observation = tracked_pose.observation
        checksum = observation.image_checksum
        if checksum is None or checksum != last.observation.image_checksum:
            self._shown_since_ns = observation.stamp_ns
        return 1e-9 * (observation.stamp_ns - self._shown_since_ns)

    def _of_repeated_image(
        self, tracked_pose: TrackedPose, motion: "_FrameMotion", shown_s: float
    ) -> Assessment:
        """Return the doubt of a frame that shows an earlier image: the camera moved on as usual."""
        moved_rad, moved_m = (self._usual(name) * shown_s for name in ("speed_rad_s", "speed_m_s"))
        doubt = Doubt("repeated image", f"the image has been the same for {shown_s:.2f} s")
        sigma_rad, sigma_m = max(moved_rad, motion.off_rad), max(moved_m, motion.off_m)
        return Assessment((*tracked_pose.doubts, doubt), sigma_rad, sigma_m, repeats=True)

    def _of_depth(self, tracked_pose: TrackedPose, last: TrackedPose, motion: "_FrameMotion") -> Assessment:
        """Return the doubts of a pose by depth: landmarks were few, so their usual figures do not apply."""
        doubts = tracked_pose.doubts
        if motion.follows_gap:
            doubts = (*doubts, *self._disagreement(tracked_pose))
        # A motion that is predicted alone predicts no other.
        is_unobserved = _is_unobserved(tracked_pose) or _is_unobserved(last)
        if not is_unobserved and (jumps := self._jumps(motion)):
            return Assessment((*doubts, *jumps), motion.off_rad, motion.off_m)
        if doubts:
            return Assessment(doubts, motion.sigma_rad, motion.sigma_m)
        if not is_unobserved:
            self._add_motion(motion)
        return UNDOUBTED

    def _of_landmarks(
        self, tracked_pose: TrackedPose, motion: "_FrameMotion", displaced: Displacement, excess_error: float
    ) -> Assessment:
        """Return the doubts of a pose by landmarks."""
        usual_m, usual_agreement = self._usual("sigma_m"), self._usual("agreement")
        agreement, sigma_m = tracked_pose.agreement, motion.sigma_m
        disagreement = self._disagreement(tracked_pose)
        doubts = list(tracked_pose.doubts)
        is_loose = sigma_m > max(_LOOSE_M, _LOOSE_RATIO * usual_m)
        if is_loose:
            usual = f", {usual_m:.3f} m is usual" if usual_m else ""
            text = f"{tracked_pose.inliers} features agree, which tell the translation to {sigma_m:.3f} m"
            doubts.append(Doubt("uncertain translation", text + usual))
        is_contradicted = bool(disagreement)
        doubts += disagreement
        is_supported = (
            agreement >= _SUPPORT_AGREEMENT * usual_agreement
            and sigma_m <= _SUPPORT_RATIO * usual_m
            and tracked_pose.few_move
        )
        many_move = len(tracked_pose.moving) > _MANY_MOVING * len(tracked_pose.observation)
        ratio = _JUMP_RATIO_AMONG_MOVING if many_move else _JUMP_RATIO
        jumps = [] if is_supported else self._jumps(motion, ratio)
        doubts += jumps
        if elsewhere := self._surfaces.doubt_of(tracked_pose, displaced):
            doubts.append(elsewhere)
            sigma_m = max(sigma_m, displaced.distance_m)
        if excess_error > _MIN_EXCESS and self._is_apart(motion):
            is_contradicted = True
            text = f"the image fits the predicted motion better by {excess_error:.0f} standard errors"
            doubts.append(Doubt("image error", text))
        if doubts:
            return Assessment(
                tuple(doubts),
                motion.off_rad,
                max(motion.off_m, sigma_m),
                is_implausible=is_loose and is_contradicted and bool(jumps),
            )
        self._add(sigma_m=sigma_m, agreement=agreement)
        self._add_motion(motion)
        return UNDOUBTED

    def in_hindsight(self, stamp_ns: int) -> Assessment:
        """Return the doubt that later frames add to an earlier one."""
        return self._surfaces.doubt_of_earlier(stamp_ns)

    def _disagreement(self, tracked_pose: TrackedPose) -> list[Doubt]:
        agreement, usual = tracked_pose.agreement, self._usual("agreement")
        if agreement >= _LOW_AGREEMENT * usual:
            return []
        return [Doubt("disagreeing matches", f"{agreement:.0%} of the matches agree, {usual:.0%} is usual")]

    def _is_apart(self, motion: "_FrameMotion") -> bool:
        """Return whether a pose is so far from the predicted one that the two are distinct."""
        jump, usual = motion.jump, self._usual_jump(motion.elapsed_s)
        exceeds = any(miss > _APART * expected > 0.0 for miss, expected in zip(jump, usual, strict=True))
        return exceeds and (jump[0] > _LOOSE_RAD or jump[1] > _LOOSE_M)

    def _jumps(self, motion: "_FrameMotion", ratio: float = _JUMP_RATIO) -> list[Doubt]:
        jump, (usual_rad, usual_m) = motion.jump, self._usual_jump(motion.elapsed_s)
        doubts = []
        if usual_rad and jump[0] > ratio * usual_rad:
            turn_deg, usual_deg = math.degrees(jump[0]), math.degrees(usual_rad)
            text = f"turn {turn_deg:.1f}° off the predicted one, {usual_deg:.1f}° is usual"
            doubts.append(Doubt("turn", text))
        if usual_m and jump[1] > ratio * usual_m:
            text = f"jump of {jump[1]:.2f} m off the predicted place, {usual_m:.2f} m is usual"
            doubts.append(Doubt("jump", text))
        return doubts

    def _usual_jump(self, elapsed_s: float) -> tuple[float, float]:
        """Return the usual angle and distance to the predicted pose after a time; 0 while unknown."""
        return self._usual("jump_rad_s") * elapsed_s, self._usual("jump_m_s") * elapsed_s

    def _usual(self, name: str) -> float:
        """Return the median of a figure; 0 while too little is known."""
        figures = self._figures[name]
        return float(np.median(figures)) if len(figures) >= _FEWEST else 0.0

    def _add_motion(self, motion: "_FrameMotion") -> None:
        elapsed_s = motion.elapsed_s
        if elapsed_s > 0.0:
            self._add(speed_rad_s=motion.shift[0] / elapsed_s, speed_m_s=motion.shift[1] / elapsed_s)
            if math.isfinite(motion.jump[0]):
                self._add(jump_rad_s=motion.jump[0] / elapsed_s, jump_m_s=motion.jump[1] / elapsed_s)

    def _add(self, **figures: float) -> None:
        for name, figure in figures.items():
            self._figures[name].append(figure)


@dataclass(frozen=True, slots=True)
class _FrameMotion:
    """Motion to a frame, and its uncertainty.

    Attributes:
        elapsed_s: Time since the last tracked frame.
        follows_gap: Whether that is so old that it does not predict this one.
        shift: Angle and distance to the last pose.
        jump: Angle and distance to the predicted pose; −∞ if nothing predicts it.
        sigma_rad: Largest standard deviation of the rotation.
        sigma_m: Largest standard deviation of the translation.
    """

    elapsed_s: float
    follows_gap: bool
    shift: tuple[float, float]
    jump: tuple[float, float]
    sigma_rad: float
    sigma_m: float

    @classmethod
    def of(
        cls,
        tracked_pose: TrackedPose,
        covariance: Array,
        last: TrackedPose,
        T_camera_world_predicted: Transform | None,
    ) -> "_FrameMotion":
        """Return the motion to a tracked pose with its (6, 6) covariance."""
        T_camera_world, jump = tracked_pose.T_camera_world, (-math.inf, -math.inf)
        if T_camera_world_predicted is not None:
            jump = _angle_and_distance(T_camera_world, T_camera_world_predicted)
        return cls(
            (tracked_pose.stamp_ns - last.stamp_ns) / NS_PER_S,
            is_gap(last.stamp_ns, tracked_pose.stamp_ns),
            _angle_and_distance(T_camera_world, last.T_camera_world),
            jump,
            *(largest_sigma(covariance[k : k + 3, k : k + 3]) for k in (0, 3)),
        )

    @property
    def off_rad(self) -> float:
        """Angle by which the pose may be wrong: to the predicted one, or its standard deviation."""
        return max(self.jump[0], self.sigma_rad)

    @property
    def off_m(self) -> float:
        """Distance by which the pose may be wrong, likewise."""
        return max(self.jump[1], self.sigma_m)


def _is_unobserved(tracked_pose: TrackedPose) -> bool:
    """Return whether a part of the motion is predicted alone."""
    return tracked_pose.depth is not None and bool(tracked_pose.depth.unobservable)


def _angle_and_distance(T_camera_world: Transform, T_before_world: Transform) -> tuple[float, float]:
    """Return the angle and the distance between two poses of the camera."""
    rotation_rad, translation_m = log(T_camera_world @ inverse(T_before_world))
    return float(np.linalg.norm(rotation_rad)), float(np.linalg.norm(translation_m))
