"""The thesis's odometry: each frame registered against the frames before it ("ISLAM", alg. 7)."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.errors import FrameError
from mapper.core.frames import Frame, PinholeCamera, RgbdFrame
from mapper.core.geometry import Array, Points, Transform, apply, inverse, mean_rotation, transform
from mapper.features.detectors import Detector, Features
from mapper.features.factory import build_detector
from mapper.features.matching import Pairs, homography_inliers, match_mutual
from mapper.features.view import View
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import with_model_error
from mapper.odometry.base import Diagnostics, FrameResult, Matches
from mapper.odometry.config import IsvdOdometryConfig, MatchConfig
from mapper.odometry.keyframes import SharpestKeyframes
from mapper.registration.base import Alignment
from mapper.registration.isvd import Isvd
from mapper.sensing.depth_filter import dif
from mapper.sources.base import FrameRef


@dataclass(frozen=True, slots=True, eq=False)
class IsvdObservation:
    """A frame's features and where they are.

    Attributes:
        stamp_ns: The frame's stamp.
        features: Of the image.
        points_body: (N, 3) metres, body frame; NaN where the depth image has no measurement.
        camera: What took the image.
        T_body_camera: (4, 4) pose of the camera in the body frame.
    """

    stamp_ns: int
    features: Features
    points_body: Points
    camera: PinholeCamera
    T_body_camera: Transform


Compare = Callable[[IsvdObservation, IsvdObservation, MatchConfig], tuple[Alignment, float, int]]
"""What ``compared`` does, by an ISVD of its own."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A frame that has its place: node, what it saw, and T_world_body as estimated then."""

    node: int
    observation: IsvdObservation
    T_world_body: Transform


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A frame's registration against an earlier one.

    Attributes:
        earlier: The frame it was registered against.
        alignment: The motion found, earlier ← new.
        weight: Its quality W, 1/m (eq. 4.1).
        matches: Feature pairs it began with, with or without depth.
        T_world_body: The new frame's pose as this registration sees it.
    """

    earlier: Placed
    alignment: Alignment
    weight: float
    matches: int
    T_world_body: Transform


class IsvdOdometry:
    """Registers every frame against the MP frames before it and averages what they say.

    Every frame that finds its place is a node, and every registration that led to it is a factor. Their
    information is that of the rigid fit; it counts pairs as independent, although frames in a row share
    features and depth errors, so it is right in proportion rather than in size.
    """

    def __init__(
        self,
        config: IsvdOdometryConfig,
        *,
        detector: Detector | None = None,
        compare: Compare | None = None,
    ) -> None:
        """Start before the first frame.

        Args:
            config: Every knob.
            detector: Stands in for the configured one, so that odometries that look at the same frames
                need not detect again.
            compare: Stands in for ``compared``, so that those that register alike need not register again.
        """
        self._config = config
        self._detector = detector or build_detector(config.detector)
        self._compare = compare or partial(compared, Isvd(config.registration))
        self._recent: deque[Placed] = deque(maxlen=max(config.previous_frames, config.keyframe_interval))
        self._keyframes: list[Placed] = []
        self._sharpest = SharpestKeyframes(config.keyframe_interval)
        self._next_node = 0
        self._turn = 0
        self._held: tuple[IsvdObservation, Candidate, MatchConfig] | None = None

    def read(self, entry: FrameRef) -> IsvdObservation:
        """Observe a frame of a log, without its colours. Pure.

        Raises:
            FrameError: It cannot be read, or not be used.
        """
        return self.observe(entry.load(colour=False))

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
        """Place the next observation, in time order."""
        self._held = None
        if not self._recent:
            return self._place(observation, np.eye(4), [], method="start")
        recent = list(self._recent)[-self._config.previous_frames :][::-1]
        for match, method in ((self._config.match, "isvd"), (self._config.fallback, "fallback")):
            candidates = self._register(observation, recent, match)
            if candidates:
                self._held = observation, candidates[0], match
                return self._place(observation, self._combine(candidates), candidates, method=method)
        candidates = self._relocalise(observation)
        if candidates:
            self._held = observation, candidates[0], self._config.match
            return self._place(observation, self._combine(candidates), candidates, method="relocalised")
        diagnostics = Diagnostics(len(observation.features), 0, 0, 0.0, "m", "lost")
        return FrameResult(
            observation.stamp_ns, None, np.eye(4), self._recent[-1].T_world_body, False, diagnostics
        )

    def view(self, observation: IsvdObservation, _twist: Twist | None = None, /) -> View:
        """Return what a place is recognised by. Pure."""
        features, camera = observation.features, observation.camera
        return View(
            stamp_ns=observation.stamp_ns,
            pixels=self._pixels(observation),
            sigma_px=self._detector.scale_factor ** features.octave.astype(np.float64),
            descriptors=features.descriptors,
            points_camera=apply(inverse(observation.T_body_camera), observation.points_body),
            intrinsics=np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
            T_body_camera=observation.T_body_camera,
        )

    def matches(self) -> Matches | None:
        """Match the last frame once more with the nearest that it was registered against."""
        if self._held is None:
            return None
        observation, candidate, match = self._held
        earlier = candidate.earlier.observation
        then, now = matched_pairs(earlier, observation, match).T
        moved = apply(candidate.alignment.T_target_source, observation.points_body[now])
        miss_m = np.linalg.norm(earlier.points_body[then] - moved, axis=1)
        agreeing = miss_m <= self._config.registration.agreement_mm / 1e3  # what has no depth does not
        now, then = now[agreeing], then[agreeing]
        before_px = np.full((len(observation.features), 2), np.nan)
        before_px[now] = self._pixels(earlier)[then]
        return Matches(np.isfinite(before_px[:, 0]), before_px)

    def finish(self) -> Sequence[BetweenFactor]:
        """Return nothing: every measurement was final when its frame was tracked."""
        return ()

    def _pixels(self, observation: IsvdObservation) -> Array:
        pixels: Array = observation.features.pixels.astype(np.float64)
        return observation.camera.undistort(pixels) if self._config.undistort else pixels

    def _points_body(self, frame: RgbdFrame, features: Features) -> Points:
        config, camera = self._config, frame.camera
        depth_m = dif(frame.depth_m) if config.depth_filter else frame.depth_m
        # Depth is registered to the raw image, so it is looked up before the lens is corrected for.
        nearest = np.rint(features.pixels).astype(np.intp)
        columns = np.clip(nearest[:, 0], 0, camera.width_px - 1)
        rows = np.clip(nearest[:, 1], 0, camera.height_px - 1)
        z = depth_m[rows, columns].astype(np.float64)
        z[(z <= 0.0) | (z > config.max_depth_m)] = np.nan
        pixels = camera.undistort(features.pixels) if config.undistort else features.pixels
        rays = (pixels - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
        return apply(frame.T_body_camera, np.column_stack([rays * z[:, None], z]))

    def _register(
        self, observation: IsvdObservation, earlier: Iterable[Placed], match: MatchConfig
    ) -> list[Candidate]:
        """Return the registrations that succeeded, in the order of the earlier frames."""
        candidates = []
        for placed in earlier:
            alignment, weight, matches = self._compare(placed.observation, observation, match)
            if alignment.converged:
                T_world_body = placed.T_world_body @ alignment.T_target_source
                candidates.append(Candidate(placed, alignment, weight, matches, T_world_body))
        return candidates

    def _combine(self, candidates: Sequence[Candidate]) -> Transform:
        """Return one T_world_body; the nearest earlier frame comes first (alg. 7, lines 21 to 27)."""
        weights = np.array([candidate.weight for candidate in candidates])
        if self._config.average == "mean":
            weights = np.ones(len(candidates))
        poses = np.array([candidate.T_world_body for candidate in candidates])
        translation: Array = weights @ poses[:, :3, 3] / weights.sum()
        R_world_body = poses[0, :3, :3]
        if self._config.rotation == "mean":
            R_world_body = mean_rotation(poses[:, :3, :3], weights)
        return transform(R_world_body, translation)

    def _relocalise(self, observation: IsvdObservation) -> list[Candidate]:
        """Return the registration against the keyframe that most features match, if one succeeds."""
        candidates = self._register(observation, self._keyframes_to_try(), self._config.match)
        return sorted(candidates, key=lambda candidate: -candidate.alignment.pairs)[:1]

    def _keyframes_to_try(self) -> list[Placed]:
        """Return the keyframes nearest to where tracking ended, and some of the others in turn."""
        count = self._config.relocalisation_keyframes
        last_world = self._recent[-1].T_world_body[:3, 3]
        by_distance = sorted(
            self._keyframes, key=lambda k: float(np.linalg.norm(k.T_world_body[:3, 3] - last_world))
        )
        far = by_distance[count:]
        in_turn = [far[(self._turn + i) % len(far)] for i in range(min(count, len(far)))]
        self._turn += len(in_turn)
        return by_distance[:count] + in_turn

    def _place(
        self,
        observation: IsvdObservation,
        T_world_body: Transform,
        candidates: Sequence[Candidate],
        *,
        method: str,
    ) -> FrameResult:
        """Make the frame a node, remember it, and report its measurements."""
        node = self._next_node
        self._next_node += 1
        self._recent.append(Placed(node, observation, T_world_body))
        keyframe = self._sharpest.add(node, len(observation.features))
        self._keyframes.extend(placed for placed in self._recent if placed.node == keyframe)
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


def compared(
    isvd: Isvd, target: IsvdObservation, source: IsvdObservation, match: MatchConfig
) -> tuple[Alignment, float, int]:
    """Return the source's motion to the target, its quality W (eq. 4.1), and how many features matched."""
    pairs = matched_pairs(target, source, match)
    return *isvd.fit_weighted(*shared_points(target, source, pairs)), len(pairs)


def matched_pairs(target: IsvdObservation, source: IsvdObservation, match: MatchConfig) -> Pairs:
    """Return the features that two frames share (thesis alg. 8)."""
    pairs = match_mutual(target.features, source.features, max_ratio=match.max_ratio)
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
    """Return the (M, 3) points of the pairs with depth on both sides, each in its own body frame."""
    points_target, points_source = target.points_body[pairs[:, 0]], source.points_body[pairs[:, 1]]
    measured = np.isfinite(points_target[:, 2]) & np.isfinite(points_source[:, 2])
    return points_target[measured], points_source[measured]
