"""Tracking by depth where an image has little texture: the second tracker of the local map's odometry."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Transform
from mapper.core.timebase import NS_PER_S
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.local_map.depth.depth_alignment import (
    DEPTH_ONLY,
    DepthAlignment,
    ReferenceSurfaces,
    align_depth,
)
from mapper.odometry.local_map.depth.depth_kernels import Landmarks, PosePrior
from mapper.odometry.local_map.depth.earlier_depth import EarlierDepth
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.observation.depth_surfaces import DepthCells, DepthSurface, surface_of
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.pose.assessment import UNOBSERVED_MOTION
from mapper.odometry.local_map.pose.far_features import turned_by_far_features
from mapper.odometry.local_map.pose.local_search import LocalSearch
from mapper.odometry.local_map.pose.pose_information import covariance_of, frame_information, largest_sigma
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose, project, unmatched

_MIN_VISIBLE_RATIO, _MIN_VISIBLE_RATIO_OF_PLACED = 0.3, 0.15
"""Share of the points on or before surfaces that depth alone needs, and that a frame needs which landmarks
have placed: after a gap a quarter is often all that both see; it shows turns better than few landmarks do."""
_MIN_WEAKEST_RATIO = 0.5
"""A wrong pose can have most points on the floor or on one wall, so every direction of the normals counts."""
_MAX_CONTRADICTING_RATIO = 0.3
"""A real desk's many edges give 0.2 under a right pose, a hand that comes before the lens 0.8."""
_SPEED_SIGMA, _UNKNOWN_SPEED_SIGMA = 0.5, 2.0
"""Metres and radians per second by which a motion may err that is predicted, and one that nothing predicts:
one sigma for a camera in a hand."""
_SURE_S = 0.1
"""Time for which a prediction alone is accepted: it errs by 5 cm."""
_MAX_UNOBSERVED_S = 2.0
"""After so long on a prediction in any direction a frame is lost."""
_MAX_GAP_S = 0.5
"""After a longer gap without frames another corner of the same shape may be in view."""
_LEAST_ELAPSED_S = 0.01
_FEW_INLIERS_RATIO = 2.0
"""With fewer inliers, relative to the fewest, depth takes part; with more only where ``_LOOSE_M`` is
exceeded."""
_LOOSE_M = 0.02
"""Standard deviation of a translation from which on landmarks do not determine it."""
_MIN_KEPT_RATIO = 0.5
"""When fewer of a pose's landmarks agree once the depth image takes part, one of both is wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """Pose that is expected of a frame.

    Attributes:
        T_camera_world: (4, 4).
        speed_sigma: Metres and radians per second by which the motion to it may err.
        sure_s: Time for which it is accepted where nothing shows the motion.
        gap_s: Time since the motion was last known; 0 if it is.
    """

    T_camera_world: Transform
    speed_sigma: float
    sure_s: float
    gap_s: float


class DepthTracker:
    """Pose of frames of few landmarks by their depth image, against the surfaces of the last keyframes."""

    def __init__(self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap) -> None:
        self._config = config
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._earlier_depth = EarlierDepth(landmark_map, config.depth_noise)
        self._surfaces: dict[int, DepthSurface] = {}  # of the frames last used, by stamp
        self._keyframes: list[int] = []  # those among them
        self._observed_ns = 0  # when every motion was last observed
        self._is_confirmed = False  # the sub-map, by a frame of many landmarks

    def began(self, observation: ImageObservation) -> None:
        """Reset the tracker at a sub-map's first frame."""
        self._observed_ns, self._is_confirmed = observation.stamp_ns, False
        self._surfaces.clear()

    def supported(
        self,
        observation: ImageObservation,
        last: TrackedPose,
        T_predicted: Transform | None,
        found: TrackedPose | None,
    ) -> TrackedPose | None:
        """Return a frame's pose by landmarks and depth together, where landmarks do not suffice.

        Args:
            observation: The frame.
            last: The last frame that was tracked.
            T_predicted: (4, 4) predicted T_camera_world; None if nothing predicts it.
            found: The pose from landmarks alone; None if they gave none.

        Returns:
            ``found`` itself if its landmarks suffice, or if the depth image disagrees with the keyframes;
            None if there is no pose.
        """
        if found is not None and self._suffices(found):
            self._observed_ns, self._is_confirmed = observation.stamp_ns, True
            return found
        if found is None and self._unobserved_s(observation) > _MAX_UNOBSERVED_S:
            return None
        predicted = self._turned(_predicted(observation, last, T_predicted), observation, last)
        starts = [] if found is None else [found.T_camera_world]
        for T_camera_world in (*starts, predicted.T_camera_world):
            alignment = self._aligned(observation, T_camera_world, predicted, last, found)
            if alignment is not None:
                break
        else:
            if found is not None:
                self._observed_ns = observation.stamp_ns
            return found
        if found is not None:
            return self._by_both(observation, alignment, found, predicted)
        reference = self._keyframes[int(np.argmax(alignment.agreeing))]
        found = self._search.refine(
            observation,
            alignment.T_camera_world,
            unmatched(observation),
            reference=reference,
            agreement=alignment.agreeing_ratio,
            method="depth+map",
        )
        if found is None:
            return self._by_depth(observation, alignment, reference, predicted)
        joint = self._aligned(observation, found.T_camera_world, predicted, last, found)
        return found if joint is None else self._by_both(observation, joint, found, predicted)

    def _turned(
        self, predicted: _Prediction, observation: ImageObservation, last: TrackedPose
    ) -> _Prediction:
        """Return a prediction whose rotation features of unknown depth show, if there are enough."""
        elapsed_s = (observation.stamp_ns - last.stamp_ns) / NS_PER_S
        T_camera_world = turned_by_far_features(
            self._search,
            observation,
            last,
            predicted.T_camera_world,
            sigma_m=predicted.speed_sigma * elapsed_s,
        )
        return replace(predicted, T_camera_world=T_camera_world)

    def _suffices(self, found: TrackedPose) -> bool:
        """Return whether landmarks alone give a pose: many, or some that determine the translation.

        Where something moves by itself some suffice: depth images show passers-by as well, and along a
        corridor nothing else in them shows how far the camera moved.
        """
        if found.inliers < _FEW_INLIERS_RATIO * self._config.min_inliers:
            return False
        if not found.few_move:
            return True
        covariance = covariance_of(frame_information(self._map, found))
        return largest_sigma(covariance[3:, 3:]) <= _LOOSE_M

    def _aligned(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        predicted: _Prediction,
        last: TrackedPose,
        found: TrackedPose | None,
    ) -> DepthAlignment | None:
        """Return the alignment to the latest keyframes; None if it fails or disagrees with them."""
        reference = self._reference(observation, last)
        if observation.depth_cells is None or not reference.surfaces:
            return None
        unsure_s = max(self._unobserved_s(observation), _LEAST_ELAPSED_S)
        ids = unmatched(observation) if found is None else found.landmark_of_feature
        features = np.flatnonzero(ids >= 0)
        points = observation.depth_cells.points()
        moved = self._earlier_depth.moved(observation, T_camera_world, last.reference, points)
        alignment = align_depth(
            observation.depth_cells,
            points[~moved],
            reference,
            T_camera_world=T_camera_world,
            prior=PosePrior(predicted.T_camera_world, np.eye(6) / (predicted.speed_sigma * unsure_s) ** 2),
            landmarks=Landmarks(
                self._map.landmarks["position"][ids[features]],
                observation.measured[features],
                observation.weights[features],
                observation.intrinsics,
            ),
            noise=self._config.depth_noise,
        )
        if alignment is None:
            return None
        least = _MIN_VISIBLE_RATIO if found is None else _MIN_VISIBLE_RATIO_OF_PLACED
        return alignment if _agrees(alignment, least) else None

    def _reference(self, observation: ImageObservation, last: TrackedPose) -> ReferenceSurfaces:
        """Return the surfaces of the latest keyframes and of the last frame."""
        keyframes, cells = self._map.keyframes, observation.depth_cells
        origin = keyframes[last.reference].origin
        self._keyframes = [
            k
            for k in self._map.latest(last.reference)
            if keyframes[k].origin == origin
            and not self._is_doubtful_between(k, last.reference)
            and _of_one_camera(self._map.observation(k).depth_cells, cells)
        ]
        models = [(self._map.observation(k), keyframes[k].T_camera_world, k) for k in self._keyframes]
        unobserved = last.doubts or (last.depth is not None and last.depth.unobservable)
        # A relocalised frame is its own predecessor: aligned to itself, it would confirm any pose.
        used = {observation.stamp_ns, *(earlier.stamp_ns for earlier, _, _ in models)}
        if not unobserved and last.stamp_ns not in used:
            models.append((last.observation, last.T_camera_world, last.reference))
        models = [model for model in models if _of_one_camera(model[0].depth_cells, cells)]
        self._surfaces = {
            earlier.stamp_ns: self._surfaces.get(earlier.stamp_ns) or self._still_surface(earlier, T, k)
            for earlier, T, k in models
        }
        surfaces = [self._surfaces[earlier.stamp_ns] for earlier, _, _ in models]
        return ReferenceSurfaces(surfaces, [T for _, T, _ in models], len(self._keyframes))

    def _is_doubtful_between(self, a: int, b: int) -> bool:
        """Return whether a doubtful motion separates two keyframes: their surfaces lie elsewhere then."""
        return any(keyframe.doubt_m > 0.0 for keyframe in self._map.keyframes[min(a, b) + 1 : max(a, b) + 1])

    def _still_surface(
        self, observation: ImageObservation, T_camera_world: Transform, reference: int
    ) -> DepthSurface:
        """Return the surfaces of a frame without those of what has moved there."""
        cells = observation.depth_cells
        assert cells is not None
        surface = surface_of(cells)
        moved = self._earlier_depth.moved(observation, T_camera_world, reference, cells.points())
        planes = surface.planes.copy()
        planes[cells.inverse_depth > 0.0] *= ~moved[:, np.newaxis]
        return replace(surface, planes=planes)

    def _by_depth(
        self,
        observation: ImageObservation,
        alignment: DepthAlignment,
        reference: int,
        predicted: _Prediction,
    ) -> TrackedPose:
        """Return the pose of an alignment without landmarks."""
        expected = min(self._visible(alignment.T_camera_world, reference, observation), len(observation))
        doubts = self._doubts(observation, alignment, predicted)
        if not self._is_confirmed and expected >= 2 * self._config.min_inliers:
            # What moves with the camera, such as a hand before the lens, is consistent from frame to frame.
            text = f"{expected} features, but none where the depth image has them"
            doubts = (*doubts, Doubt("missing features", text))
        if predicted.gap_s > _MAX_GAP_S:
            text = f"found by depth alone after {predicted.gap_s:.1f} s"
            doubts = (*doubts, Doubt("depth alone", text))
        return TrackedPose(
            observation,
            alignment.T_camera_world,
            unmatched(observation),
            reference,
            alignment.points,
            alignment.agreeing_ratio,
            0,
            0.0,
            DEPTH_ONLY,
            depth=alignment,
            doubts=doubts,
        )

    def _by_both(
        self,
        observation: ImageObservation,
        alignment: DepthAlignment,
        found: TrackedPose,
        predicted: _Prediction,
    ) -> TrackedPose:
        """Return the pose of an alignment with landmarks, unless most of these contradict it."""
        agree = int(alignment.is_landmark_inlier.sum())
        if agree < _MIN_KEPT_RATIO * found.inliers:
            text = f"{agree} of {found.inliers} features agree with the depth image"
            return replace(found, doubts=(*found.doubts, Doubt("contradicted by depth", text)))
        landmark_of_feature = found.landmark_of_feature.copy()
        features = np.flatnonzero(landmark_of_feature >= 0)
        landmark_of_feature[features[~alignment.is_landmark_inlier]] = -1
        return replace(
            found,
            T_camera_world=alignment.T_camera_world,
            landmark_of_feature=landmark_of_feature,
            method=found.method if "depth" in found.method else f"{found.method}+depth",
            depth=alignment,
            doubts=(*found.doubts, *self._doubts(observation, alignment, predicted)),
        )

    def _doubts(
        self, observation: ImageObservation, alignment: DepthAlignment, predicted: _Prediction
    ) -> tuple[Doubt, ...]:
        """Return which motions were not observed and for how long, and record when all were."""
        if not alignment.unobservable:
            self._observed_ns = observation.stamp_ns
            return ()
        unobserved_s = self._unobserved_s(observation)
        if unobserved_s <= predicted.sure_s:
            return ()
        text = f"neither depth nor features show {alignment.unobservable} for {unobserved_s:.1f} s"
        return (Doubt(UNOBSERVED_MOTION, text),)

    def _unobserved_s(self, observation: ImageObservation) -> float:
        return (observation.stamp_ns - self._observed_ns) / NS_PER_S

    def _visible(self, T_camera_world: Transform, keyframe: int, observation: ImageObservation) -> int:
        """Return how many landmarks of a keyframe a pose has in the image."""
        points_world = self._map.landmarks["position"][self._map.landmarks_of(keyframe)]
        pixels = project(T_camera_world, points_world, observation.intrinsics)
        return int(((pixels >= 0.0) & (pixels < observation.size_px)).all(axis=1).sum())


def _predicted(
    observation: ImageObservation, last: TrackedPose, T_predicted: Transform | None
) -> _Prediction:
    """Return the predicted pose, or the last frame's if nothing predicts it."""
    if T_predicted is not None:
        return _Prediction(T_predicted, _SPEED_SIGMA, _SURE_S, 0.0)
    gap_s = (observation.stamp_ns - last.observation.stamp_ns) / NS_PER_S
    return _Prediction(last.T_camera_world, _UNKNOWN_SPEED_SIGMA, 0.0, gap_s)


def _of_one_camera(cells: DepthCells | None, others: DepthCells | None) -> bool:
    """Return whether there are two depth images, of the same camera."""
    return cells is not None and others is not None and cells.camera == others.camera


def _agrees(alignment: DepthAlignment, min_visible_ratio: float) -> bool:
    """Return whether enough of the depth image lies on the keyframes' surfaces, and little contradicts."""
    return (
        alignment.visible_ratio >= min_visible_ratio
        and alignment.weakest_ratio >= _MIN_WEAKEST_RATIO
        and alignment.contradicting_ratio <= _MAX_CONTRADICTING_RATIO
    )
