"""ISVD odometry: each frame registered against several earlier ones (Somlyai, PhD thesis, alg. 7)."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapper.core.deskew import Twist
from mapper.core.errors import FrameError
from mapper.core.frames import Frame, PinholeCamera, RgbdFrame
from mapper.core.geometry import Array, Transform, apply, inverse
from mapper.core.timebase import NS_PER_S
from mapper.features.base import Detector, Features
from mapper.features.factory import build_detector
from mapper.features.frame_view import ImageView
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import with_model_error
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
from mapper.odometry.isvd.earlier_frames import EarlierFrames
from mapper.odometry.isvd.frames import PoseCandidate, TrackedFrame, average_pose
from mapper.odometry.isvd.readout import readout_in_pair
from mapper.odometry.isvd.registration import IsvdObservation, PairRegistration, RegisterPair
from mapper.odometry.isvd.registration_errors import RegistrationErrors
from mapper.odometry.local_map.calibration.rolling_shutter import RollingShutter
from mapper.odometry.local_map.observation.readout_time import ReadoutTime
from mapper.registration.base import Alignment
from mapper.registration.reprojection import disparity_sigmas_px, image_measurements
from mapper.sensing.config import KINECT_NOISE
from mapper.sensing.depth_filter import dif
from mapper.sensing.depth_noise import depth_sigma_m, feature_depth_m

_DEPTH_SHARE = 0.01
"""Error of depths beside the sensor's noise, as a share: its scale, and the slope where a feature lies."""
_PAIRS_SHARING, _PAIRS_COUNTED = 4, 200
"""Pairs of images that show the readout time: a new image is in one, a keyframe in some 20, their geometric
mean; and how many of them the estimate is from."""


