"""Odometry against a local map of keyframes and landmarks (Mur-Artal & Tardós 2017; Zhao et al. 2020)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.frames import Frame
from mapper.core.geometry import Array, Transform, inverse
from mapper.features.factory import build_detector
from mapper.features.frame_view import ImageView
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import inflated
from mapper.odometry.base import (
    REPEATED,
    FeatureMatches,
    FrameOdometry,
    FrameResult,
    MotionCheck,
    is_gap,
    lost_frame,
)
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.calibration.calibration_checks import CalibrationChecks
from mapper.odometry.local_map.calibration.rolling_shutter import RollingShutter
from mapper.odometry.local_map.depth.earlier_depth import Displacement, EarlierDepth
from mapper.odometry.local_map.frame_doubts import FrameDoubts
from mapper.odometry.local_map.keyframe_decision import KeyframeDecision
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.local_mapping import LocalMapping
from mapper.odometry.local_map.observation.image_observation import ImageObservation, observe_image
from mapper.odometry.local_map.observation.readout_time import ReadoutTime
from mapper.odometry.local_map.photometric_error import excess_error
from mapper.odometry.local_map.pose.assessment import UNDOUBTED, Assessment
from mapper.odometry.local_map.pose.pose_information import covariance_of, frame_information, with_systematic
from mapper.odometry.local_map.pose.pose_tracker import PoseTracker, TrackedPose
from mapper.odometry.local_map.pose.previous_pixels import previous_pixels
from mapper.odometry.local_map.pose.triangulation import inlier_landmarks
from mapper.odometry.local_map.pose.velocity_filter import VelocityFilter
from mapper.odometry.local_map.pose_estimator import PoseEstimator
from mapper.odometry.local_map.recovery.lost_frames import LostFrames
from mapper.odometry.local_map.recovery.relocalizer import Relocalizer
from mapper.odometry.local_map.recovery.tracking_recovery import TrackingRecovery
from mapper.places.vocabulary import load_vocabulary

_OWN_SHARE = 0.5
"""Share of a pose's information that is left as its landmarks were measured no better than its features."""

MakePoseTracker = Callable[[LandmarkMap, Relocalizer], PoseTracker]


