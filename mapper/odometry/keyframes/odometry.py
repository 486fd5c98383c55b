"""Odometry against a local map of keyframes and landmarks (Mur-Artal & Tardós 2017; Zhao et al. 2020)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mapper.core.deskew import Twist
from mapper.core.frames import Frame
from mapper.core.geometry import Array, Points, adjoint, inverse
from mapper.features.factory import build_detector
from mapper.features.frame_view import ImageView
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import inflated
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
from mapper.odometry.keyframes.depth_tracker import DepthTracker
from mapper.odometry.keyframes.earlier_depth import EarlierDepth
from mapper.odometry.keyframes.focal_length import WINDOW_KEYFRAMES, FocalLengthCheck
from mapper.odometry.keyframes.frame_doubts import UNDOUBTED, Assessment, FrameDoubts
from mapper.odometry.keyframes.keyframe_decision import KeyframeDecision
from mapper.odometry.keyframes.landmarks import MIN_SHARED_LANDMARKS, LandmarkMap
from mapper.odometry.keyframes.log_residuals import LogResiduals
from mapper.odometry.keyframes.pose_tracker import PoseTracker, TrackedPose, predicted, unmatched
from mapper.odometry.keyframes.relocalizer import Relocalizer
from mapper.odometry.keyframes.rolling_shutter import RollingShutter
from mapper.places.vocabulary import load_vocabulary

_MIN_START_FEATURES = 100
"""Features with depth that a sub-map's first frame must have: a few times ``min_inliers``."""
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
            motion_check: Rules out poses after a gap; None if nothing but the images tells of the motion.
        """
        self._config = config
        self._motion_check = motion_check
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
        self._depth = DepthTracker(config, self._map)
        self._earlier_depth = EarlierDepth(self._map, config.depth_noise)
        self._decision = KeyframeDecision(config)
        self._doubts = FrameDoubts()
        self._residuals = LogResiduals()
        self._focal_length = FocalLengthCheck()
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
        last = self._last
        follows = (
            last is not None
            and not self._lost_frames
            and not is_gap(last.observation.stamp_ns, observation.stamp_ns)
        )
        if not follows:
            self._shutter.restart()  # the motion before a gap is not that in this image
        observation = self._shutter.predicted(observation)
        tracked_pose = None if last is None else self._find_pose(observation, last)
        if last is None or tracked_pose is None:
            return self._not_found(observation)
        if follows:
            tracked_pose = self._shutter.refined(tracked_pose, last, self._positions_of(tracked_pose))
        observation = tracked_pose.observation
        information = self._map.pose_information(
            observation, tracked_pose.T_camera_world, tracked_pose.landmark_of_feature
        )
        if tracked_pose.depth is not None:
            to_camera = adjoint(inverse(observation.T_body_camera))
            information += to_camera.T @ tracked_pose.depth.information @ to_camera
        expected = None if self._lost_frames else predicted(observation.stamp_ns, last, self._before_last)
        displaced = self._earlier_depth.displacement(
            observation, tracked_pose.T_camera_world, tracked_pose.reference
        )
        assessed = self._doubts.assess(tracked_pose, _covariance_of(information), last, expected, displaced)
        # The motion before a gap does not predict the motion after it.
        before_last = None if self._lost_frames else self._last
        self._lost_frames = self._unknown_frames = 0
        reference, inliers = tracked_pose.reference, tracked_pose.inliers
        is_keyframe = self._decision.is_due(tracked_pose)
        if assessed.doubts and tracked_pose.inliers >= self._config.weak_inliers:
            is_keyframe = False  # tracking goes on without it
        self._agreeing = tracked_pose.landmark_of_feature >= 0
        if is_keyframe:
            tracked_pose = self._add_keyframe(tracked_pose, neighbour=reference, assessed=assessed)
        self._before_last, self._last = before_last, tracked_pose
        links = [self._factor(reference, tracked_pose.reference)] if is_keyframe else []
        result = self._result(tracked_pose, inliers=inliers, is_keyframe=is_keyframe, links=links)
        if is_keyframe:
            information = links[0].information
        else:
            information = self._residuals.honest(_OWN_SHARE * information, result.T_node_body)
            if assessed.doubts:
                information = inflated(information, sigma_rad=assessed.sigma_rad, sigma_m=assessed.sigma_m)
        return replace(result, doubts=assessed.doubts, covariance=_covariance_of(information))

    def view(self, observation: ImageObservation, twist: Twist | None = None, /) -> ImageView:
        """Return the view for place recognition, by the readout time as it is known now."""
        return (observation if twist is None else self._shutter.corrected(observation, twist)).view()

    def matches(self) -> FeatureMatches | None:
        """Return the features matched to landmarks, and these landmarks' pixels in an earlier frame."""
        last = self._last
        if last is None or self._lost_frames:
            return None
        landmarks = last.landmark_of_feature
        previous_px = np.full((len(landmarks), 2), np.nan)
        keyframe, before = self._map.keyframes[last.reference], self._before_last
        earlier = [(keyframe.landmark_of_feature, self._map.observation(last.reference))]
        if before is not None:
            earlier.append((before.landmark_of_feature, before.observation))
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
        """Return whether the images contradict the focal length that they are said to have."""
        if not self._map.keyframes:
            return ()
        doubt = self._focal_length.contradiction(self._map.observation(0).intrinsics[0])
        return (doubt,) if doubt else ()

    def finish(self) -> Sequence[BetweenFactor]:
        """Return a factor from every keyframe to those earlier ones that share most landmarks with it.

        The first keyframe of a sub-map has none, as its pose in other sub-maps is unknown.
        """
        factors = []
        for j, keyframe in enumerate(self._map.keyframes):
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
        information = self._map.information(i, j) + self._map.depth_information(i, j)
        information = self._residuals.honest(information, T_i_j) / math.sqrt(shared_by)
        doubtful = self._map.keyframes[j]
        if doubtful.doubt_m > 0.0:
            information = inflated(information, sigma_rad=doubtful.doubt_rad, sigma_m=doubtful.doubt_m)
        return BetweenFactor(i, j, T_i_j, information)

    def _not_found(self, observation: ImageObservation) -> FrameResult:
        """Return a lost frame, or begin a new sub-map with it once enough frames matched no landmarks."""
        is_first = self._last is None
        if observation.has_depth.sum() >= _MIN_START_FEATURES or (
            is_first and self._depth.can_start(observation)
        ):
            self._unknown_frames += 1
            if is_first or 0 < self._config.max_lost_frames < self._unknown_frames:
                return self._begin_sub_map(observation)
        return self._lost(observation)

    def _begin_sub_map(self, observation: ImageObservation) -> FrameResult:
        """Make the frame a sub-map's first keyframe, at the world's origin or the last tracked pose."""
        last = self._last
        T_camera_world = inverse(observation.T_body_camera) if last is None else last.T_camera_world
        start = TrackedPose(observation, T_camera_world, unmatched(observation), 0, 0, 1.0, 0, 0.0, "start")
        self._lost_frames = self._unknown_frames = 0
        self._shutter.restart()
        self._agreeing = np.zeros(len(observation), np.bool_)
        self._before_last, self._last = None, self._add_keyframe(start, neighbour=None)
        self._depth.began(observation)
        return self._result(self._last, inliers=0, is_keyframe=True)

    def _find_pose(self, observation: ImageObservation, last: TrackedPose) -> TrackedPose | None:
        """Track from the last frame; if that fails, or it was lost, relocalise among similar keyframes."""
        if self._lost_frames == 0:
            tracked_pose = self._tracker.track(observation, last, self._before_last)
            tracked_pose = self._depth.supported(observation, last, self._before_last, tracked_pose)
            if tracked_pose is not None and (
                self._is_steady(tracked_pose, last) or self._is_possible(tracked_pose)
            ):
                return tracked_pose
        candidates = self._relocalizer.candidates(observation, inverse(last.T_camera_world)[:3, 3])
        relocalised = self._relocalizer.best_among(
            candidates, observation, method="relocalised", is_possible=self._is_possible, exhaustive=True
        )
        if relocalised is None and is_gap(last.observation.stamp_ns, observation.stamp_ns):
            return None  # depth alone needs a guess, and by now the camera may be in another room
        found = self._depth.supported(observation, relocalised or last, None, relocalised)
        return found if found is not None and self._is_possible(found) else None

    def _is_steady(self, tracked_pose: TrackedPose, last: TrackedPose) -> bool:
        """Return whether a pose is soon after the last one, and in its sub-map."""
        keyframes = self._map.keyframes
        one_map = keyframes[tracked_pose.reference].origin == keyframes[last.reference].origin
        return one_map and not is_gap(last.observation.stamp_ns, tracked_pose.observation.stamp_ns)

    def _is_possible(self, tracked_pose: TrackedPose) -> bool:
        """Return whether a pose after a gap is possible by the motion since, where something else tells it.

        Looks alone cannot tell two rooms apart that are furnished alike. The motion is that since the last
        tracked frame, and that since the keyframe that was recognised, if it is of another sub-map.
        """
        check, last = self._motion_check, self._last
        if check is None or last is None:
            return True
        keyframes = self._map.keyframes
        known = keyframes[tracked_pose.reference]
        since = last if known.origin == keyframes[last.reference].origin else known
        T_begin_end = inverse(since.body_pose) @ tracked_pose.body_pose
        if not check.contradiction(T_begin_end, since.stamp_ns, tracked_pose.stamp_ns):
            return True
        self._unknown_frames = self._config.max_lost_frames  # another place, so a sub-map may begin at once
        return False

    def _positions_of(self, tracked_pose: TrackedPose) -> Points:
        """Return the (M, 3) landmarks of a pose's inliers, in the order of their features."""
        ids = tracked_pose.landmark_of_feature
        positions_world: Points = self._map.landmarks["position"][ids[ids >= 0]]
        return positions_world

    def _add_keyframe(
        self, tracked_pose: TrackedPose, *, neighbour: int | None, assessed: Assessment = UNDOUBTED
    ) -> TrackedPose:
        """Turn a tracked frame into a keyframe, refine the map around it, and return its refined pose.

        ``neighbour`` is a keyframe of the sub-map in which it was tracked; None begins a new one.
        """
        config, observation = self._config, tracked_pose.observation
        is_new = observation.has_depth & (tracked_pose.landmark_of_feature < 0)
        is_new[tracked_pose.moving] = False
        index = self._map.add_keyframe(
            observation,
            tracked_pose.T_camera_world,
            tracked_pose.landmark_of_feature,
            new=is_new,
            neighbour=neighbour,
            twist_camera=self._shutter.twist_camera,
            depth_information=None if tracked_pose.depth is None else tracked_pose.depth.information,
        )
        self._relocalizer.add(index)
        self._map.refine(index, window=config.bundle_keyframes)
        self._map.follow_readout()
        self._map.cull()
        self._check_focal_length()
        if (statistics := self._map.residual_statistics(index)) is not None:
            self._residuals.add(statistics)
        self._decision.restart()
        keyframe = self._map.keyframes[index]
        keyframe.doubt_rad, keyframe.doubt_m = assessed.sigma_rad, assessed.sigma_m
        return replace(
            tracked_pose,
            observation=self._map.observation(index),
            T_camera_world=keyframe.T_camera_world,
            landmark_of_feature=keyframe.landmark_of_feature,
            reference=index,
        )

    def _check_focal_length(self) -> None:
        """Check the newest keyframes of a sub-map together, once there are enough since the last check."""
        newest = range(len(self._map.keyframes) - WINDOW_KEYFRAMES, len(self._map.keyframes))
        origins = {self._map.keyframes[k].origin for k in newest if k >= 0}
        if len(self._map.keyframes) % WINDOW_KEYFRAMES or len(origins) > 1 or self._focal_length.is_complete:
            return
        self._focal_length.add(self._map.bundle(newest))

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
        diagnostics = Diagnostics(
            features=len(tracked_pose.observation),
            matches=tracked_pose.matches,
            inliers=inliers,
            residual=tracked_pose.residual_px,
            residual_unit="px",
            method=tracked_pose.method,
        )
        if tracked_pose.depth is not None:
            diagnostics = tracked_pose.depth.diagnostics(diagnostics)
        return FrameResult(
            stamp_ns=tracked_pose.observation.stamp_ns,
            node=tracked_pose.reference,
            T_node_body=inverse(node.body_pose) @ T_world_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=diagnostics,
            links=links,
            twist=self._shutter.twist_body(tracked_pose.observation),
        )

    def _lost(self, observation: ImageObservation) -> FrameResult:
        self._lost_frames += 1
        last = self._last
        T_world_body = np.eye(4) if last is None else last.body_pose
        return lost_frame(observation.stamp_ns, T_world_body, features=len(observation), residual_unit="px")


def _covariance_of(information: Array) -> Array:
    return np.asarray(np.linalg.inv(information), np.float64)
