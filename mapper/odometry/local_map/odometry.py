"""Frame by frame against a local map of keyframes (after Mur-Artal & Tardós 2017; Zhao et al. 2020)."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.deskew import Twist
from mapper.core.frames import Frame
from mapper.core.geometry import Transform, inverse
from mapper.features.factory import build_detector
from mapper.features.view import View
from mapper.graph.model import BetweenFactor
from mapper.graph.noise import with_model_error
from mapper.odometry.base import Diagnostics, FrameResult, Matches
from mapper.odometry.config import KeyframeConfig
from mapper.odometry.local_map.landmarks import MIN_SHARED_LANDMARKS, LandmarkMap
from mapper.odometry.local_map.observation import Observation, observe
from mapper.odometry.local_map.pose_tracker import PoseTracker, TrackedPose, unmatched
from mapper.odometry.local_map.relocalizer import Relocalizer
from mapper.places.vocabulary import load_vocabulary
from mapper.sources.base import FrameRef

_MIN_START_FEATURES = 100
"""Near features that a sub-map's first frame must have: a few times ``min_inliers``."""
_MIN_KEYFRAME_LANDMARKS = 200
"""Keyframes with fewer landmarks take deeper ones in, the nearest first: more than ``weak_inliers``, so that
the next frame does not begin weak."""
_FACTORS_PER_KEYFRAME = 4
"""Factors of each keyframe, to the earlier ones that share most landmarks with it."""
_MIN_KEYFRAME_GAP = 4
"""Frames for which a keyframe is young."""
_HASTY_KEYFRAME_RATIO = 0.5
"""``keyframe_ratio`` while the last keyframe is young and the inliers are not weak: for fast motion."""

MakePoseTracker = Callable[[LandmarkMap, Relocalizer], PoseTracker]


