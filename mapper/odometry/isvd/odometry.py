"""ISVD odometry: each frame registered against several earlier ones (Somlyai, PhD thesis, alg. 7)."""

import math
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.deskew import Motion
from mapper.core.errors import ConfigError, FrameError
from mapper.core.frames import Frame, PinholeCamera, RgbdFrame
from mapper.core.geometry import (
    Array,
    Transform,
    apply,
    inverse,
    mean_pose,
    mean_rotation,
    rotation_exp,
    rotation_log,
    transform,
)
from mapper.features.base import Detector
from mapper.features.factory import build_detector
from mapper.features.frame_view import ImageView
from mapper.graph.measurement_covariance import with_model_error
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import (
    Diagnostics,
    FeatureMatches,
    FrameOdometry,
    FrameResult,
    MotionCheck,
    is_gap,
    lost_frame,
)
from mapper.odometry.config import IsvdOdometryConfig, MatchConfig
from mapper.odometry.isvd.frame_pairs import IsvdObservation, PairRegistration, RegisterPair, matched_pairs
from mapper.odometry.motion_prior import MotionPrior, WithMotionPrior
from mapper.odometry.sharpest_keyframe import SharpestKeyframes
from mapper.registration.base import Alignment
from mapper.registration.reprojection import (
    VIRTUAL_BASELINE_PX_M,
    disparity_sigmas_px,
    image_measurements,
)
from mapper.runtime.archived import Archived, archived
from mapper.sensing.config import KINECT_NOISE
from mapper.sensing.depth import depth_sigma_m, dif, feature_depth_m
from mapper.sensing.gyroscope import Gyroscope

_DEPTH_SHARE = 0.01
"""Error of depths beside the sensor's noise, as a share: its scale, and the slope where a feature lies."""
_NEW_VIEW, _NEAR_VIEW = 0.15, 0.6
"""Differences of views: from this on a frame is a keyframe, up to this it is registered against one."""
_HALF_VIEW_RAD = 0.5
RELOCALISATION_KEYFRAMES = 20
"""Of the nearest keyframes, and in turn of the others, that a lost frame is compared with."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A tracked frame: its node, its observation, and T_world_body as estimated when it was tracked."""

    node: int
    observation: IsvdObservation
    T_world_body: Transform


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    """A tracked frame that is kept, with what it observed in the archive."""

    node: int
    observation: Archived[IsvdObservation]
    T_world_body: Transform

    def loaded(self) -> TrackedFrame:
        """Return the frame."""
        return TrackedFrame(self.node, self.observation.data, self.T_world_body)


def _kept(frame: TrackedFrame) -> _Keyframe:
    return _Keyframe(frame.node, archived(frame.observation), frame.T_world_body)


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """Registration of a new frame against an earlier one.

    Attributes:
        earlier: The earlier frame, the target.
        alignment: The motion, earlier ← new.
        information: (6, 6) of the motion, with the error that its features share.
        weight: Its quality W, 1/m (eq. 4.1).
        matches: Number of matched features, with or without depth.
        T_world_body: (4, 4) pose of the new frame by this registration.
    """

    earlier: TrackedFrame
    alignment: Alignment
    information: Array
    weight: float
    matches: int
    T_world_body: Transform


