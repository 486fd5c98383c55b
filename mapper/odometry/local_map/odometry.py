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
from mapper.odometry.local_map.depth.earlier_depth import EarlierDepth
from mapper.odometry.local_map.depth_tracker import DepthTracker
from mapper.odometry.local_map.frame_doubts import FrameDoubts
from mapper.odometry.local_map.keyframe_decision import KeyframeDecision
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.local_mapping import LocalMapping
from mapper.odometry.local_map.observation.image_observation import ImageObservation, observe_image
from mapper.odometry.local_map.observation.readout_time import ReadoutTime
from mapper.odometry.local_map.photometric_error import excess_error
from mapper.odometry.local_map.pose.assessment import UNDOUBTED, Assessment
from mapper.odometry.local_map.pose.pose_information import covariance_of, frame_information, with_systematic
from mapper.odometry.local_map.pose.pose_tracker import PoseTracker, TrackedPose, unmatched
from mapper.odometry.local_map.pose.previous_pixels import previous_pixels
from mapper.odometry.local_map.pose.triangulation import inlier_landmarks
from mapper.odometry.local_map.pose.velocity_filter import VelocityFilter
from mapper.odometry.local_map.recovery.gap_check import GapCheck
from mapper.odometry.local_map.recovery.relocalizer import Relocalizer
from mapper.odometry.local_map.recovery.tracking_recovery import TrackingRecovery
from mapper.places.vocabulary import load_vocabulary

