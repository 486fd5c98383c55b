"""Local map: keyframes, landmarks, and the observations of landmarks in keyframes."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, adjoint, apply, inverse
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.camera.readout_time import ReadoutTime
from mapper.odometry.keyframes.bundle_adjustment import adjust, common_parameter
from mapper.odometry.keyframes.focal_length import Bundle
from mapper.odometry.keyframes.growing_table import GrowingTable
from mapper.odometry.keyframes.keyframe import DepthLink, Keyframe, RecentObservations
from mapper.odometry.keyframes.landmark_kernels import count_observers, observations_of
from mapper.registration.reprojection import normal_matrix
from mapper.runtime.archived import archived

Ids = NDArray[np.int32]

_WEAK_PRIOR = np.diag([1.0] * 3 + [0.01] * 3)
"""1 rad and 10 m: keeps the information positive definite where few landmarks leave it singular."""
MIN_SHARED_LANDMARKS = 15
"""Keyframes that share fewer are not covisible (Mur-Artal, Montiel & Tardós 2015, §III-D)."""
_MIN_FOUND_RATIO = 0.25
"""Young landmarks found in a smaller share of the frames that should show them are removed (ibid., §VI-B)."""
_BUNDLE_ROUNDS, _BUNDLE_ITERATIONS = 2, 5
_NEWEST = 3


class LandmarkMap:
    """Map of keyframes and landmarks, refined together in windows.

    A landmark's observations form a linked list, newest first, so that adding one is cheap and compiled code
    can traverse them without Python objects.
    """

    def __init__(self, *, scale_factor: float, readout: ReadoutTime) -> None:
        self.readout = readout
        self.keyframes: list[Keyframe] = []
        self.landmarks = GrowingTable(
            position=((3,), np.float64),
            direction=((3,), np.float64),
            bits=((4,), np.uint64),
            reach_m=((), np.float64),
            newest=((), np.int32),
            visible=((), np.int32),
            found=((), np.int32),
            observers=((), np.int32),
        )
        self._observations = GrowingTable(
            older=((), np.int32),
            keyframe=((), np.int32),
            feature=((), np.int32),
            measured=((3,), np.float64),
            weights=((3,), np.float64),
            slope=((2,), np.float64),
        )
        self.scale_factor = scale_factor
        self._observed_with_s = readout.seconds
        self._first_landmark: list[int] = []
        self._recent = RecentObservations()

    def observation(self, index: int) -> ImageObservation:
        """Return what was observed in a keyframe, by the readout time as it is known now.

        Raises:
            DataError: It is on the disk, and cannot be read.
        """
        return self._recent.of(index, self.keyframes[index])

    def add_keyframe(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        landmark_of_feature: Ids,
        *,
        new: NDArray[np.bool_],
        neighbour: int | None,
        twist_camera: Array,
        depth_information: Array | None = None,
    ) -> int:
        """Add a keyframe that observes known landmarks, and create landmarks from its ``new`` features.

        Args:
            observation: The frame's features.
            T_camera_world: (4, 4).
            landmark_of_feature: (N,) known landmark of each feature, −1 for none.
            new: (N,) features with depth that become landmarks.
            neighbour: A keyframe of the same sub-map; None begins a new one.
            twist_camera: (6,) as in ``Keyframe``.
            depth_information: (6, 6) information of its pose relative to the neighbour from depth images,
                camera tangent; None if these were not aligned.

        Returns:
            The keyframe's index.
        """
        index = len(self.keyframes)
        self._first_landmark.append(self.landmarks.size)
        landmark_of_feature = landmark_of_feature.copy()
        features = np.flatnonzero(new)
        points_world = apply(inverse(T_camera_world), observation.points_camera[features])
        landmark_of_feature[features] = self.landmarks.append(
            len(features),
            position=points_world,
            direction=0.0,
            bits=observation.bits[features],
            reach_m=np.linalg.norm(observation.points_camera[features], axis=1)
            * self.scale_factor ** observation.octave[features],
            newest=-1,
            visible=1,
            found=1,
            observers=0,
        )
        origin = index if neighbour is None else self.keyframes[neighbour].origin
        link = None
        if neighbour is not None and depth_information is not None:
            T_camera_reference = T_camera_world @ inverse(self.keyframes[neighbour].T_camera_world)
            link = DepthLink(neighbour, T_camera_reference, depth_information)
        self.keyframes.append(
            Keyframe(
                stamp_ns=observation.stamp_ns,
                T_body_camera=observation.T_body_camera,
                unswept=archived(observation if observation.unswept is None else observation.unswept),
                sweep_camera=observation.sweep_camera,
                T_camera_world=T_camera_world,
                landmark_of_feature=landmark_of_feature,
                origin=origin,
                twist_camera=twist_camera,
                depth_link=link,
            )
        )
        self._recent.keep(index, observation)
        self._link(index)
        return index

    def _link(self, index: int) -> None:
        keyframe = self.keyframes[index]
        features = np.flatnonzero(keyframe.landmark_of_feature >= 0)
        ids = keyframe.landmark_of_feature[features]
        centre_world = inverse(keyframe.T_camera_world)[:3, 3]
        ray = self.landmarks["position"][ids] - centre_world
        self.landmarks["observers"][ids] += 1
        self.landmarks["direction"][ids] += ray / np.linalg.norm(ray, axis=1, keepdims=True)
        observation = self.observation(index)
        self.landmarks["newest"][ids] = self._observations.append(
            len(features),
            older=self.landmarks["newest"][ids],
            keyframe=index,
            feature=features,
            measured=observation.measured[features],
            weights=observation.weights[features],
            slope=-observation.line_shift(
                observation.pixels[features],
                apply(keyframe.T_camera_world, self.landmarks["position"][ids])[:, 2],
                keyframe.twist_camera,
            ),
        )

    def shared_counts(self, landmarks: Ids) -> NDArray[np.int64]:
        """Return (K,) how many of the landmarks each keyframe observes."""
        counts: NDArray[np.int64] = count_observers(
            landmarks,
            self.landmarks["newest"],
            self._observations["older"],
            self._observations["keyframe"],
            len(self.keyframes),
        )
        return counts

    def latest(self, reference: int) -> list[int]:
        """Return a keyframe and then the newest ones, newest first."""
        newest = range(len(self.keyframes) - 1, max(len(self.keyframes) - 1 - _NEWEST, -1), -1)
        return list(dict.fromkeys([reference, *newest]))

    def previous(self, index: int) -> int:
        """Return the keyframe before another one of the same sub-map, of which it is not the first."""
        origin = self.keyframes[index].origin
        return max(k for k in range(index) if self.keyframes[k].origin == origin)

    def landmarks_of(self, index: int) -> Ids:
        """Return the landmarks that a keyframe observes, in feature order."""
        ids = self.keyframes[index].landmark_of_feature
        return ids[ids >= 0]

    def positions_of(self, landmark_of_feature: Ids) -> Points:
        """Return the (M, 3) positions of the landmarks that features have, in the order of the features."""
        positions_world: Points = self.landmarks["position"][landmark_of_feature[landmark_of_feature >= 0]]
        return positions_world

    def landmarks_of_any(self, keyframes: Iterable[int], *, except_for: Ids) -> Ids:
        """Return, in increasing order, the landmarks that any of the keyframes observes."""
        observed = np.zeros(self.landmarks.size + 1, np.bool_)
        for k in keyframes:
            observed[self.keyframes[k].landmark_of_feature] = True  # −1, none, marks the spare last entry
        observed[-1] = False
        observed[except_for] = False
        return np.flatnonzero(observed).astype(np.int32)

    def covisible(self, index: int, *, min_shared: int) -> list[tuple[int, int]]:
        """Return (keyframe, shared landmarks) of those that share enough: most first, of equals the newer."""
        counts = self.shared_counts(self.landmarks_of(index))
        counts[index] = 0
        others = np.flatnonzero(counts >= min_shared)
        order = np.lexsort((-others, -counts[others]))
        return [(int(k), int(counts[k])) for k in others[order]]

    def refine(self, index: int, *, window: int) -> None:
        """Adjust a keyframe, its most covisible ones and their landmarks; drop observations that disagree.

        Keyframes outside the window that observe these landmarks take part but stay fixed, as does the first
        of a sub-map. Depth links hold keyframes of few landmarks.
        """
        covisible = self.covisible(index, min_shared=MIN_SHARED_LANDMARKS)
        members = [index, *(k for k, _ in covisible[: window - 1])]
        movable = sorted(k for k in members if k != self.keyframes[k].origin)
        if not movable:
            return
        landmarks = self.landmarks_of_any(members, except_for=np.empty(0, np.int32))
        first, observations = observations_of(
            landmarks, self.landmarks["newest"], self._observations["older"], self._observations["keyframe"]
        )
        linked, T_links, link_information = self._links(movable)
        observed_in = self._observations["keyframe"][observations]
        keyframe_ids = np.unique(np.concatenate([observed_in, linked.ravel(), np.array(movable, np.int32)]))
        local = np.searchsorted(keyframe_ids, observed_in)
        free = np.full(len(keyframe_ids), -1, np.int32)
        free[np.searchsorted(keyframe_ids, movable)] = np.arange(len(movable))
        rows = np.repeat(np.arange(len(landmarks)), np.diff(first))
        edges = np.column_stack([local, rows]).astype(np.int32)
        measured, weights = (
            self._observations["measured"][observations],
            self._observations["weights"][observations],
        )
        intrinsics = self.observation(index).intrinsics
        links = np.searchsorted(keyframe_ids, linked).astype(np.int32), T_links, link_information
        poses, points, agree = adjust(
            np.array([self.keyframes[k].T_camera_world for k in keyframe_ids]),
            free,
            self.landmarks["position"][landmarks],
            first,
            edges,
            measured,
            weights,
            intrinsics,
            links,
            _BUNDLE_ROUNDS,
            _BUNDLE_ITERATIONS,
        )
        if self.readout.is_estimated and len(linked) == 0:
            slopes = self._observations["slope"][observations]
            self.readout.learn(
                *common_parameter(
                    poses, free, points, first, edges, measured, weights, intrinsics, agree, slopes
                )
            )
        for k, f in zip(keyframe_ids, free, strict=True):
            if f >= 0:
                self.keyframes[k].T_camera_world = poses[np.searchsorted(keyframe_ids, k)]
        self.landmarks["position"][landmarks] = points
        self._unlink(observations[~agree])

    def bundle(self, keyframes: Sequence[int]) -> Bundle:
        """Return keyframes, given in increasing order, with all their observations and landmarks."""
        landmarks = self.landmarks_of_any(keyframes, except_for=np.empty(0, np.int32))
        first, observations = observations_of(
            landmarks, self.landmarks["newest"], self._observations["older"], self._observations["keyframe"]
        )
        observed_in = self._observations["keyframe"][observations]
        among = np.isin(observed_in, keyframes)
        rows = np.repeat(np.arange(len(landmarks)), np.diff(first))[among]
        edges = np.column_stack([np.searchsorted(keyframes, observed_in[among]), rows]).astype(np.int32)
        return Bundle(
            poses=np.array([self.keyframes[k].T_camera_world for k in keyframes]),
            points=self.landmarks["position"][landmarks],
            edges=edges,
            measured=self._observations["measured"][observations[among]],
            weights=self._observations["weights"][observations[among]],
            intrinsics=self.observation(keyframes[-1]).intrinsics,
        )

    def follow_readout(self) -> None:
        """Observe all keyframes' landmarks anew if the readout time has changed."""
        if self.readout.seconds == self._observed_with_s:
            return
        by_s = self.readout.seconds - self._observed_with_s
        self._observed_with_s = self.readout.seconds
        for keyframe in self.keyframes:
            keyframe.sweep_camera = keyframe.sweep_camera + by_s * keyframe.twist_camera
        self._recent.clear()
        rows = slice(self._observations.size)
        self._observations["measured"][rows, :2] += by_s * self._observations["slope"][rows]

    def _links(self, keyframes: Iterable[int]) -> tuple[Ids, Array, Array]:
        """Return the depth links of some keyframes, as ``adjust`` takes them."""
        linked = [(k, self.keyframes[k].depth_link) for k in keyframes]
        links = [(k, link) for k, link in linked if link is not None]
        return (
            np.array([(link.reference, k) for k, link in links], np.int32).reshape(-1, 2),
            np.array([link.T_camera_reference for _, link in links]).reshape(-1, 4, 4),
            np.array([link.information for _, link in links]).reshape(-1, 6, 6),
        )

    def _unlink(self, observations: Ids) -> None:
        keyframes, features = self._observations["keyframe"], self._observations["feature"]
        landmarks = []
        for e in observations:
            landmarks.append(self.keyframes[keyframes[e]].landmark_of_feature[features[e]])
            self.keyframes[keyframes[e]].landmark_of_feature[features[e]] = -1
        keyframes[observations] = -1
        ids = np.array(landmarks, dtype=np.intp)
        np.subtract.at(self.landmarks["observers"], ids, 1)
        # Nobody reads them any more: zeros, as four landmarks of five are, make checkpoints small.
        for name in ("measured", "weights", "slope"):
            self._observations[name][observations] = 0.0
        removed = ids[self.landmarks["observers"][ids] == 0]
        for name in ("position", "direction", "bits", "reach_m"):
            self.landmarks[name][removed] = 0

    def cull(self) -> None:
        """Remove young landmarks that no second keyframe observes or that tracking rarely finds.

        Two keyframes after its creation a landmark must have a second observer; mismatches and depth errors
        at object edges rarely get one (Mur-Artal, Montiel & Tardós 2015, §VI-B).
        """
        index = len(self.keyframes) - 1
        recent = np.arange(self._first_landmark[max(index - 3, 0)], self._first_landmark[max(index - 1, 0)])
        unconfirmed = self.landmarks["observers"][recent] == 1
        found, visible = self.landmarks["found"][recent], self.landmarks["visible"][recent]
        removed = recent[unconfirmed | (found < _MIN_FOUND_RATIO * visible)].astype(np.int32)
        _, observations = observations_of(
            removed, self.landmarks["newest"], self._observations["older"], self._observations["keyframe"]
        )
        self._unlink(observations)

    def pose_information(
        self, observation: ImageObservation, T_camera_world: Transform, landmark_of_feature: Ids
    ) -> Array:
        """Return the (6, 6) information of a frame's pose from its landmarks, in the body's tangent."""
        features = np.flatnonzero(landmark_of_feature >= 0)
        H_camera = normal_matrix(
            T_camera_world,
            self.landmarks["position"][landmark_of_feature[features]],
            observation.measured[features],
            observation.weights[features],
            observation.intrinsics,
        )
        to_camera = adjoint(inverse(observation.T_body_camera))
        information: Array = to_camera.T @ H_camera @ to_camera + _WEAK_PRIOR
        return information

    def information(self, target: int, source: int) -> Array:
        """Return the (6, 6) information of the source's pose in the target from shared landmarks.

        The landmarks are taken as fixed in the target. They were measured no better than the source's
        features, so the information is halved. Tangent of the source's body, (rotation, translation).
        """
        keyframe = self.keyframes[source]
        shared, _, features = np.intersect1d(
            self.landmarks_of(target), keyframe.landmark_of_feature, return_indices=True
        )
        observation = self.observation(source)
        H_camera = 0.5 * normal_matrix(
            keyframe.T_camera_world,
            self.landmarks["position"][shared],
            observation.measured[features],
            observation.weights[features],
            observation.intrinsics,
        )
        to_camera = adjoint(inverse(observation.T_body_camera))
        H_body: Array = to_camera.T @ H_camera @ to_camera
        return H_body + _WEAK_PRIOR

    def depth_information(self, target: int, source: int) -> Array:
        """Return the (6, 6) information of the source's pose in the target from their depth images.

        Zero if they were not aligned. Tangent of the source's body, (rotation, translation).
        """
        keyframe = self.keyframes[source]
        if keyframe.depth_link is None or keyframe.depth_link.reference != target:
            return np.zeros((6, 6))
        to_camera = adjoint(inverse(keyframe.T_body_camera))
        H_body: Array = to_camera.T @ keyframe.depth_link.information @ to_camera
        return H_body