class KeyframeOdometry:
    """Tracks against keyframes' landmarks and refines both by local bundle adjustment.

    Keyframes are the graph's nodes, numbered from 0. Their poses keep improving while they are in the window,
    so all factors are handed out by ``finish``.
    """

    def __init__(self, config: KeyframeConfig, make_tracker: MakePoseTracker) -> None:
        self._config = config
        self._detector = build_detector(config.detector)
        self._map = LandmarkMap(scale_factor=self._detector.scale_factor)
        self._vocabulary = load_vocabulary(config.vocabulary)
        self._relocalizer = Relocalizer(config, self._map, self._vocabulary)
        self._tracker = make_tracker(self._map, self._relocalizer)
        self._last: TrackedPose | None = None
        self._before_last: TrackedPose | None = None
        self._most_inliers = 0  # since the last keyframe
        self._frames_since_keyframe = 0
        self._lost_frames = 0  # since the last one that was placed
        self._stray_frames = 0  # those of them that show enough to begin with

    def read(self, entry: FrameRef) -> Observation:
        """Observe a frame of a log, without its colours. Pure.

        Raises:
            FrameError: It cannot be read, or not be used.
        """
        return self.observe(entry.load(colour=False))

    def observe(self, frame: Frame) -> Observation:
        """Detect features and look up their depth. Pure; safe in any thread.

        Raises:
            FrameError: The frame is a bare scan.
        """
        return observe(frame, self._detector, self._vocabulary, self._config)

    def track(self, observation: Observation) -> FrameResult:
        """Place the next frame, in time order."""
        tracked_pose = None if self._last is None else self._place(observation, self._last)
        if tracked_pose is None:
            return self._not_found(observation)
        # What came before a gap says nothing about the motion after it.
        before_last = None if self._lost_frames else self._last
        self._lost_frames = self._stray_frames = 0
        self._frames_since_keyframe += 1
        self._most_inliers = max(self._most_inliers, tracked_pose.inliers)
        is_keyframe, seen_from = self._wants_keyframe(tracked_pose), tracked_pose.reference
        if is_keyframe:
            tracked_pose = self._keep(tracked_pose, beside=seen_from)
        self._before_last, self._last = before_last, tracked_pose
        links = [self._factor(seen_from, tracked_pose.reference)] if is_keyframe else []
        return self._track(tracked_pose, is_keyframe=is_keyframe, links=links)

    def view(self, observation: Observation, _twist: Twist | None = None, /) -> View:
        """Return what a place is recognised by. Pure."""
        return observation.view()

    def matches(self) -> Matches | None:
        """Return which features show landmarks, and where the last frame, or else a keyframe, had them."""
        here = self._last
        if here is None or self._lost_frames:
            return None
        landmarks = here.landmark_of_feature
        before_px = np.full((len(landmarks), 2), np.nan)
        for seen in (self._map.keyframes[here.reference], self._before_last):
            if seen is not None and seen.observation is not here.observation:
                common, now, then = np.intersect1d(landmarks, seen.landmark_of_feature, return_indices=True)
                now, then = now[common >= 0], then[common >= 0]
                before_px[now] = seen.observation.pixels[then]
        return Matches(landmarks >= 0, before_px)

    def finish(self) -> Sequence[BetweenFactor]:
        """Return a factor from every keyframe to those earlier ones that share most landmarks with it.

        A sub-map's first keyframe has none: nothing says where it lies.
        """
        factors = []
        for j, keyframe in enumerate(self._map.keyframes):
            if j == keyframe.origin:
                continue
            earlier = [(k, shared) for k, shared in self._map.covisible(j, min_shared=1) if k < j]
            strong = [k for k, shared in earlier if shared >= MIN_SHARED_LANDMARKS]
            weak = [k for k, _ in earlier[:1]] or [self._map.before(j)]
            factors += [self._factor(i, j) for i in strong[:_FACTORS_PER_KEYFRAME] or weak]
        return factors

    def _factor(self, i: int, j: int) -> BetweenFactor:
        """Return how two keyframes lie to each other by the map as it is."""
        T_world_i, T_world_j = (
            _body_pose(keyframe.observation, keyframe.T_camera_world)
            for keyframe in (self._map.keyframes[i], self._map.keyframes[j])
        )
        T_i_j = inverse(T_world_i) @ T_world_j
        return BetweenFactor(i, j, T_i_j, with_model_error(self._map.information(i, j), T_i_j))

    def _not_found(self, observation: Observation) -> FrameResult:
        """Give the frame up, or begin a new sub-map with it once enough frames showed nothing known."""
        if self._near(observation) >= _MIN_START_FEATURES:
            self._stray_frames += 1
            if self._last is None or 0 < self._config.max_lost_frames < self._stray_frames:
                return self._begin(observation)
        return self._lost(observation)

    def _begin(self, observation: Observation) -> FrameResult:
        """Make the frame a sub-map's first keyframe: the world's origin, or where the camera was last."""
        last = self._last
        T_camera_world = inverse(observation.T_body_camera) if last is None else last.T_camera_world
        start = TrackedPose(observation, T_camera_world, unmatched(observation), 0, 0, 0.0, "start")
        self._lost_frames = self._stray_frames = 0
        self._before_last, self._last = None, self._keep(start, beside=None)
        return self._track(self._last, is_keyframe=True)

    def _place(self, observation: Observation, last: TrackedPose) -> TrackedPose | None:
        """Follow the motion; once that fails, look through the keyframes that look alike."""
        if self._lost_frames == 0:
            tracked_pose = self._tracker.place(observation, last, self._before_last)
            if tracked_pose is not None:
                return tracked_pose
        here_world = inverse(last.T_camera_world)[:3, 3]
        candidates = self._relocalizer.candidates(observation, here_world)
        return self._relocalizer.among(candidates, observation, method="relocalised")

    def _wants_keyframe(self, tracked_pose: TrackedPose) -> bool:
        config = self._config
        if self._frames_since_keyframe >= config.max_keyframe_gap:
            return True
        kept_ratio = tracked_pose.inliers / self._most_inliers
        weak = tracked_pose.inliers < config.weak_inliers
        if self._frames_since_keyframe < _MIN_KEYFRAME_GAP and not weak:
            return kept_ratio < _HASTY_KEYFRAME_RATIO
        # Landmarks left behind at one edge of a view hold its pose badly, however many they are.
        mapped = tracked_pose.inliers / max(self._near(tracked_pose.observation), 1)
        return kept_ratio < config.keyframe_ratio or mapped < config.mapped_ratio

    def _near(self, observation: Observation) -> int:
        """Return how many features are near enough to become landmarks."""
        return int((observation.points_camera[:, 2] <= self._config.max_depth_m).sum())

    def _keep(self, tracked_pose: TrackedPose, *, beside: int | None) -> TrackedPose:
        """Turn a placed frame into a keyframe, refine the map around it, and return it as refined.

        ``beside`` is a keyframe of the sub-map it was placed in; None begins a new one.
        """
        config, observation = self._config, tracked_pose.observation
        index = self._map.add_keyframe(
            observation,
            tracked_pose.T_camera_world,
            tracked_pose.landmark_of_feature,
            new=self._worth_mapping(tracked_pose),
            beside=beside,
        )
        self._relocalizer.add(index)
        self._map.refine(index, window=config.bundle_keyframes)
        self._map.cull()
        self._most_inliers, self._frames_since_keyframe = 0, 0
        keyframe = self._map.keyframes[index]
        return replace(
            tracked_pose,
            T_camera_world=keyframe.T_camera_world,
            landmark_of_feature=keyframe.landmark_of_feature,
            reference=index,
        )

    def _worth_mapping(self, tracked_pose: TrackedPose) -> NDArray[np.bool_]:
        """Return (N,) which features become landmarks: the near ones, and deeper ones while those are few."""
        depth_m = tracked_pose.observation.points_camera[:, 2]
        unmapped = tracked_pose.observation.has_depth & (tracked_pose.landmark_of_feature < 0)
        worth = unmapped & (depth_m <= self._config.max_depth_m)
        missing = _MIN_KEYFRAME_LANDMARKS - tracked_pose.inliers - int(worth.sum())
        if missing > 0:
            deep = np.flatnonzero(unmapped & ~worth)
            worth[deep[np.argsort(depth_m[deep], kind="stable")[:missing]]] = True
        return worth

    def _track(
        self, tracked_pose: TrackedPose, *, is_keyframe: bool, links: Sequence[BetweenFactor] = ()
    ) -> FrameResult:
        T_world_body = _body_pose(tracked_pose.observation, tracked_pose.T_camera_world)
        node = self._map.keyframes[tracked_pose.reference]
        T_world_node = _body_pose(node.observation, node.T_camera_world)
        diagnostics = Diagnostics(
            features=len(tracked_pose.observation),
            matches=tracked_pose.matches,
            inliers=tracked_pose.inliers,
            residual=tracked_pose.residual_px,
            residual_unit="px",
            method=tracked_pose.method,
        )
        return FrameResult(
            stamp_ns=tracked_pose.observation.stamp_ns,
            node=tracked_pose.reference,
            T_node_body=inverse(T_world_node) @ T_world_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=diagnostics,
            links=links,
        )

    def _lost(self, observation: Observation) -> FrameResult:
        self._lost_frames += 1
        last = self._last
        return FrameResult(
            stamp_ns=observation.stamp_ns,
            node=None,
            T_node_body=np.eye(4),
            T_world_body=np.eye(4) if last is None else _body_pose(last.observation, last.T_camera_world),
            is_keyframe=False,
            diagnostics=Diagnostics(len(observation), 0, 0, 0.0, "px", "lost"),
        )


def _body_pose(observation: Observation, T_camera_world: Transform) -> Transform:
    """Return T_world_body."""
    return inverse(observation.T_body_camera @ T_camera_world)