_MIN_START_FEATURES = 100
"""Features with depth that a sub-map's first frame must have: a few times ``min_inliers``."""
_MIN_FIRST_FEATURES = 70
"""Those that the log's first sub-map needs: later ones may begin on a hand before the lens."""
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
        readout = ReadoutTime(config.readout_s, windows_sharing=config.bundle_keyframes)
        self._shutter = RollingShutter(readout)
        self._map = LandmarkMap(scale_factor=self._detector.scale_factor, readout=readout)
        self._vocabulary = load_vocabulary(config.vocabulary)
        self._relocalizer = Relocalizer(config, self._map, self._vocabulary)
        self._tracker = make_tracker(self._map, self._relocalizer)
        self._last: TrackedPose | None = None
        self._before_last: TrackedPose | None = None
        self._velocity = VelocityFilter()
        self._depth = DepthTracker(config, self._map)
        self._earlier_depth = EarlierDepth(self._map, config.depth_noise)
        self._gap_check = GapCheck(config, self._map, motion_check)
        self._recovery = TrackingRecovery(config, self._map, self._relocalizer, self._earlier_depth)
        self._decision = KeyframeDecision(config, self._map)
        self._doubts = FrameDoubts()
        self._calibration = CalibrationChecks(self._map)
        self._mapping = LocalMapping(config, self._map, self._relocalizer, self._calibration)
        self._agreeing = np.zeros(0, np.bool_)  # features by which the last frame was tracked
        self._lost_frames = 0  # since the last tracked one
        self._unknown_frames = 0  # those of them with enough features to begin a sub-map

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
        follows = last is not None and not (self._lost_frames or is_gap(last.stamp_ns, observation.stamp_ns))
        if not follows:
            self._shutter.restart()  # the motion before a gap is not that in this image
        observation = self._shutter.predicted(observation)
        expected = None if last is None else self._velocity.predicted(observation.stamp_ns, last)
        tracked_pose = None if last is None else self._find_pose(observation, last, expected)
        if last is None or tracked_pose is None:
            return self._not_found(observation)
        if follows:
            tracked_pose = self._shutter.refined(
                tracked_pose, last, *inlier_landmarks(self._map, tracked_pose)
            )
            self._calibration.pass_frame(self._before_last, last, tracked_pose)
        if is_gap(last.stamp_ns, observation.stamp_ns):
            tracked_pose = self._relocalizer.compared_with_other_places(tracked_pose)
        observation = tracked_pose.observation
        T_camera_world, is_moving = tracked_pose.T_camera_world, tracked_pose.moving_cells()
        displaced = self._earlier_depth.displacement(
            observation, T_camera_world, tracked_pose.reference, self._shutter.known_twist, is_moving
        )
        recognised = self._recovery.relocalised(tracked_pose, displaced, self._shutter.known_twist)
        if recognised is not None:
            (tracked_pose, displaced), expected = recognised, None
            self._velocity.restart()
        elif not follows and self._recovery.is_contradicted(tracked_pose, displaced):
            return self._not_found(observation)
        information = frame_information(self._map, tracked_pose)
        covariance = covariance_of(information)
        assessed = self._doubts.assess(
            tracked_pose, covariance, last, expected, displaced, excess_error(tracked_pose, last, expected)
        )
        if assessed.is_implausible and tracked_pose.inliers < self._config.weak_inliers:
            return self._lost(observation)
        # The motion before a gap does not predict the motion after it.
        self._before_last = None if self._lost_frames else last
        if self._before_last is not None and recognised is None:
            self._velocity.add(tracked_pose, covariance, last, is_doubtful=bool(assessed.doubts))
        self._lost_frames = self._unknown_frames = 0
        is_keyframe = self._decision.is_due(tracked_pose) and recognised is None
        if assessed.repeats or (assessed.doubts and tracked_pose.inliers >= self._config.weak_inliers):
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
        if last is None or self._lost_frames:
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

    def _not_found(self, observation: ImageObservation) -> FrameResult:
        """Return a lost frame, or begin a new sub-map with it once enough frames matched no landmarks."""
        last, most = self._last, self._config.max_lost_frames
        enough = _MIN_FIRST_FEATURES if last is None else _MIN_START_FEATURES
        if observation.has_depth.sum() >= enough:
            self._unknown_frames += 1
            begins = last is None or 0 < most < self._unknown_frames
        else:
            is_open = last is None or (most > 0 and self._is_out_of_reach(last, observation))
            begins = is_open and self._depth.can_start(observation)
        return self._begin_sub_map(observation) if begins else self._lost(observation)

    def _is_out_of_reach(self, last: TrackedPose, observation: ImageObservation) -> bool:
        """Return whether a sub-map without texture ended too long ago: nothing in it is recognised."""
        origin = self._map.observation(self._map.keyframes[last.reference].origin)
        is_bare = all(there.has_depth.sum() < _MIN_START_FEATURES for there in (last.observation, origin))
        return is_bare and is_gap(last.stamp_ns, observation.stamp_ns)

    def _begin_sub_map(self, observation: ImageObservation) -> FrameResult:
        """Make the frame a sub-map's first keyframe, at the world's origin or the last tracked pose."""
        last = self._last
        T_camera_world = inverse(observation.T_body_camera) if last is None else last.T_camera_world
        start = TrackedPose(observation, T_camera_world, unmatched(observation), 0, 0, 1.0, 0, 0.0, "start")
        self._lost_frames = self._unknown_frames = 0
        self._shutter.restart()
        self._agreeing = np.zeros(len(observation), np.bool_)
        self._velocity.restart()
        self._before_last = None
        self._depth.began(observation)
        return self._keyframe(start, neighbour=None)

    def _find_pose(
        self, observation: ImageObservation, last: TrackedPose, expected: Transform | None
    ) -> TrackedPose | None:
        """Track from the last frame; if that fails, or it was lost, relocalise among similar keyframes."""
        if self._lost_frames == 0:
            tracked_pose = self._tracker.track(observation, last, expected)
            # Without a prediction depth may lead into a wrong minimum, so keyframes are recognised first.
            if tracked_pose is not None or expected is not None:
                tracked_pose = self._depth.supported(observation, last, expected, tracked_pose)
            if tracked_pose is not None and (
                not self._gap_check.is_needed(tracked_pose, last) or self._is_possible(tracked_pose)
            ):
                return tracked_pose
        candidates = self._relocalizer.candidates(observation, inverse(last.T_camera_world)[:3, 3])
        relocalised = self._relocalizer.best_among(
            candidates, observation, method="relocalised", is_possible=self._is_possible, exhaustive=True
        )
        if relocalised is None and is_gap(last.stamp_ns, observation.stamp_ns):
            return None  # depth alone needs a guess, and by now the camera may be in another room
        found = self._depth.supported(observation, relocalised or last, None, relocalised)
        return found if found is not None and self._is_possible(found) else None

    def _is_possible(self, tracked_pose: TrackedPose) -> bool:
        """Return whether a pose after a gap is possible by the motion to it and by what should be in view."""
        last = self._last
        if last is None:
            return True
        if self._gap_check.is_out_of_reach(tracked_pose, last, self._doubts.usual_speed_m_s):
            # Another place, so that a sub-map may begin at once.
            self._unknown_frames = self._config.max_lost_frames
            return False
        return not self._gap_check.is_contradicted(tracked_pose, last)

    def _lost(self, observation: ImageObservation) -> FrameResult:
        self._lost_frames += 1
        self._velocity.restart()
        T_world_body = np.eye(4) if self._last is None else self._last.body_pose
        return lost_frame(observation.stamp_ns, T_world_body, features=len(observation), residual_unit="px")
