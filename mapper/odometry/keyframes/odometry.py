"""Odometry against a local map of keyframes and landmarks (Mur-Artal & Tardós 2017; Zhao et al. 2020)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mapper.core.deskew import Motion, Twist
from mapper.core.frames import Frame
from mapper.core.geometry import Array, Transform, inverse
from mapper.features.factory import build_detector
from mapper.features.frame_view import ImageView
from mapper.graph.measurement_covariance import inflated, with_model_error
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
from mapper.odometry.camera.image_observation import ImageObservation, observe_image
from mapper.odometry.camera.readout_time import ReadoutTime
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.depth_comparison import EarlierDepth
from mapper.odometry.keyframes.frame_doubts import UNDOUBTED, Assessment, FrameDoubts
from mapper.odometry.keyframes.keyframe_decision import KeyframeDecision
from mapper.odometry.keyframes.landmarks import LandmarkMap
from mapper.odometry.keyframes.local_mapping import LocalMapping
from mapper.odometry.keyframes.pose_tracker import (
    PoseTracker,
    TrackedPose,
    predict_by_turn,
    predict_by_velocity,
)
from mapper.odometry.keyframes.relocalizer import Relocalizer
from mapper.odometry.keyframes.rolling_shutter import RollingShutter
from mapper.odometry.keyframes.tracking import Tracking
from mapper.odometry.motion_prior import MotionPrior, WithMotionPrior
from mapper.places.vocabulary import load_vocabulary
from mapper.sensing.gyroscope import Gyroscope

_OWN_SHARE = 0.5
"""Share of a pose's information that is left as its landmarks were measured no better than its features."""

MakePoseTracker = Callable[[LandmarkMap, Relocalizer], PoseTracker]


