"""Tracking by depth where an image has little texture: the second leg of the local map's odometry."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Transform
from mapper.core.timebase import NS_PER_S
from mapper.odometry.camera.depth_surfaces import DepthCells, DepthSurface, surface_of
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.config import KeyframeOdometryConfig
from mapper.odometry.keyframes.depth_alignment import (
    DEPTH_ONLY,
    DepthAlignment,
    Landmarks,
    align_depth,
    observes_all,
)
from mapper.odometry.keyframes.depth_comparison import EarlierDepth
from mapper.odometry.keyframes.landmarks import LandmarkMap
from mapper.odometry.keyframes.local_search import LocalSearch
from mapper.odometry.keyframes.pose_tracker import WEAK_INLIERS, TrackedPose, project, unmatched

_MIN_VISIBLE_RATIO = 0.3
_MIN_WEAKEST_RATIO = 0.5
"""A wrong pose can have most points on the floor or on one wall, so every direction of the normals counts."""
_MAX_CONTRADICTING_RATIO = 0.3
"""A real desk's many edges give 0.2 under a right pose, a hand that comes before the lens 0.8."""
_SPEED_SIGMA = 0.5
"""Metres and radians per second by which a predicted motion may err: one sigma for a camera in a hand."""
_SURE_S = 0.1
"""Time for which a prediction is trusted: it errs by 5 cm."""
_MAX_UNOBSERVED_S = 2.0
"""After this time on a prediction in any direction a frame is lost."""
_MAX_GAP_S = 0.5
"""After a longer gap without frames another corner may be in view that looks alike."""
_LEAST_ELAPSED_S = 0.01
_MIN_KEPT_RATIO = 0.5
"""When fewer of a pose's landmarks agree once the depth image takes part, one of both is wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class _Surfaces:
    """Surfaces that a depth image is aligned to: of the latest keyframes, then perhaps of the last frame.

    Attributes:
        keyframes: Their numbers.
        surfaces: As many surfaces as keyframes, or one more.
        T_camera_world: (4, 4) each.
    """

    keyframes: list[int]
    surfaces: list[DepthSurface]
    T_camera_world: list[Transform]


class DepthTracker:
    """Pose of frames of few landmarks by their depth image, against the surfaces of the last keyframes."""

    def __init__(self, config: KeyframeOdometryConfig, landmark_map: LandmarkMap) -> None:
        self._config = config
        self._map = landmark_map
        self._search = LocalSearch(config, landmark_map)
        self._earlier_depth = EarlierDepth(landmark_map, config.depth_noise)
        self._surfaces: dict[int, DepthSurface] = {}  # of the frames last used, by stamp
        self._observed_ns = 0  # when every motion was last observed
        self._is_confirmed = False  # the sub-map, by a frame of many landmarks

    def can_start(self, observation: ImageObservation) -> bool:
        """Return whether a map can begin with a frame although it has few features."""
        cells = observation.depth_cells
        return cells is not None and observes_all(surface_of(cells))

    def began(self, observation: ImageObservation) -> None:
        """Take note of a sub-map's first frame."""
        self._observed_ns, self._is_confirmed = observation.stamp_ns, False
        self._surfaces.clear()

    def supported(
        self,
        observation: ImageObservation,
        last: TrackedPose,
        T_predicted: Transform | None,
        found: TrackedPose | None,
    ) -> TrackedPose | None:
        """Return a frame's pose by landmarks and depth together, where there are few landmarks.

        Args:
            observation: The frame.
            last: The last frame that was tracked.
            T_predicted: T_camera_world (4, 4) by the motion since; None if nothing tells it.
            found: The pose from landmarks alone; None if they gave none.

        Returns:
            ``found`` itself if its landmarks are many, or if the depth image disagrees with the keyframes;
            None if there is no pose.
        """
        if found is not None and found.inliers >= WEAK_INLIERS:
            self._observed_ns, self._is_confirmed = observation.stamp_ns, True
            return found
        if found is None and self._unobserved_s(observation) > _MAX_UNOBSERVED_S:
            return None
        gap_s = 0.0
        if T_predicted is None:
            T_predicted = last.T_camera_world
            gap_s = (observation.stamp_ns - last.observation.stamp_ns) / NS_PER_S
        near = self._near_surfaces(observation, last)
        starts = [T_predicted] if found is None else [found.T_camera_world, T_predicted]
        for T_camera_world in starts:
            alignment = self._aligned(observation, T_camera_world, T_predicted, last, found, near)
            if alignment is not None and _agrees(alignment):
                break
        else:
            if found is not None:
                self._observed_ns = observation.stamp_ns
            return found
        if found is not None:
            return self._by_both(observation, alignment, found)
        reference = near.keyframes[int(np.argmax(alignment.agreeing))]
        found = self._search.refine(
            observation,
            alignment.T_camera_world,
            unmatched(observation),
            reference=reference,
            method="depth+map",
        )
        return found or self._by_depth(observation, alignment, reference, gap_s)

    def _aligned(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        T_predicted: Transform,
        last: TrackedPose,
        found: TrackedPose | None,
        near: _Surfaces,
    ) -> DepthAlignment | None:
        if observation.depth_cells is None or not near.surfaces:
            return None
        unsure_s = max(self._unobserved_s(observation), _LEAST_ELAPSED_S)
        ids = unmatched(observation) if found is None else found.landmark_of_feature
        features = np.flatnonzero(ids >= 0)
        points = observation.depth_cells.points()
        moved = self._earlier_depth.moved(observation, T_camera_world, last.reference, points)
        return align_depth(
            observation.depth_cells,
            points[~moved],
            near.surfaces,
            near.T_camera_world,
            keyframes=len(near.keyframes),
            T_camera_world=T_camera_world,
            T_prior=T_predicted,
            prior=np.eye(6) / (_SPEED_SIGMA * unsure_s) ** 2,
            landmarks=Landmarks(
                self._map.landmarks["position"][ids[features]],
                observation.measured[features],
                observation.weights[features],
                observation.intrinsics,
            ),
            noise=self._config.depth_noise,
        )

    def _near_surfaces(self, observation: ImageObservation, last: TrackedPose) -> _Surfaces:
        """Return the surfaces of the latest keyframes and of the last frame."""
        keyframes, cells = self._map.keyframes, observation.depth_cells
        origin = keyframes[last.reference].origin
        latest = [
            k
            for k in self._map.latest(last.reference)
            if keyframes[k].origin == origin and _alike(self._map.observation(k).depth_cells, cells)
        ]
        models = [(self._map.observation(k), keyframes[k].T_camera_world, k) for k in latest]
        blind = last.doubts or (last.depth is not None and last.depth.unobservable)
        if not blind and all(earlier.stamp_ns != last.observation.stamp_ns for earlier, _, _ in models):
            models.append((last.observation, last.T_camera_world, last.reference))
        models = [model for model in models if _alike(model[0].depth_cells, cells)]
        self._surfaces = {
            earlier.stamp_ns: self._surfaces.get(earlier.stamp_ns) or self._still_surface(earlier, T, k)
            for earlier, T, k in models
        }
        surfaces = [self._surfaces[earlier.stamp_ns] for earlier, _, _ in models]
        return _Surfaces(latest, surfaces, [T for _, T, _ in models])

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
        self, observation: ImageObservation, alignment: DepthAlignment, reference: int, gap_s: float
    ) -> TrackedPose:
        """Return the pose of an alignment without landmarks, ``gap_s`` after the motion was last known."""
        expected = min(self._visible(alignment.T_camera_world, reference, observation), len(observation))
        doubts = self._doubts(observation, alignment)
        if not self._is_confirmed and expected >= 2 * self._config.min_inliers:
            # What moves with the camera, such as a hand before the lens, agrees with itself.
            doubts = (
                *doubts,
                Doubt("disagreement", f"{expected} features, but none where the depth image has them"),
            )
        if gap_s > _MAX_GAP_S:
            doubts = (*doubts, Doubt("unconfirmed", f"found by depth alone after {gap_s:.1f} s"))
        return TrackedPose(
            observation,
            alignment.T_camera_world,
            unmatched(observation),
            reference,
            alignment.points,
            0,
            0.0,
            DEPTH_ONLY,
            depth=alignment,
            doubts=doubts,
        )

    def _by_both(
        self, observation: ImageObservation, alignment: DepthAlignment, found: TrackedPose
    ) -> TrackedPose:
        """Return the pose of an alignment with landmarks, unless most of these contradict it."""
        agree = int(alignment.is_landmark_inlier.sum())
        if agree < _MIN_KEPT_RATIO * found.inliers:
            doubt = Doubt("disagreement", f"{agree} of {found.inliers} features agree with the depth image")
            return replace(found, doubts=(*found.doubts, doubt))
        landmark_of_feature = found.landmark_of_feature.copy()
        features = np.flatnonzero(landmark_of_feature >= 0)
        landmark_of_feature[features[~alignment.is_landmark_inlier]] = -1
        return replace(
            found,
            T_camera_world=alignment.T_camera_world,
            landmark_of_feature=landmark_of_feature,
            method=found.method if "depth" in found.method else f"{found.method}+depth",
            depth=alignment,
            doubts=(*found.doubts, *self._doubts(observation, alignment)),
        )

    def _doubts(self, observation: ImageObservation, alignment: DepthAlignment) -> tuple[Doubt, ...]:
        """Return which motions were not observed and for how long, and take note when all were."""
        if not alignment.unobservable:
            self._observed_ns = observation.stamp_ns
            return ()
        unobserved_s = self._unobserved_s(observation)
        if unobserved_s <= _SURE_S:
            return ()
        return (
            Doubt(
                "unobservable",
                f"neither depth nor features show {alignment.unobservable} for {unobserved_s:.1f} s",
            ),
        )

    def _unobserved_s(self, observation: ImageObservation) -> float:
        return (observation.stamp_ns - self._observed_ns) / NS_PER_S

    def _visible(self, T_camera_world: Transform, keyframe: int, observation: ImageObservation) -> int:
        """Return how many landmarks of a keyframe a pose has in the image."""
        points_world = self._map.landmarks["position"][self._map.landmarks_of(keyframe)]
        pixels = project(T_camera_world, points_world, observation.intrinsics)
        return int(((pixels >= 0.0) & (pixels < observation.size_px)).all(axis=1).sum())


def _alike(cells: DepthCells | None, others: DepthCells | None) -> bool:
    """Return whether there are two depth images, of the same camera."""
    return cells is not None and others is not None and cells.camera == others.camera


def _agrees(alignment: DepthAlignment) -> bool:
    """Return whether enough of the depth image lies on the keyframes' surfaces, and little contradicts."""
    return (
        alignment.visible_ratio >= _MIN_VISIBLE_RATIO
        and alignment.weakest_ratio >= _MIN_WEAKEST_RATIO
        and alignment.contradicting_ratio <= _MAX_CONTRADICTING_RATIO
    )