class IsvdOdometry(FrameOdometry[IsvdObservation]):
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
    ) -> None:
        """Start before the first frame.

        Args:
            config: Settings.
            detector: Replaces the configured one, so that several odometries on the same frames can share
                the detection.
            register: Replaces the registration, so that they can share registrations as well.
            motion_check: Rules out poses after a gap; None if only the images measure the motion.
        """
        self._config = config
        self._motion_check = motion_check
        self._detector = detector or build_detector(config.detector)
        self._registration = PairRegistration(config)
        self._register_pair = register or self._registration
        self._earlier = EarlierFrames(config)
        self._next_node = 0
        self._nearest_match: tuple[IsvdObservation, PoseCandidate] | None = None
        self._readout = ReadoutTime(
            config.readout_s, windows_sharing=_PAIRS_SHARING, windows_counted=_PAIRS_COUNTED
        )
        self._shutter = RollingShutter(self._readout)
        self._errors = RegistrationErrors()

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
        sigma_m = np.hypot(depth_sigma_m(config.depth_noise or KINECT_NOISE, z), _DEPTH_SHARE * z)
        measured, weights, intrinsics = image_measurements(
            pixels,
            z,
            camera.intrinsics,
            sigma_px=self._sigma_px(features),
            disparity_sigma_px=disparity_sigmas_px(z, sigma_m),
        )
        return IsvdObservation(
            stamp_ns=frame.stamp_ns,
            features=features,
            points_body=apply(frame.T_body_camera, np.column_stack([camera.rays(at) * z[:, None], z])),
            measured=measured,
            weights=weights,
            intrinsics=intrinsics,
            camera=camera,
            T_body_camera=frame.T_body_camera,
        )

    def track(self, observation: IsvdObservation) -> FrameResult:
        """Track the next frame, in time order."""
        self._nearest_match = None
        last = self._earlier.last
        if last is None:
            return self._add_node(observation, np.eye(4), [], method="start")
        if not self._follows(observation):
            self._shutter.restart()  # the motion before a gap is not that in this image
        candidates, method = self._candidates(self._shutter.predicted(observation))
        if candidates:
            pose = average_pose(candidates, self._config)
            return self._add_node(observation, pose, candidates, method=method)
        return lost_frame(observation.stamp_ns, last.T_world_body, features=len(observation.features))

    def view(self, observation: IsvdObservation, twist: Twist | None = None, /) -> ImageView:
        """Return the view for place recognition, by the readout time as it is known now."""
        if twist is not None:
            observation = self._shutter.corrected(observation, twist)
        return ImageView(
            stamp_ns=observation.stamp_ns,
            pixels=observation.measured[:, :2],
            sigma_px=self._sigma_px(observation.features),
            descriptors=observation.features.descriptors,
            points_camera=apply(inverse(observation.T_body_camera), observation.points_body),
            intrinsics=observation.camera.intrinsics,
            T_body_camera=observation.T_body_camera,
        )

    def matches(self) -> FeatureMatches | None:
        """Return the matches of the last frame with the nearest earlier one."""
        if self._nearest_match is None:
            return None
        observation, candidate = self._nearest_match
        earlier, pairs = self._corrected(candidate.earlier), candidate.pairs
        motion = candidate.alignment.T_target_source
        then, now = pairs[self._registration.agreeing(earlier, observation, pairs, motion)].T
        before_px = np.full((len(observation.features), 2), np.nan)
        before_px[now] = earlier.measured[:, :2][then]
        return FeatureMatches(np.isfinite(before_px[:, 0]), before_px)

    def sensor_notes(self) -> Sequence[str]:
        """Return the estimated readout time of the camera's shutter, if it has any."""
        return [self._readout.sentence] if self._readout.sentence else []

    def calibration_warnings(self) -> Sequence[str]:
        """Return nothing: pairs of images show no focal length."""
        return ()

    def _follows(self, observation: IsvdObservation) -> bool:
        """Return whether a frame is soon after the last tracked one."""
        last = self._earlier.last
        return last is not None and not is_gap(last.observation.stamp_ns, observation.stamp_ns)

    def _corrected(self, frame: TrackedFrame) -> IsvdObservation:
        """Return what a frame observed, by the readout time as it is known now."""
        return self._shutter.corrected(frame.observation, frame.twist)

    def _sigma_px(self, features: Features) -> Array:
        """Return the (N,) standard deviations of features' pixels: one pixel of their pyramid level."""
        return self._detector.scale_factor ** features.octave.astype(np.float64)

    def _undistorted(self, pixels: NDArray[np.float32], camera: PinholeCamera) -> Array:
        exact: Array = pixels.astype(np.float64)
        return camera.undistort(exact) if self._config.undistort else exact

    def _candidates(self, observation: IsvdObservation) -> tuple[list[PoseCandidate], str]:
        """Return the registrations of a frame, and how they were found; none if all failed."""
        earlier = self._earlier.to_register()
        for match, method in ((self._config.match, "isvd"), (self._config.fallback, "fallback")):
            if candidates := self._register(observation, earlier, match):
                return candidates, method
        keyframes = (keyframe.loaded() for keyframe in self._earlier.to_relocalise())
        candidates = self._register(observation, keyframes, self._config.match)
        # Of keyframes from anywhere, only that counts with which most pairs agree.
        return sorted(candidates, key=lambda candidate: -candidate.alignment.pairs)[:1], "relocalised"

    def _register(
        self, observation: IsvdObservation, earlier: Iterable[TrackedFrame], match: MatchConfig
    ) -> list[PoseCandidate]:
        """Return the registrations that succeeded, in the order of the earlier frames."""
        candidates = []
        for frame in earlier:
            found = self._register_pair(self._corrected(frame), observation, match)
            alignment = found.alignment
            if alignment.converged and self._is_possible(alignment, frame.observation, observation):
                T = alignment.T_target_source
                assert alignment.information is not None  # it converged
                information = with_model_error(alignment.information, T)
                candidates.append(
                    PoseCandidate(
                        frame, alignment, information, found.weight, found.pairs, frame.T_world_body @ T
                    )
                )
        return candidates

    def _is_possible(self, found: Alignment, earlier: IsvdObservation, now: IsvdObservation) -> bool:
        """Return whether a motion across a gap is possible by another measurement of it, if any."""
        check, begin_ns, end_ns = self._motion_check, earlier.stamp_ns, now.stamp_ns
        if check is None or not is_gap(begin_ns, end_ns):
            return True
        return not check.contradiction(found.T_target_source, begin_ns, end_ns)

    def _add_node(
        self,
        observation: IsvdObservation,
        T_world_body: Transform,
        candidates: Sequence[PoseCandidate],
        *,
        method: str,
    ) -> FrameResult:
        """Make the frame a node, with a factor from each candidate.

        Args:
            observation: Observation as its rows were read.
            T_world_body: (4, 4) pose of the frame.
            candidates: Its registrations, the nearest earlier frame's first.
            method: Word for what found them.
        """
        node = self._next_node
        self._next_node += 1
        twist = self._follow(observation, T_world_body)
        tracked = TrackedFrame(node, observation, T_world_body, twist)
        self._learn(tracked, candidates)
        if candidates:
            self._nearest_match = self._corrected(tracked), candidates[0]
        self._earlier.add(tracked)
        self._errors.add(observation.stamp_ns, candidates)
        factors = self._factors(node, candidates)
        return FrameResult(
            stamp_ns=observation.stamp_ns,
            node=node,
            T_node_body=np.eye(4),
            T_world_body=T_world_body,
            is_keyframe=True,
            diagnostics=_diagnostics(observation, candidates, method),
            factors=factors,
            links=factors,
            twist=twist,
        )

    def _factors(self, node: int, candidates: Sequence[PoseCandidate]) -> tuple[BetweenFactor, ...]:
        """Return a factor from each candidate's earlier frame.

        All rest on this frame's features. Were the earlier ones' the same, too, each factor would have its
        share of the information, were they others, all: it has the geometric mean.
        """
        shared_by = math.sqrt(max(len(candidates), 1))
        return tuple(
            BetweenFactor(
                candidate.earlier.node,
                node,
                candidate.alignment.T_target_source,
                self._errors.rescaled(candidate) / shared_by,
            )
            for candidate in candidates
        )

    def _follow(self, observation: IsvdObservation, T_world_body: Transform) -> Twist:
        """Return the velocity of the body in a frame's image, by its pose and that of the frame before."""
        before = self._earlier.last
        if before is not None and self._follows(observation):
            T_body_camera = observation.T_body_camera
            T_before_camera = inverse(before.T_world_body @ T_body_camera) @ T_world_body @ T_body_camera
            elapsed_ns = observation.stamp_ns - before.observation.stamp_ns
            self._shutter.follow(T_before_camera, elapsed_ns / NS_PER_S)
        return self._shutter.twist_body(observation)

    def _learn(self, tracked: TrackedFrame, candidates: Sequence[PoseCandidate]) -> None:
        """Take the readout time from the frame and the nearest keyframe, where the motion was another."""
        if not self._readout.is_estimated or len(candidates) < 2:
            return
        candidate = candidates[1]
        self._readout.learn(
            *readout_in_pair(
                self._corrected(candidate.earlier),
                self._corrected(tracked),
                candidate.pairs,
                candidate.alignment.T_target_source,
                twists_body=(candidate.earlier.twist, tracked.twist),
            )
        )


def _diagnostics(
    observation: IsvdObservation, candidates: Sequence[PoseCandidate], method: str
) -> Diagnostics:
    nearest = candidates[0].alignment if candidates else None
    return Diagnostics(
        features=len(observation.features),
        matches=len(candidates[0].pairs) if candidates else 0,
        inliers=nearest.pairs if nearest else 0,
        residual=nearest.inlier_rmse_m if nearest else 0.0,
        residual_unit="m",
        method=method,
    )
