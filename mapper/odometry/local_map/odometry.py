"""Odometry against a local map of keyframes and landmarks (Mur-Artal & Tardós 2017; Zhao et al. 2020)."""

import math
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
from mapper.odometry.local_map.bundle.log_residuals import LogResiduals
from mapper.odometry.local_map.calibration.calibration_checks import CalibrationChecks
from mapper.odometry.local_map.calibration.rolling_shutter import RollingShutter
from mapper.odometry.local_map.depth.earlier_depth import EarlierDepth
from mapper.odometry.local_map.depth_tracker import DepthTracker
from mapper.odometry.local_map.frame_doubts import FrameDoubts
from mapper.odometry.local_map.keyframe_decision import KeyframeDecision
from mapper.odometry.local_map.landmarks.landmark_map import MIN_SHARED_LANDMARKS, LandmarkMap
from mapper.odometry.local_map.observation.image_observation import ImageObservation, observe_image
from mapper.odometry.local_map.observation.readout_time import ReadoutTime
from mapper.odometry.local_map.photometric_error import excess_error
from mapper.odometry.local_map.pose.assessment import UNDOUBTED, Assessment
from mapper.odometry.local_map.pose.pose_information import (
    covariance_of,
    disparity_ratio,
    frame_information,
    keyframe_residuals,
    relative_information,
    with_systematic,
)
from mapper.odometry.local_map.pose.pose_tracker import PoseTracker, TrackedPose, unmatched
from mapper.odometry.local_map.pose.triangulation import add_triangulated, inlier_landmarks
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
_FACTORS_PER_KEYFRAME = 4
"""Factors of each keyframe, to the earlier ones that share most landmarks with it."""

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
        self._readout = readout
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
        self._residuals = LogResiduals(disparity_sigma=config.disparity_sigma_px)
        self._calibration = CalibrationChecks(self._map)
        self._agreeing = np.zeros(0, np.bool_)  # features by which the last frame was tracked
        self._still_keyframes = config.bundle_keyframes  # the newest ones, in which few features move
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
        reference, inliers = tracked_pose.reference, tracked_pose.inliers
        self._agreeing = tracked_pose.landmark_of_feature >= 0
        links = []
        if is_keyframe:
            tracked_pose = self._add_keyframe(tracked_pose, neighbour=reference, assessed=assessed)
            links = [self._factor(reference, tracked_pose.reference)]
        self._last = tracked_pose
        result = self._result(tracked_pose, inliers=inliers, is_keyframe=is_keyframe, links=links)
        if is_keyframe:
            information = links[0].information
        else:
            information = self._residuals.rescaled(_OWN_SHARE * information, result.T_node_body)
            information = with_systematic(information, tracked_pose)
            if assessed.doubts:
                information = inflated(information, sigma_rad=assessed.sigma_rad, sigma_m=assessed.sigma_m)
        if assessed.repeats:
            result = replace(result, diagnostics=replace(result.diagnostics, method=REPEATED))
        shutter = self._shutter.pose_covariance(tracked_pose.observation.T_body_camera)
        return replace(result, doubts=assessed.doubts, covariance=covariance_of(information) + shutter)

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
        landmarks = last.landmark_of_feature
        previous_px = np.full((len(landmarks), 2), np.nan)
        before = self._before_last
        earlier = [(self._map.landmark_of_feature(last.reference), self._map.observation(last.reference))]
        if before is not None:
            ids = before.landmark_of_feature
            if self._map.keyframes[before.reference].stamp_ns == before.stamp_ns:
                ids = self._map.landmark_of_feature(before.reference)  # refining may have dropped some
            earlier.append((ids, before.observation))
        for ids, observation in earlier:
            if observation.stamp_ns != last.observation.stamp_ns:
                common, now, then = np.intersect1d(landmarks, ids, return_indices=True)
                now, then = now[common >= 0], then[common >= 0]
                previous_px[now] = observation.pixels[then]
        return FeatureMatches(self._agreeing, previous_px)

    def sensor_notes(self) -> Sequence[str]:
        """Return the estimated readout time of the camera's shutter, if it has any."""
        return [self._readout.sentence] if self._readout.sentence else []

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
        """Return a factor from every keyframe to those earlier ones that share most landmarks with it.

        The first keyframe of a sub-map has none, as its pose in other sub-maps is unknown.
        """
        factors = []
        for j, keyframe in enumerate(self._map.keyframes):
            self._map.step()
            keyframe.doubt_m = max(keyframe.doubt_m, self._doubts.in_hindsight(keyframe.stamp_ns).sigma_m)
            if j == keyframe.origin:
                continue
            earlier = [(k, shared) for k, shared in self._map.covisible(j, min_shared=1) if k < j]
            strong = [k for k, shared in earlier if shared >= MIN_SHARED_LANDMARKS]
            weak = [k for k, _ in earlier[:1]] or [self._map.previous(j)]
            linked = [keyframe.depth_link.reference] if keyframe.depth_link is not None else []
            targets = dict.fromkeys([*(strong[:_FACTORS_PER_KEYFRAME] or linked or weak), *linked])
            factors += [self._factor(i, j, shared_by=len(targets)) for i in targets]
        return factors

    def _factor(self, i: int, j: int, *, shared_by: int = 1) -> BetweenFactor:
        """Return the relative pose of two keyframes in the current map.

        ``shared_by`` factors of j rest largely on the same features. Were these the same, each factor would
        have that share of their information, were they others, all: it has the geometric mean.
        """
        keyframes = self._map.keyframes
        T_i_j = inverse(keyframes[i].body_pose) @ keyframes[j].body_pose
        information = relative_information(self._map, i, j)
        information = self._residuals.rescaled(information, T_i_j) / math.sqrt(shared_by)
        if (doubt_m := keyframes[j].doubt_m) > 0.0:
            information = inflated(information, sigma_rad=keyframes[j].doubt_rad, sigma_m=doubt_m)
        return BetweenFactor(i, j, T_i_j, information)

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
        self._before_last, self._last = None, self._add_keyframe(start, neighbour=None)
        self._depth.began(observation)
        return self._result(self._last, inliers=0, is_keyframe=True)

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

    def _add_keyframe(
        self, tracked_pose: TrackedPose, *, neighbour: int | None, assessed: Assessment = UNDOUBTED
    ) -> TrackedPose:
        """Turn a tracked frame into a keyframe, refine the map around it, and return its refined pose.

        ``neighbour`` is a keyframe of the sub-map in which it was tracked; None begins a new one.
        """
        config, observation = self._config, tracked_pose.observation
        # A measured noise is taken as it is; where much moves, more weight would prefer passers-by's motion.
        if config.depth_noise is None and tracked_pose.few_move:
            observation = observation.with_disparity_sigma(self._residuals.disparity_sigma)
        self._still_keyframes = self._still_keyframes + 1 if tracked_pose.few_move else 0
        is_still = self._still_keyframes >= config.bundle_keyframes  # all of the window
        variance_factor = self._residuals.variance_factor if is_still else 1.0
        is_new = observation.has_depth & (tracked_pose.landmark_of_feature < 0)
        is_new[tracked_pose.moving] = False
        index = self._map.add_keyframe(
            observation,
            tracked_pose.T_camera_world,
            tracked_pose.landmark_of_feature,
            new=is_new,
            neighbour=neighbour,
            twist_camera=self._shutter.twist_camera,
            depth_information=None if tracked_pose.depth is None else tracked_pose.depth.lasting_information,
        )
        if config.triangulate and tracked_pose.few_move:  # without depth nothing shows what moves
            add_triangulated(self._map, index, except_for=tracked_pose.moving)
        self._relocalizer.add(index)
        self._map.refine(index, window=config.bundle_keyframes, variance_factor=variance_factor)
        self._map.follow_readout()
        self._map.cull()
        self._calibration.pass_keyframe()
        if (statistics := keyframe_residuals(self._map, index)) is not None:
            self._residuals.add(statistics)
            self._map.residual_variance = self._residuals.variance
        if (ratio := disparity_ratio(self._map, index)) is not None:
            self._residuals.add_disparity_ratio(ratio)
        self._decision.restart()
        keyframe = self._map.keyframes[index]
        keyframe.doubt_rad, keyframe.doubt_m = assessed.sigma_rad, assessed.sigma_m
        return replace(
            tracked_pose,
            observation=self._map.observation(index),
            T_camera_world=keyframe.T_camera_world,
            landmark_of_feature=self._map.landmark_of_feature(index),
            reference=index,
        )

    def _result(
        self,
        tracked_pose: TrackedPose,
        *,
        inliers: int,
        is_keyframe: bool,
        links: Sequence[BetweenFactor] = (),
    ) -> FrameResult:
        """Return the result of a frame; a keyframe's landmarks are more than the ``inliers`` that it had."""
        T_world_body = tracked_pose.body_pose
        node = self._map.keyframes[tracked_pose.reference]
        return FrameResult(
            stamp_ns=tracked_pose.observation.stamp_ns,
            node=tracked_pose.reference,
            T_node_body=inverse(node.body_pose) @ T_world_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=tracked_pose.diagnostics(inliers),
            links=links,
            twist=self._shutter.twist_body(tracked_pose.observation),
        )

    def _lost(self, observation: ImageObservation) -> FrameResult:
        self._lost_frames += 1
        self._velocity.restart()
        T_world_body = np.eye(4) if self._last is None else self._last.body_pose
        return lost_frame(observation.stamp_ns, T_world_body, features=len(observation), residual_unit="px")
