"""Local map: keyframes, landmarks, and the observations of landmarks in keyframes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform, apply, inverse
from mapper.odometry.local_map.bundle.bundle import Bundle
from mapper.odometry.local_map.bundle.bundle_adjustment import Observations, adjust, common_parameter
from mapper.odometry.local_map.bundle.log_residuals import USUAL_VARIANCE
from mapper.odometry.local_map.landmarks.keyframe import (
    DepthLink,
    Keyframe,
    RecentObservations,
    depth_links,
    packed,
    unpacked,
)
from mapper.odometry.local_map.landmarks.landmark_kernels import count_observers, observations_of
from mapper.odometry.local_map.landmarks.paged_table import PagedTable
from mapper.odometry.local_map.landmarks.ray_uncertainty import updated_ray_sigma_m
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.odometry.local_map.observation.readout_time import ReadoutTime
from mapper.runtime.archived import archived

Ids = NDArray[np.int32]

MIN_SHARED_LANDMARKS = 15
"""Keyframes that share fewer are not covisible (Mur-Artal, Montiel & Tardós 2015, §III-D)."""
_MIN_FOUND_RATIO = 0.25
"""New landmarks found in a smaller share of the frames that should show them are removed (ibid., §VI-B)."""
_ROUNDS, _ITERATIONS = 2, 5
_MOST_WIDENED = 3
"""A window is widened to at most this many times its size."""
_NEWEST = 3
_NEVER_LINKED = -2


class LandmarkMap:
    """Map of keyframes and landmarks, refined together in windows.

    A landmark's observations form a linked list, newest first, so that adding one is cheap and compiled code
    can traverse them without Python objects. Every feature of a keyframe has a row among the observations,
    whether or not it is one of a landmark. What lies far behind is not in memory (``PagedTable``).
    """

    def __init__(self, *, scale_factor: float, readout: ReadoutTime) -> None:
        self.readout = readout
        self.keyframes: list[Keyframe] = []
        self.landmarks = PagedTable(
            position=((3,), np.float64),
            direction=((3,), np.float64),
            bits=((4,), np.uint64),
            reach_m=((), np.float64),
            newest=((), np.int32),
            visible=((), np.int32),
            found=((), np.int32),
            observers=((), np.int32),
            ray_sigma_m=((), np.float64),
        )
        self._observations = PagedTable(
            landmark=((), np.int32),
            older=((), np.int32),
            keyframe=((), np.int32),
            measured=((3,), np.float64),
            weights=((3,), np.float64),
            slope=((2,), np.float64),
            readouts=((), np.int32),
        )
        self.scale_factor = scale_factor
        self.residual_variance = USUAL_VARIANCE  # as ``LogResiduals.variance``
        self._observed_with_s = readout.seconds
        self._readout_steps_s: list[float] = []  # observations tell how many of them they follow
        self._first_landmark: list[int] = []  # of each keyframe
        self._first_observation: list[int] = [0]  # of each keyframe, and of the next
        self._recent = RecentObservations()

    def __getstate__(self) -> dict[str, Any]:
        """Return the keyframes as a few arrays, since there are many."""
        return {**vars(self), "keyframes": packed(self.keyframes)}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state, keyframes=unpacked(state["keyframes"]))

    def step(self) -> None:
        """Begin with the next frame: what was not used for some of them leaves the memory."""
        self.landmarks.step()
        self._observations.step()

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
        self.keyframes.append(
            Keyframe(
                stamp_ns=observation.stamp_ns,
                T_body_camera=observation.T_body_camera,
                unswept=archived(observation if observation.unswept is None else observation.unswept),
                sweep_camera=observation.sweep_camera,
                T_camera_world=T_camera_world,
                origin=index if neighbour is None else self.keyframes[neighbour].origin,
                twist_camera=twist_camera,
                depth_link=self._depth_link(neighbour, T_camera_world, depth_information),
            )
        )
        self._recent.keep(index, observation)
        self._observations.append(
            len(observation),
            landmark=-1,
            older=_NEVER_LINKED,
            keyframe=-1,
            measured=0.0,
            weights=0.0,
            slope=0.0,
            readouts=len(self._readout_steps_s),
        )
        self._first_observation.append(self._observations.size)
        known = np.flatnonzero(landmark_of_feature >= 0)
        self._link(index, known, landmark_of_feature[known])
        features = np.flatnonzero(new)
        points_world = apply(inverse(T_camera_world), observation.points_camera[features])
        self.add_landmarks(points_world, [(index, features)])
        return index

    def _depth_link(
        self, neighbour: int | None, T_camera_world: Transform, information: Array | None
    ) -> DepthLink | None:
        if neighbour is None or information is None:
            return None
        T_camera_reference = T_camera_world @ inverse(self.keyframes[neighbour].T_camera_world)
        return DepthLink(neighbour, T_camera_reference, information)

    def add_landmarks(
        self,
        points_world: Points,
        observed: Sequence[tuple[int, NDArray[np.integer]]],
        ray_sigma_m: Array | float = 0.0,
    ) -> None:
        """Create landmarks from features that are none's yet.

        Args:
            points_world: (M, 3) metres.
            observed: Keyframes, and the (M,) features by which each observes them. The last keyframe's
                descriptors become the landmarks'.
            ray_sigma_m: (M,) standard deviation along the rays; 0 where depth was measured.
        """
        index, features = observed[-1]
        observation = self.observation(index)
        distance_m = np.linalg.norm(apply(self.keyframes[index].T_camera_world, points_world), axis=1)
        ids = self.landmarks.append(
            len(points_world),
            position=points_world,
            direction=0.0,
            bits=observation.bits[features],
            reach_m=distance_m * self.scale_factor ** observation.octave[features],
            newest=-1,
            visible=1,
            found=1,
            observers=0,
            ray_sigma_m=ray_sigma_m,
        )
        for keyframe, features in observed:
            self._link(keyframe, features, ids)

    def never_linked(self, index: int) -> NDArray[np.intp]:
        """Return a keyframe's features that were never a landmark's: lists may lead through the others."""
        rows = np.arange(self._first_observation[index], self._first_observation[index + 1])
        return np.flatnonzero(self._observations["older"][rows] == _NEVER_LINKED)

    def _link(self, index: int, features: NDArray[np.integer], ids: Ids) -> None:
        """Add observations by features of a keyframe to the lists of their landmarks."""
        keyframe = self.keyframes[index]
        centre_world = inverse(keyframe.T_camera_world)[:3, 3]
        ray = self.landmarks["position"][ids] - centre_world
        self.landmarks["observers"][ids] += 1
        self.landmarks["direction"][ids] += ray / np.linalg.norm(ray, axis=1, keepdims=True)
        observation = self.observation(index)
        observations = self._first_observation[index] + features
        self._observations["landmark"][observations] = ids
        self._observations["older"][observations] = self.landmarks["newest"][ids]
        self._observations["keyframe"][observations] = index
        self._observations["measured"][observations] = observation.measured[features]
        self._observations["weights"][observations] = observation.weights[features]
        self._observations["slope"][observations] = -observation.row_shift(
            observation.pixels[features],
            apply(keyframe.T_camera_world, self.landmarks["position"][ids])[:, 2],
            keyframe.twist_camera,
        )
        self.landmarks["newest"][ids] = observations

    def shared_counts(self, landmarks: Ids) -> NDArray[np.int64]:
        """Return (K,) how many of the landmarks each keyframe observes."""
        counts: NDArray[np.int64] = self._observations.follow(
            count_observers,
            self.landmarks["newest"][landmarks],
            len(self.keyframes),
            columns=("older", "keyframe"),
        )
        return counts

    def _observations_of(self, landmarks: Ids) -> tuple[Ids, Ids]:
        """Return (M + 1,) group starts and (E,) observations, grouped by landmark."""
        grouped: tuple[Ids, Ids] = self._observations.follow(
            observations_of, self.landmarks["newest"][landmarks], columns=("older", "keyframe")
        )
        return grouped

    def latest(self, reference: int) -> list[int]:
        """Return a keyframe and then the newest ones, newest first."""
        newest = range(len(self.keyframes) - 1, max(len(self.keyframes) - 1 - _NEWEST, -1), -1)
        return list(dict.fromkeys([reference, *newest]))

    def previous(self, index: int) -> int:
        """Return the keyframe before another one of the same sub-map, of which it is not the first."""
        origin = self.keyframes[index].origin
        return next(k for k in reversed(range(index)) if self.keyframes[k].origin == origin)

    def landmark_of_feature(self, index: int) -> Ids:
        """Return the (N,) landmark of each feature of a keyframe, −1 for none."""
        return self._landmarks_in([index])

    def landmarks_of(self, index: int) -> Ids:
        """Return the landmarks that a keyframe observes, in feature order."""
        ids = self._landmarks_in([index])
        return ids[ids >= 0]

    def landmarks_of_any(self, keyframes: Sequence[int], *, except_for: Ids) -> Ids:
        """Return, in increasing order, the landmarks that any of the keyframes observes."""
        ids = self._landmarks_in(keyframes)
        ids = ids[ids >= 0]
        least = int(ids.min(initial=self.landmarks.size))
        observed = np.zeros(int(ids.max(initial=least)) + 1 - least, np.bool_)
        observed[ids - least] = True
        observed[except_for[(except_for >= least) & (except_for < least + len(observed))] - least] = False
        return (least + np.flatnonzero(observed)).astype(np.int32)

    def _landmarks_in(self, keyframes: Sequence[int]) -> Ids:
        """Return the landmark of each feature of some keyframes, one after another, −1 for none."""
        first = self._first_observation
        rows = [np.arange(first[k], first[k + 1]) for k in keyframes]
        return self._observations["landmark"][np.concatenate([np.empty(0, np.intp), *rows])]

    def covisible(self, index: int, *, min_shared: int) -> list[tuple[int, int]]:
        """Return (keyframe, shared landmarks) of those that share enough: most first, of equals the newer."""
        counts = self.shared_counts(self.landmarks_of(index))
        counts[index] = 0
        others = np.flatnonzero(counts >= min_shared)
        order = np.lexsort((-others, -counts[others]))
        return [(int(k), int(counts[k])) for k in others[order]]

    def refine(self, index: int, *, window: int, variance_factor: float = 1.0) -> None:
        """Adjust a keyframe, its most covisible ones and their landmarks; drop observations that disagree.

        Keyframes outside the window that observe these landmarks take part but stay fixed, as does the first
        of a sub-map. Depth links constrain keyframes of few landmarks. All observations' variances are
        multiplied by a factor.
        """
        members = self._window(index, window)
        movable = sorted(k for k in members if k != self.keyframes[k].origin)
        if not movable:
            return
        landmarks = self.landmarks_of_any(members, except_for=np.empty(0, np.int32))
        first, observations = self._observations_of(landmarks)
        linked, T_links, link_information = depth_links(self.keyframes, movable)
        observed_in = self._observations["keyframe"][observations]
        keyframe_ids = np.unique(np.concatenate([observed_in, linked.ravel(), np.array(movable, np.int32)]))
        local = np.searchsorted(keyframe_ids, observed_in)
        free = np.full(len(keyframe_ids), -1, np.int32)
        free[np.searchsorted(keyframe_ids, movable)] = np.arange(len(movable))
        rows = np.repeat(np.arange(len(landmarks)), np.diff(first))
        edges = np.column_stack([local, rows]).astype(np.int32)
        measured, weights = self._measured(observations), self._observations["weights"][observations]
        intrinsics = self.observation(index).intrinsics
        observed = Observations(first, edges, measured, weights / variance_factor, intrinsics)
        links = np.searchsorted(keyframe_ids, linked).astype(np.int32), T_links, link_information
        start = np.array([self.keyframes[k].T_camera_world for k in keyframe_ids])
        poses, points, agree = adjust(
            start, free, self.landmarks["position"][landmarks], observed, links, _ROUNDS, _ITERATIONS
        )
        if self.readout.is_estimated and len(linked) == 0:
            slopes = self._observations["slope"][observations]
            information, gradient = common_parameter(poses, free, points, observed, agree, slopes)
            share = min(window / len(members), 1.0)  # an observation is in as many windows as one has members
            self.readout.learn(share * information, share * gradient)
        for k in movable:
            self.keyframes[k].T_camera_world = poses[np.searchsorted(keyframe_ids, k)].copy()
        self.landmarks["position"][landmarks] = points
        self.landmarks["ray_sigma_m"][landmarks] = updated_ray_sigma_m(
            self.landmarks["ray_sigma_m"][landmarks],
            self.landmarks["direction"][landmarks],
            *(poses, points, edges[agree], measured[agree], weights[agree], intrinsics),
        )
        self._unlink(observations[~agree])

    def _window(self, index: int, window: int) -> list[int]:
        """Return a keyframe and its most covisible ones, and all that share triangulated landmarks with it.

        The positions of these give the landmarks' depths: held fixed, their errors shrink the scale from
        window to window.
        """
        covisible = [k for k, _ in self.covisible(index, min_shared=MIN_SHARED_LANDMARKS)]
        members = [index, *covisible[: window - 1]]
        if len(covisible) >= window:
            ids = self.landmarks_of(index)
            shared = self.shared_counts(ids[self.landmarks["ray_sigma_m"][ids] > 0.0])
            members += [k for k in covisible[window - 1 :] if shared[k] >= MIN_SHARED_LANDMARKS]
        return members[: _MOST_WIDENED * window]

    def bundle(self, keyframes: Sequence[int]) -> Bundle:
        """Return keyframes, given in increasing order, with all their observations and landmarks."""
        landmarks = self.landmarks_of_any(keyframes, except_for=np.empty(0, np.int32))
        first, observations = self._observations_of(landmarks)
        observed_in = self._observations["keyframe"][observations]
        among = np.isin(observed_in, keyframes)
        rows = np.repeat(np.arange(len(landmarks)), np.diff(first))[among]
        edges = np.column_stack([np.searchsorted(keyframes, observed_in[among]), rows]).astype(np.int32)
        first_observation = np.array([self._first_observation[k] for k in keyframes])
        return Bundle(
            poses=np.array([self.keyframes[k].T_camera_world for k in keyframes]),
            points=self.landmarks["position"][landmarks],
            edges=edges,
            features=observations[among] - first_observation[edges[:, 0]],
            measured=self._measured(observations[among]),
            weights=self._observations["weights"][observations[among]],
            intrinsics=self.observation(keyframes[-1]).intrinsics,
        )

    def _measured(self, observations: Ids) -> Array:
        """Return (E, 3) what was measured, by the readout time as it is known now."""
        measured: Array = self._observations["measured"][observations]
        readouts = self._observations["readouts"][observations]
        since = int(readouts.min(initial=len(self._readout_steps_s)))
        if since == len(self._readout_steps_s):
            return measured
        slope = self._observations["slope"][observations]
        for step, by_s in enumerate(self._readout_steps_s[since:], start=since):
            behind = readouts <= step
            measured[behind, :2] += by_s * slope[behind]
        self._observations["measured"][observations] = measured
        self._observations["readouts"][observations] = len(self._readout_steps_s)
        return measured

    def follow_readout(self) -> None:
        """Observe all keyframes' landmarks anew if the readout time has changed."""
        if self.readout.seconds == self._observed_with_s:
            return
        by_s = self.readout.seconds - self._observed_with_s
        self._observed_with_s = self.readout.seconds
        for keyframe in self.keyframes:
            keyframe.sweep_camera = keyframe.sweep_camera + by_s * keyframe.twist_camera
        self._recent.clear()
        self._readout_steps_s.append(by_s)

    def _unlink(self, observations: Ids) -> None:
        ids, times = np.unique(self._observations["landmark"][observations], return_counts=True)
        self._observations["landmark"][observations] = -1
        self._observations["keyframe"][observations] = -1
        self.landmarks["observers"][ids] -= times.astype(np.int32)
        # They are not read any more: zeros, as most landmarks become, make checkpoints small.
        for name in ("measured", "weights", "slope"):
            self._observations[name][observations] = 0.0
        removed = ids[self.landmarks["observers"][ids] == 0]
        for name in ("position", "direction", "bits", "reach_m"):
            self.landmarks[name][removed] = 0

    def cull(self) -> None:
        """Remove new landmarks that no further keyframe observes or that tracking rarely finds.

        Two keyframes after its creation a landmark must have another observer than the one that it was made
        from, or the two if it was triangulated; mismatches and depth errors at object edges rarely get one
        (Mur-Artal, Montiel & Tardós 2015, §VI-B).
        """
        index = len(self.keyframes) - 1
        recent = np.arange(self._first_landmark[max(index - 3, 0)], self._first_landmark[max(index - 1, 0)])
        created_by = 1 + (self.landmarks["ray_sigma_m"][recent] > 0.0)
        unconfirmed = self.landmarks["observers"][recent] <= created_by
        found, visible = self.landmarks["found"][recent], self.landmarks["visible"][recent]
        removed = recent[unconfirmed | (found < _MIN_FOUND_RATIO * visible)].astype(np.int32)
        _, observations = self._observations_of(removed)
        self._unlink(observations)