class KeyframeOdometry(FrameOdometry[ImageObservation]):
    """Odometry against keyframes' landmarks, both refined by local bundle adjustment.

    Keyframes are the graph's nodes, numbered from 0. Their poses keep improving while they are in the window,
    so ``finish`` returns all factors.
    """

    def __init__(
        self,
        config: KeyframeOdometryConfig,
        make_tracker: MakePoseTracker,
        motion_check: MotionCheck | None = None,
    ) -> None:
        """Start before the first frame.

        Args:
            config: Settings.
            make_tracker: Makes the pose tracker.
            motion_check: Rules out poses after a gap; None if only the images measure the motion.
        """
        self._config = config
        self._detector = build_detector(config.detector)
        self._vocabulary = load_vocabulary(config.vocabulary)
        readout = ReadoutTime(config.readout_s, windows_sharing=config.bundle_keyframes)
        self._shutter = RollingShutter(readout)
        self._map = LandmarkMap(scale_factor=self._detector.scale_factor, readout=readout)
        relocalizer = Relocalizer(config, self._map, self._vocabulary)
        tracker = make_tracker(self._map, relocalizer)
        self._lost = LostFrames(config, self._map)
        self._estimator = PoseEstimator(config, self._map, relocalizer, tracker, motion_check, self._lost)
        self._earlier_depth = EarlierDepth(self._map, config.depth_noise)
        self._recovery = TrackingRecovery(config, self._map, relocalizer, self._earlier_depth)
        self._velocity = VelocityFilter()
        self._doubts = FrameDoubts()
        self._decision = KeyframeDecision(config, self._map)
        self._calibration = CalibrationChecks(self._map)
        self._mapping = LocalMapping(config, self._map, relocalizer, self._calibration)
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
        """Track the next frame, in time order."""
        self._map.step()
        last = self._last
        follows = last is not None and not (self._lost.count or is_gap(last.stamp_ns, observation.stamp_ns))
        if not follows:
            self._shutter.restart()  # the motion before a gap is not that in this image
        observation = self._shutter.predicted(observation)
        if last is None:
            return self._not_found(observation)
        expected = self._velocity.predicted(observation.stamp_ns, last)
        tracked_pose = self._estimator.estimate(observation, last, expected, self._doubts.usual_speed_m_s)
        if tracked_pose is None:
            return self._not_found(observation)
        if follows:
            tracked_pose = self._shutter.refined(
                tracked_pose, last, *inlier_landmarks(self._map, tracked_pose)
            )
            self._calibration.pass_frame(self._before_last, last, tracked_pose)
        displaced = self._earlier_depth.displacement(
            tracked_pose.observation,
            tracked_pose.T_camera_world,
            tracked_pose.reference,
            self._shutter.known_twist,
            tracked_pose.moving_cells(),
        )
        recognised = self._recovery.relocalised(tracked_pose, displaced, self._shutter.known_twist)
        if recognised is not None:
            self._velocity.restart()
            return self._follow(*recognised, last, None, is_recognised=True)
        if not follows and self._recovery.is_contradicted(tracked_pose, displaced):
            return self._not_found(tracked_pose.observation)
        return self._follow(tracked_pose, displaced, last, expected)

    def _follow(
        self,
        tracked_pose: TrackedPose,
        displaced: Displacement,
        last: TrackedPose,
        expected: Transform | None,
        *,
        is_recognised: bool = False,
    ) -> FrameResult:
        """Assess a pose, and follow it unless it is implausible."""
        information = frame_information(self._map, tracked_pose)
        covariance = covariance_of(information)
        assessed = self._doubts.assess(
            tracked_pose, covariance, last, expected, displaced, excess_error(tracked_pose, last, expected)
        )
        is_weak = tracked_pose.inliers < self._config.weak_inliers
        if assessed.is_implausible and is_weak:
            return self._lost_frame(tracked_pose.observation)
        # The motion before a gap does not predict the motion after it.
        self._before_last = None if self._lost.count else last
        if self._before_last is not None and not is_recognised:
            self._velocity.add(tracked_pose, covariance, last, is_doubtful=bool(assessed.doubts))
        self._lost.restart()
        is_keyframe = self._decision.is_due(tracked_pose) and not is_recognised
        if assessed.repeats or (assessed.doubts and not is_weak):
            is_keyframe = False  # tracking goes on without it
        return self._tracked(tracked_pose, information, assessed, is_keyframe=is_keyframe)

    def _tracked(
        self, tracked_pose: TrackedPose, information: Array, assessed: Assessment, *, is_keyframe: bool
    ) -> FrameResult:
        """Return the result of a tracked frame with its covariance, and extend the map by a keyframe."""
        self._agreeing = tracked_pose.landmark_of_feature >= 0
        if is_keyframe:
            result = self._keyframe(tracked_pose, neighbour=tracked_pose.reference, assessed=assessed)
            information = result.links[0].information
        else:
            self._last = tracked_pose
            result = self._result(tracked_pose, is_keyframe=False)
            information = self._mapping.residuals.rescaled(_OWN_SHARE * information, result.T_node_body)
            information = with_systematic(information, tracked_pose)
            if assessed.doubts:
                information = inflated(information, sigma_rad=assessed.sigma_rad, sigma_m=assessed.sigma_m)
        if assessed.repeats:
            result = replace(result, diagnostics=replace(result.diagnostics, method=REPEATED))
        shutter = self._shutter.pose_covariance(tracked_pose.observation.T_body_camera)
        return replace(result, doubts=assessed.doubts, covariance=covariance_of(information) + shutter)

    def _keyframe(
        self, tracked_pose: TrackedPose, *, neighbour: int | None, assessed: Assessment = UNDOUBTED
    ) -> FrameResult:
        """Make a frame a keyframe of a neighbour's sub-map, or of a new one, and return its result."""
        self._last = self._mapping.add_keyframe(
            tracked_pose, neighbour=neighbour, twist_camera=self._shutter.twist_camera, assessed=assessed
        )
        self._decision.restart()
        links = [] if neighbour is None else [self._mapping.factor(neighbour, self._last.reference)]
        return self._result(self._last, is_keyframe=True, links=links)

    def _result(
        self, tracked_pose: TrackedPose, *, is_keyframe: bool, links: Sequence[BetweenFactor] = ()
    ) -> FrameResult:
        """Return the result of a frame, with the inliers by which it was tracked: a keyframe has more."""
        T_world_body = tracked_pose.body_pose
        node = self._map.keyframes[tracked_pose.reference]
        return FrameResult(
            stamp_ns=tracked_pose.stamp_ns,
            node=tracked_pose.reference,
            T_node_body=inverse(node.body_pose) @ T_world_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=tracked_pose.diagnostics(int(self._agreeing.sum())),
            links=links,
            twist=self._shutter.twist_body(tracked_pose.observation),
        )

    def _not_found(self, observation: ImageObservation) -> FrameResult:
        """Return a lost frame, or begin a new sub-map with it once enough frames matched no landmarks."""
        if not self._lost.begins_sub_map(observation, self._last):
            return self._lost_frame(observation)
        start = self._estimator.first_of_sub_map(observation, self._last)
        self._shutter.restart()
        self._velocity.restart()
        self._before_last, self._agreeing = None, np.zeros(len(observation), np.bool_)
        return self._keyframe(start, neighbour=None)

    def _lost_frame(self, observation: ImageObservation) -> FrameResult:
        self._lost.count += 1
        self._velocity.restart()
        T_world_body = np.eye(4) if self._last is None else self._last.body_pose
        return lost_frame(observation.stamp_ns, T_world_body, features=len(observation), residual_unit="px")

    def view(self, observation: ImageObservation, twist: Twist | None = None, /) -> ImageView:
        """Return the view for place recognition, by the readout time as it is known now.

        What moves by itself in the last tracked frame is left out of its view: two images of one person show
        that person's motion.
        """
        swept = observation if twist is None else self._shutter.corrected(observation, twist)
        last = self._last
        if last is None or last.stamp_ns != observation.stamp_ns or last.few_move:
            return swept.view()
        return swept.view(last.moving)

    def matches(self) -> FeatureMatches | None:
        """Return the features matched to landmarks, and these landmarks' pixels in an earlier frame."""
        last = self._last
        if last is None or self._lost.count:
            return None
        return FeatureMatches(self._agreeing, previous_pixels(self._map, last, self._before_last))

    def sensor_notes(self) -> Sequence[str]:
        """Return the estimated readout time of the camera's shutter, if it has any."""
        sentence = self._map.readout.sentence
        return [sentence] if sentence else []

    def calibration_warnings(self) -> Sequence[str]:
        """Return what in the images contradicts their focal length, and the stamps of their depth."""
        return self._calibration.contradictions()

    def in_hindsight(self, results: Sequence[FrameResult]) -> list[FrameResult]:
        """Return the frames' results with the doubts that later ones add to them."""
        return [self._with_later_doubts(result) for result in results]

    def _with_later_doubts(self, result: FrameResult) -> FrameResult:
        later = self._doubts.in_hindsight(result.stamp_ns)
        if not later.doubts or result.covariance is None:
            return result
        covariance = result.covariance + np.diag([later.sigma_rad**2] * 3 + [later.sigma_m**2] * 3)
        return replace(result, doubts=(*result.doubts, *later.doubts), covariance=covariance)

    def finish(self) -> Sequence[BetweenFactor]:
        """Return the factors between the keyframes, with the doubts that later frames add."""
        for keyframe in self._map.keyframes:
            keyframe.doubt_m = max(keyframe.doubt_m, self._doubts.in_hindsight(keyframe.stamp_ns).sigma_m)
        return self._mapping.factors()
