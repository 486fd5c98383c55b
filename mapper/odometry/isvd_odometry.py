"""ISVD odometry: each frame registered against the frames before it (Somlyai, PhD thesis, alg. 7)."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.errors import FrameError
from mapper.core.frames import Frame, PinholeCamera, RgbdFrame
from mapper.core.geometry import Array, Points, Transform, apply, inverse, mean_rotation, transform
from mapper.features.base import Detector, Features
from mapper.features.factory import build_detector
from mapper.features.frame_view import ImageView
from mapper.features.matching import Pairs, homography_inliers, match_mutual
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import with_model_error
from mapper.odometry.base import (
    STEADY_NS,
    Diagnostics,
    FeatureMatches,
    FrameOdometry,
    FrameResult,
    MotionCheck,
    lost_frame,
)
from mapper.odometry.config import IsvdOdometryConfig, MatchConfig
from mapper.odometry.sharpest_keyframe import SharpestKeyframes
from mapper.registration.base import Alignment
from mapper.registration.isvd import Isvd
from mapper.runtime.archived import Archivable, Archived, archived
from mapper.sensing.depth_filter import dif
from mapper.sensing.depth_noise import feature_depth_m


@dataclass(frozen=True, slots=True, eq=False)
class IsvdObservation(Archivable):
    """A frame's features with their 3D points.

    Attributes:
        stamp_ns: The frame's stamp.
        features: Features of the image.
        points_body: (N, 3) metres, body frame; NaN where the depth image has no measurement.
        camera: Camera of the image.
        T_body_camera: (4, 4) pose of the camera in the body frame.
    """

    stamp_ns: int
    features: Features
    points_body: Points
    camera: PinholeCamera
    T_body_camera: Transform


RegisterPair = Callable[[IsvdObservation, IsvdObservation, MatchConfig], tuple[Alignment, float, int]]
"""Registration of two observations (target, source), as ``register_pair`` with an ISVD bound."""


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


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """Registration of a new frame against an earlier one.

    Attributes:
        earlier: The earlier frame, the target.
        alignment: The motion, earlier ← new.
        weight: Its quality W, 1/m (eq. 4.1).
        matches: Number of matched features, with or without depth.
        T_world_body: (4, 4) pose of the new frame by this registration.
    """

    earlier: TrackedFrame
    alignment: Alignment
    weight: float
    matches: int
    T_world_body: Transform


class IsvdOdometry(FrameOdometry[IsvdObservation]):
    """Odometry that registers every frame against the MP frames before it and averages the poses.

    Every tracked frame is a node, and every registration that succeeded is a factor. Its information is that
    of the rigid fit: it takes pairs as independent although consecutive frames share features and depth
    errors, so it is right in proportion but too large.
    """

    def __init__(
        self,
        config: IsvdOdometryConfig,
        *,
        detector: Detector | None = None,
        register: RegisterPair | None = None,
        motion_check: MotionCheck | None = None,
    ) -> None:
        """Start before the first frame.

        Args:
            config: Settings.
            detector: Replaces the configured one, so that several odometries on the same frames can share
                the detection.
            register: Replaces ``register_pair``, so that they can share registrations as well.
            motion_check: Rules out poses after a gap; None if nothing but the images tells of the motion.
        """
        self._config = config
        self._motion_check = motion_check
        self._detector = detector or build_detector(config.detector)
        self._register_pair = register or partial(register_pair, Isvd(config.registration))
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
        points_body = self._points_body(frame, features)
        return IsvdObservation(frame.stamp_ns, features, points_body, frame.camera, frame.T_body_camera)

    def track(self, observation: IsvdObservation) -> FrameResult:
        """Track the next frame, in time order."""
        self._nearest_match = None
        if not self._recent:
            return self._add_node(observation, np.eye(4), [], method="start")
        recent = list(self._recent)[-self._config.previous_frames :][::-1]
        for match, method in ((self._config.match, "isvd"), (self._config.fallback, "fallback")):
            candidates = self._register(observation, recent, match)
            if candidates:
                self._nearest_match = observation, candidates[0], match
                return self._add_node(observation, self._combine(candidates), candidates, method=method)
        candidates = self._relocalise(observation)
        if candidates:
            self._nearest_match = observation, candidates[0], self._config.match
            return self._add_node(observation, self._combine(candidates), candidates, method="relocalised")
        last_world = self._recent[-1].T_world_body
        return lost_frame(observation.stamp_ns, last_world, features=len(observation.features))

    def view(self, observation: IsvdObservation, _twist: Twist | None = None, /) -> ImageView:
        """Return the view for place recognition. Pure."""
        features, camera = observation.features, observation.camera
        return ImageView(
            stamp_ns=observation.stamp_ns,
            pixels=self._pixels(observation),
            sigma_px=self._detector.scale_factor ** features.octave.astype(np.float64),
            descriptors=features.descriptors,
            points_camera=apply(inverse(observation.T_body_camera), observation.points_body),
            intrinsics=np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
            T_body_camera=observation.T_body_camera,
        )

    def matches(self) -> FeatureMatches | None:
        """Return the matches of the last frame with the nearest earlier one, matched again."""
        if self._nearest_match is None:
            return None
        observation, candidate, match = self._nearest_match
        earlier = candidate.earlier.observation
        then, now = matched_pairs(earlier, observation, match).T
        moved = apply(candidate.alignment.T_target_source, observation.points_body[now])
        miss_m = np.linalg.norm(earlier.points_body[then] - moved, axis=1)
        agreeing = miss_m <= self._config.registration.agreement_mm / 1e3  # False without depth
        now, then = now[agreeing], then[agreeing]
        before_px = np.full((len(observation.features), 2), np.nan)
        before_px[now] = self._pixels(earlier)[then]
        return FeatureMatches(np.isfinite(before_px[:, 0]), before_px)

    def _pixels(self, observation: IsvdObservation) -> Array:
        pixels: Array = observation.features.pixels.astype(np.float64)
        return observation.camera.undistort(pixels) if self._config.undistort else pixels

    def _points_body(self, frame: RgbdFrame, features: Features) -> Points:
        config, camera = self._config, frame.camera
        depth_m = dif(frame.depth_m) if config.depth_filter else frame.depth_m
        z, _, _ = feature_depth_m(depth_m, features.pixels)
        z[z > config.max_depth_m] = np.nan
        pixels = np.rint(features.pixels) if config.whole_pixels else features.pixels
        if config.undistort:
            pixels = camera.undistort(pixels)
        rays = (pixels - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
        return apply(frame.T_body_camera, np.column_stack([rays * z[:, None], z]))

    def _register(
        self, observation: IsvdObservation, earlier: Iterable[TrackedFrame], match: MatchConfig
    ) -> list[PoseCandidate]:
        """Return the registrations that succeeded, in the order of the earlier frames."""
        candidates = []
        for frame in earlier:
            alignment, weight, matches = self._register_pair(frame.observation, observation, match)
            if alignment.converged and self._is_possible(alignment, frame.observation, observation):
                T_world_body = frame.T_world_body @ alignment.T_target_source
                candidates.append(PoseCandidate(frame, alignment, weight, matches, T_world_body))
        return candidates

    def _is_possible(self, found: Alignment, earlier: IsvdObservation, now: IsvdObservation) -> bool:
        """Return whether a motion across a gap is possible, where something else tells it."""
        check, begin_ns, end_ns = self._motion_check, earlier.stamp_ns, now.stamp_ns
        if check is None or end_ns - begin_ns <= STEADY_NS:
            return True
        return not check.contradiction(found.T_target_source, begin_ns, end_ns)

    def _combine(self, candidates: Sequence[PoseCandidate]) -> Transform:
        """Return T_world_body; the nearest earlier frame comes first (alg. 7, lines 21–27)."""
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
        count = self._config.relocalisation_keyframes
        last_world = self._recent[-1].T_world_body[:3, 3]
        by_distance = sorted(
            self._keyframes, key=lambda k: float(np.linalg.norm(k.T_world_body[:3, 3] - last_world))
        )
        far = by_distance[count:]
        in_turn = [far[(self._turn + i) % len(far)] for i in range(min(count, len(far)))]
        self._turn += len(in_turn)
        return by_distance[:count] + in_turn

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
        self._recent.append(TrackedFrame(node, observation, T_world_body))
        keyframe = self._sharpest.add(node, len(observation.features))
        self._keyframes.extend(
            _Keyframe(frame.node, archived(frame.observation), frame.T_world_body)
            for frame in self._recent
            if frame.node == keyframe
        )
        nearest = candidates[0].alignment if candidates else None
        factors = tuple(
            BetweenFactor(
                candidate.earlier.node,
                node,
                alignment.T_target_source,
                with_model_error(alignment.information, alignment.T_target_source),
            )
            for candidate in candidates
            if (alignment := candidate.alignment).information is not None
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


def register_pair(
    isvd: Isvd, target: IsvdObservation, source: IsvdObservation, match: MatchConfig
) -> tuple[Alignment, float, int]:
    """Return the source's alignment to the target, its quality W (eq. 4.1), and the number of matches."""
    pairs = matched_pairs(target, source, match)
    return *isvd.fit_weighted(*shared_points(target, source, pairs)), len(pairs)


def matched_pairs(target: IsvdObservation, source: IsvdObservation, match: MatchConfig) -> Pairs:
    """Return the features that two frames share (Somlyai, PhD thesis, alg. 8).

    The ratio test is one of the new frame's features, the source's, as alg. 7 calls match with them first.
    """
    pairs = match_mutual(source.features, target.features, max_ratio=match.max_ratio)[:, ::-1]
    if match.filter == "homography":
        pairs = pairs[
            homography_inliers(
                target.features.pixels[pairs[:, 0]],
                source.features.pixels[pairs[:, 1]],
                tolerance_px=match.homography_tolerance_px,
                iterations=match.homography_iterations,
                seed=match.seed,
            )
        ]
    return pairs


def shared_points(target: IsvdObservation, source: IsvdObservation, pairs: Pairs) -> tuple[Points, Points]:
    """Return the (M, 3) points of the pairs with depth in both frames, each in its own body frame."""
    points_target, points_source = target.points_body[pairs[:, 0]], source.points_body[pairs[:, 1]]
    measured = np.isfinite(points_target[:, 2]) & np.isfinite(points_source[:, 2])
    return points_target[measured], points_source[measured]