class KeyframeOdometry(WithMotionPrior, FrameOdometry[ImageObservation]):
    """Odometry against keyframes' landmarks, both refined by local bundle adjustment.

    Keyframes are the graph's nodes, numbered from 0. Their poses keep improving while they are in the window,
    so ``finish`` returns all factors.
    """

    def __init__(
        self,
        config: KeyframeOdometryConfig,
        make_tracker: MakePoseTracker,
        motion_check: MotionCheck | None = None,
        gyroscope: Gyroscope | None = None,
    ) -> None:
        """Start before the first frame.

        Args:
            config: Settings.
            make_tracker: Makes the pose tracker.
            motion_check: Rules out poses after a gap; None if only the images measure the motion.
            gyroscope: Angular velocities of the log; None if it has none.
        """
        self._config = config
        self._detector = build_detector(config.detector)
        self._vocabulary = load_vocabulary(config.vocabulary)
        readout = ReadoutTime(config.readout_s, windows_sharing=config.bundle_keyframes)
        self._map = LandmarkMap(scale_factor=self._detector.scale_factor, readout=readout)
        relocalizer = Relocalizer(config, self._map, self._vocabulary)
        tracker = make_tracker(self._map, relocalizer)
        self._prior = MotionPrior(gyroscope)
        self._tracking = Tracking(config, self._map, relocalizer, tracker, motion_check, self._prior)
        self._shutter = RollingShutter(readout)
        self._earlier_depth = EarlierDepth(self._map, config.depth_noise)
        self._doubts = FrameDoubts()
        self._decision = KeyframeDecision(config)
        self._mapping = LocalMapping(config, self._map, relocalizer)
        self._last: TrackedPose | None = None
        self._before_last: TrackedPose | None = None
        self._agreeing = np.zeros(0, np.bool_)  # features by which the last frame was tracked

    def observe(self, frame: Frame) -> ImageObservation:
        """Detect features and look up their depth. Pure; safe in any thread.

        Raises:
            FrameError: The frame is a bare scan.
        """
        return observe_image(frame, self._detector, self._vocabulary, self._config)

    def track(self, observation: ImageObservation) -> FrameResult:
        """Track the next frame, in time order: predict, find its pose, assess it, extend the map."""
        last, was_lost = self._last, self._tracking.is_lost
        follows = last is not None and not was_lost and not is_gap(last.stamp_ns, observation.stamp_ns)
        repeats = last is not None and observation.repeats(last.observation)
        if not follows:
            self._shutter.restart()  # the motion before a gap is not that in this image
        observation = self._shutter.predict(observation)
        by_velocity, expected = self._predict(observation.stamp_ns)
        pose = None if last is None else self._tracking.find_pose(observation, last, expected)
        if last is None or pose is None:
            return self._begin_sub_map_or_lose(observation)
        if follows and not repeats:
            pose = self._shutter.refine(pose, last, self._map.positions_of(pose.landmark_of_feature))
        information = self._tracking.information(pose)
        displaced = self._earlier_depth.displacement(pose.observation, pose.T_camera_world, pose.reference)
        assessed = self._doubts.assess(
            pose, covariance_of(information), last, expected, displaced, repeats=repeats
        )
        if follows and not assessed.doubts:
            self._learn_turn(last, pose, by_velocity)
        if not (follows and repeats):  # of an image the first stamp counts, by which velocities are known
            # The motion before a gap does not predict the motion after it.
            self._before_last, self._last = None if was_lost else last, pose
        self._agreeing = pose.landmark_of_feature >= 0
        if self._decision.is_due(pose, assessed):
            return self._add_keyframe(pose, neighbour=pose.reference, assessed=assessed)
        return self._frame(pose, information, assessed)

    def view(self, observation: ImageObservation, twist: Motion | None = None, /) -> ImageView:
        """Return the view for place recognition, by the readout time as it is known now."""
        return (self._shutter.correct(observation, twist) if isinstance(twist, Twist) else observation).view()

    def matches(self) -> FeatureMatches | None:
        """Return the features matched to landmarks, and these landmarks' pixels in an earlier frame."""
        last = self._last
        if last is None or self._tracking.is_lost:
            return None
        landmarks = last.landmark_of_feature
        previous_px = np.full((len(landmarks), 2), np.nan)
        keyframe, before = self._map.keyframes[last.reference], self._before_last
        earlier = [(keyframe.landmark_of_feature, self._map.observation(last.reference))]
        if before is not None:
            earlier.append((before.landmark_of_feature, before.observation))
        for ids, observation in earlier:
            if observation.stamp_ns != last.stamp_ns:
                common, now, then = np.intersect1d(landmarks, ids, return_indices=True)
                now, then = now[common >= 0], then[common >= 0]
                previous_px[now] = observation.pixels[then]
        return FeatureMatches(self._agreeing, previous_px)

    def sensor_notes(self) -> Sequence[str]:
        """Return the estimated readout time of the camera's shutter, if it has any."""
        sentence = "" if self._last is None else self._map.readout.describe(self._last.observation.size_px)
        return [sentence] if sentence else []

    def calibration_warnings(self) -> Sequence[str]:
        """Return whether the images contradict the focal length that they are said to have."""
        return self._mapping.calibration_warnings()

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the factors between the keyframes, at their final poses."""
        return self._mapping.factors()

    def _predict(self, stamp_ns: int) -> tuple[Transform | None, Transform | None]:
        """Return the next T_camera_world by constant velocity, and by the gyroscope if that is better."""
        last = self._last
        if last is None or self._tracking.is_lost:
            return None, None
        by_velocity = predict_by_velocity(stamp_ns, last, self._before_last)
        R_last_body = self._prior.turn(last.stamp_ns, stamp_ns)
        if R_last_body is None:
            return by_velocity, by_velocity
        return by_velocity, predict_by_turn(last, by_velocity, R_last_body)

    def _learn_turn(self, last: TrackedPose, pose: TrackedPose, by_velocity: Transform | None) -> None:
        T_last_body = inverse(last.body_pose) @ pose.body_pose
        constant = np.eye(4)
        if by_velocity is not None:
            constant = inverse(pose.observation.T_body_camera @ by_velocity @ last.body_pose)
        self._prior.learn(last.stamp_ns, pose.stamp_ns, T_last_body[:3, :3], constant[:3, :3])

    def _begin_sub_map_or_lose(self, observation: ImageObservation) -> FrameResult:
        """Return a lost frame, or begin a new sub-map with it once enough frames matched no landmarks."""
        last = self._last
        if not self._tracking.lose(observation, is_first=last is None):
            T_world_body = np.eye(4) if last is None else last.body_pose
            return lost_frame(
                observation.stamp_ns, T_world_body, features=len(observation), residual_unit="px"
            )
        start = self._tracking.begin_sub_map(observation, last)
        self._shutter.restart()
        self._before_last, self._agreeing = None, np.zeros(len(observation), np.bool_)
        return self._add_keyframe(start, neighbour=None)

    def _add_keyframe(
        self, pose: TrackedPose, *, neighbour: int | None, assessed: Assessment = UNDOUBTED
    ) -> FrameResult:
        """Make a frame a keyframe of a neighbour's sub-map, or of a new one, and return its result."""
        self._last = self._mapping.add_keyframe(
            pose, neighbour=neighbour, twist_camera=self._shutter.twist_camera, assessed=assessed
        )
        self._decision.restart()
        result = replace(self._result(self._last), is_keyframe=True)
        if neighbour is None:
            return result
        link = self._mapping.factor(neighbour, self._last.reference)
        return replace(
            result, links=[link], doubts=assessed.doubts, covariance=covariance_of(link.information)
        )

    def _frame(self, pose: TrackedPose, information: Array, assessed: Assessment) -> FrameResult:
        """Return the result of a frame that is no keyframe, with its covariance."""
        result = self._result(pose)
        information = with_model_error(_OWN_SHARE * information, result.T_node_body)
        if assessed.doubts:
            information = inflated(information, sigma_rad=assessed.sigma_rad, sigma_m=assessed.sigma_m)
        return replace(result, doubts=assessed.doubts, covariance=covariance_of(information))

    def _result(self, pose: TrackedPose) -> FrameResult:
        """Return a frame's result, with the inliers by which it was tracked: a keyframe has more."""
        T_world_body = pose.body_pose
        diagnostics = Diagnostics(
            features=len(pose.observation),
            matches=pose.matches,
            inliers=int(self._agreeing.sum()),
            residual=pose.residual_px,
            residual_unit="px",
            method=pose.method,
        )
        if pose.depth is not None:
            diagnostics = pose.depth.diagnostics(diagnostics)
        return FrameResult(
            stamp_ns=pose.stamp_ns,
            node=pose.reference,
            T_node_body=inverse(self._map.keyframes[pose.reference].body_pose) @ T_world_body,
            T_world_body=T_world_body,
            is_keyframe=False,
            diagnostics=diagnostics,
            twist=self._shutter.twist_body(pose.observation),
        )


def covariance_of(information: Array) -> Array:
    """Return the inverse of a (6, 6) information."""
    return np.asarray(np.linalg.inv(information), np.float64)