class IsvdOdometry(WithMotionPrior, FrameOdometry[IsvdObservation]):
    """Odometry that registers every frame against MP earlier ones and averages the poses.

    Every tracked frame is a node, and every registration that succeeded is a factor. The earlier frames are
    those before it, as published, or the frame before it and the keyframes whose views are nearest, so that
    the graph has factors across as much time as a view lasts.
    """

    def __init__(
        self,
        config: IsvdOdometryConfig,
        *,
        detector: Detector | None = None,
        register: RegisterPair | None = None,
        motion_check: MotionCheck | None = None,
        gyroscope: Gyroscope | None = None,
    ) -> None:
        """Start before the first frame.

        Args:
            config: Settings.
            detector: Replaces the configured one, so that several odometries on the same frames can share
                the detection.
            register: Replaces the registration, so that they can share registrations as well.
            motion_check: Rules out poses after a gap; None if nothing but the images tells of the motion.
            gyroscope: Angular velocities of the log; None if it has none.
        """
        self._config = config
        self._prior = MotionPrior(gyroscope)
        self._motion_check = motion_check
        self._detector = detector or build_detector(config.detector)
        self._registration = PairRegistration(config.registration, by_pixels=config.residual == "pixels")
        self._register_pair = register or self._registration
        self._recent: deque[TrackedFrame] = deque(
            maxlen=max(config.previous_frames, config.keyframe_interval)
        )
        self._keyframes: list[_Keyframe] = []
        self._sharpest = SharpestKeyframes(config.keyframe_interval)
        self._next_node = 0
        self._turn = 0
        self._nearest_match: tuple[IsvdObservation, PoseCandidate, MatchConfig] | None = None

    def observe(self, frame: Frame) -> IsvdObservation:
        """Return a frame's features with their 3D points. Pure.

        Raises:
            FrameError: The frame is a bare scan.
        """
        if not isinstance(frame, RgbdFrame):
            raise FrameError(f"frame {frame.stamp_ns}: ISVD odometry needs an image with depth, not a scan")
        features = self._detector.detect(frame.gray)
        config, camera = self._config, frame.camera
        depth_m = dif(frame.depth_m) if config.depth_filter else frame.depth_m
        z, _, _ = feature_depth_m(depth_m, features.pixels)
        z[z > config.max_depth_m] = np.nan
        pixels = self._undistorted(features.pixels, camera)
        at = self._undistorted(np.rint(features.pixels), camera) if config.whole_pixels else pixels
        rays = (at - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
        sigma_px = self._detector.scale_factor ** features.octave.astype(np.float64)
        sigma_m = np.hypot(depth_sigma_m(config.depth_noise or KINECT_NOISE, z), _DEPTH_SHARE * z)
        measured, weights, intrinsics = image_measurements(
            pixels,
            z,
            camera.intrinsics,
            sigma_px=sigma_px,
            disparity_sigma_px=disparity_sigmas_px(z, sigma_m),
        )
        return IsvdObservation(
            stamp_ns=frame.stamp_ns,
            features=features,
            points_body=apply(frame.T_body_camera, np.column_stack([rays * z[:, None], z])),
            measured=measured,
            weights=weights,
            intrinsics=intrinsics,
            camera=camera,
            T_body_camera=frame.T_body_camera,
        )

    def track(self, observation: IsvdObservation) -> FrameResult:
        """Track the next frame, in time order."""
        self._nearest_match = None
        if not self._recent:
            return self._add_node(observation, np.eye(4), [], method="start")
        earlier = self._earlier()
        for match, method in ((self._config.match, "isvd"), (self._config.fallback, "fallback")):
            candidates = self._register(observation, earlier, match)
            if candidates:
                self._nearest_match = observation, candidates[0], match
                return self._add_node(observation, self._combine(candidates), candidates, method=method)
        candidates = self._relocalise(observation)
        if candidates:
            self._nearest_match = observation, candidates[0], self._config.match
            return self._add_node(observation, self._combine(candidates), candidates, method="relocalised")
        last_world = self._recent[-1].T_world_body
        return lost_frame(observation.stamp_ns, last_world, features=len(observation.features))

    def view(self, observation: IsvdObservation, _twist: Motion | None = None, /) -> ImageView:
        """Return the view for place recognition. Pure."""
        features, camera = observation.features, observation.camera
        return ImageView(
            stamp_ns=observation.stamp_ns,
            pixels=observation.measured[:, :2],
            sigma_px=self._detector.scale_factor ** features.octave.astype(np.float64),
            descriptors=features.descriptors,
            points_camera=apply(inverse(observation.T_body_camera), observation.points_body),
            intrinsics=camera.intrinsics,
            T_body_camera=observation.T_body_camera,
        )

    def matches(self) -> FeatureMatches | None:
        """Return the matches of the last frame with the nearest earlier one, matched again."""
        if self._nearest_match is None:
            return None
        observation, candidate, match = self._nearest_match
        earlier = candidate.earlier.observation
        pairs = matched_pairs(earlier, observation, match)
        motion = candidate.alignment.T_target_source
        then, now = pairs[self._registration.agreeing(earlier, observation, pairs, motion)].T
        before_px = np.full((len(observation.features), 2), np.nan)
        before_px[now] = earlier.measured[:, :2][then]
        return FeatureMatches(np.isfinite(before_px[:, 0]), before_px)

    def _undistorted(self, pixels: NDArray[np.float32], camera: PinholeCamera) -> Array:
        exact: Array = pixels.astype(np.float64)
        return camera.undistort(exact) if self._config.undistort else exact

    def _earlier(self) -> list[TrackedFrame]:
        """Return the MP earlier frames to register the next frame against, the one before it first."""
        count = self._config.previous_frames
        if self._config.earlier == "frames":
            return list(self._recent)[-count:][::-1]
        last = self._recent[-1]
        keyframes = [keyframe for keyframe in self._keyframes if keyframe.node != last.node]
        differences = self._view_differences(last, keyframes)
        nearest = np.argsort(differences, kind="stable")[: count - 1]
        return [last, *(keyframes[i].loaded() for i in nearest if differences[i] <= _NEAR_VIEW)]

    def _view_differences(self, frame: TrackedFrame, others: Sequence[_Keyframe]) -> Array:
        """Return (N,) how far views are apart: by shift relative to the depth of the scene, and by turn."""
        if not others:
            return np.empty(0)
        poses = np.array([other.T_world_body for other in others])
        depth_m = np.nanmedian(VIRTUAL_BASELINE_PX_M / frame.observation.measured[:, 2])
        shift = np.linalg.norm(poses[:, :3, 3] - frame.T_world_body[:3, 3], axis=1) / depth_m
        traces = np.einsum("nij,ij->n", poses[:, :3, :3], frame.T_world_body[:3, :3])
        turn = np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)) / _HALF_VIEW_RAD
        difference: Array = shift + turn
        return difference

    def _register(
        self, observation: IsvdObservation, earlier: Iterable[TrackedFrame], match: MatchConfig
    ) -> list[PoseCandidate]:
        """Return the registrations that succeeded, in the order of the earlier frames."""
        candidates = []
        for frame in earlier:
            alignment, weight, matches = self._register_pair(frame.observation, observation, match)
            if alignment.converged and self._is_possible(alignment, frame, observation):
                T = alignment.T_target_source
                assert alignment.information is not None  # it converged
                information = with_model_error(alignment.information, T)
                candidates.append(
                    PoseCandidate(frame, alignment, information, weight, matches, frame.T_world_body @ T)
                )
        return candidates

    def _is_possible(self, found: Alignment, earlier: TrackedFrame, now: IsvdObservation) -> bool:
        """Return whether the gyroscope, or across a gap something else, does not rule out a motion."""
        check, begin_ns, end_ns = self._motion_check, earlier.observation.stamp_ns, now.stamp_ns
        last, R_world_now = self._recent[-1], (earlier.T_world_body @ found.T_target_source)[:3, :3]
        if self._prior.reject(last.observation.stamp_ns, end_ns, last.T_world_body[:3, :3].T @ R_world_now):
            return False
        if check is None or not is_gap(begin_ns, end_ns):
            return True
        return not check.contradiction(found.T_target_source, begin_ns, end_ns)

    def _combine(self, candidates: Sequence[PoseCandidate]) -> Transform:
        """Return T_world_body; the nearest earlier frame comes first (alg. 7, lines 21–27)."""
        if self._config.average == "information":
            return mean_pose(
                candidates[0].T_world_body,
                (candidate.T_world_body for candidate in candidates),
                [candidate.information for candidate in candidates],
            )
        weights = np.array([candidate.weight for candidate in candidates])
        if self._config.average == "mean":
            weights = np.ones(len(candidates))
        poses = np.array([candidate.T_world_body for candidate in candidates])
        translation: Array = weights @ poses[:, :3, 3] / weights.sum()
        R_world_body = poses[0, :3, :3]
        if self._config.rotation == "mean":
            R_world_body = mean_rotation(poses[:, :3, :3], weights)
        return transform(R_world_body, translation)

    def _relocalise(self, observation: IsvdObservation) -> list[PoseCandidate]:
        """Return the registration against a keyframe that most pairs agree with; none if all failed."""
        keyframes = (keyframe.loaded() for keyframe in self._keyframes_to_try())
        candidates = self._register(observation, keyframes, self._config.match)
        return sorted(candidates, key=lambda candidate: -candidate.alignment.pairs)[:1]

    def _keyframes_to_try(self) -> list[_Keyframe]:
        """Return the keyframes nearest to the last tracked pose, and some of the others in turn."""
        last_world = self._recent[-1].T_world_body[:3, 3]
        by_distance = sorted(
            self._keyframes, key=lambda k: float(np.linalg.norm(k.T_world_body[:3, 3] - last_world))
        )
        far = by_distance[RELOCALISATION_KEYFRAMES:]
        in_turn = [far[(self._turn + i) % len(far)] for i in range(min(RELOCALISATION_KEYFRAMES, len(far)))]
        self._turn += len(in_turn)
        return by_distance[:RELOCALISATION_KEYFRAMES] + in_turn

    def _add_node(
        self,
        observation: IsvdObservation,
        T_world_body: Transform,
        candidates: Sequence[PoseCandidate],
        *,
        method: str,
    ) -> FrameResult:
        """Make the frame a node, with a factor from each candidate."""
        node = self._next_node
        self._next_node += 1
        tracked = TrackedFrame(node, observation, T_world_body)
        self._learn_turn(tracked)
        self._recent.append(tracked)
        if self._config.earlier == "frames":
            keyframe = self._sharpest.add(node, len(observation.features))
            self._keyframes.extend(_kept(frame) for frame in self._recent if frame.node == keyframe)
        elif not (self._view_differences(tracked, self._keyframes) < _NEW_VIEW).any():
            self._keyframes.append(_kept(tracked))
        nearest = candidates[0].alignment if candidates else None
        # All rest on this frame's features. Were the earlier ones' the same, too, each factor would have its
        # share of the information, were they others, all: it has the geometric mean.
        shared_by = math.sqrt(max(len(candidates), 1))
        factors = tuple(
            BetweenFactor(
                candidate.earlier.node,
                node,
                candidate.alignment.T_target_source,
                candidate.information / shared_by,
            )
            for candidate in candidates
        )
        return FrameResult(
            stamp_ns=observation.stamp_ns,
            node=node,
            T_node_body=np.eye(4),
            T_world_body=T_world_body,
            is_keyframe=True,
            diagnostics=Diagnostics(
                features=len(observation.features),
                matches=candidates[0].matches if candidates else 0,
                inliers=nearest.pairs if nearest else 0,
                residual=nearest.inlier_rmse_m if nearest else 0.0,
                residual_unit="m",
                method=method,
            ),
            factors=factors,
            links=factors,
        )

    def _learn_turn(self, tracked: TrackedFrame) -> None:
        """Let the prior compare the turn since the last frame with the gyroscope's."""
        if len(self._recent) < 2:
            return
        (R_before, before_ns), (R_last, last_ns), (R_now, now_ns) = (
            (frame.T_world_body[:3, :3], frame.observation.stamp_ns)
            for frame in (self._recent[-2], self._recent[-1], tracked)
        )
        share = (now_ns - last_ns) / (last_ns - before_ns)
        constant = rotation_exp(share * rotation_log(R_before.T @ R_last))
        self._prior.learn(last_ns, now_ns, R_last.T @ R_now, constant)


def align_images(
    target: Frame, source: Frame, config: IsvdOdometryConfig
) -> tuple[Alignment, dict[str, float]]:
    """Return the motion between two frames' features, and the seconds that "prepare" and "align" took.

    Args:
        target: Frame that stays.
        source: Frame that is aligned to it.
        config: The method; its fallback is tried where the first matching leads to no motion.

    Raises:
        ConfigError: A frame is a scan.
    """
    if not isinstance(target, RgbdFrame) or not isinstance(source, RgbdFrame):
        raise ConfigError("method isvd matches images, and these are scans; name frames of an RGB-D log")
    odometry = IsvdOdometry(config)
    began = time.perf_counter()
    seen_target = odometry.observe(target)
    detected = time.perf_counter()
    seen_source = odometry.observe(source)
    register = PairRegistration(config.registration, by_pixels=config.residual == "pixels")
    for match in (config.match, config.fallback):
        alignment, _, _ = register(seen_target, seen_source, match)
        if alignment.converged:
            break
    return alignment, {"prepare": detected - began, "align": time.perf_counter() - detected}
