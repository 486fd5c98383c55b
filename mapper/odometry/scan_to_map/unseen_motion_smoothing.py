"""Fixed-interval smoothing of the motions that no surface showed, by the velocities before and after."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.deskew import twist_between
from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, Transform, adjoint, exp, inverse
from mapper.core.timebase import NS_PER_S
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import FrameResult
from mapper.odometry.scan_to_map.keyframe_tree import KeyframeTree
from mapper.odometry.scan_to_map.scan_noise import (
    TRUSTED_M,
    TRUSTED_RAD,
    information_of,
    largest_sigmas,
    predicted_motion,
)

_AROUND_S = 1.0
"""Frames so long before and after a stretch show its velocities at both ends, and stretches nearer to each
other are one. Over as long, the log's accelerations are measured: over less they are the poses' noise."""
_WINDOWS, _FEWEST_WINDOWS = 200, 10
_LEAST_DENSITY = 1e-6  # rad²/s³ and m²/s³: keeps a synthetic log of one velocity finite
_MOST_FRAMES = 600  # of a stretch: in a minute a velocity is forgotten


def smooth_unseen_motions(tracks: Sequence[FrameResult]) -> list[FrameResult]:
    """Return the frames with poorly predicted motions estimated from the velocities before and after them.

    Tracking predicts a motion that no surface shows by the velocity before, and at the beginning of a log by
    none. Once the log has ended, the velocity after it is known, too. The acceleration is taken for white
    noise (Anderson & Barfoot 2015), as large as on the log's other frames; the most likely shifts of the
    poses along their unseen motions follow in one linear step. What surfaces show stays as it was tracked:
    smoothed as well, it would fit best where the sensor stands, for noise that turns a pose turns its unseen
    motion, too, and the shorter the way, the smoother the path across it.

    Nothing changes where the log's accelerations are not seen for two seconds anywhere, and in stretches of
    more than a minute at 10 frames a second.

    Args:
        tracks: Results of a log's frames, in time order, with all their factors.
    """
    if all(track.unseen is None for track in tracks):
        return list(tracks)
    path = _Path(tracks)
    density = path.acceleration_density()
    if density is None:
        return list(tracks)
    changes: dict[int, _Smoothed] = {}
    for begin, end in path.stretches():
        if end - begin <= _MOST_FRAMES:
            changes.update(_Stretch(path, begin, end, density).smoothed())
    return path.changed(changes)


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """Pose of a placed frame relative to an earlier one: its node, or for a keyframe the one of its factor.

    Attributes:
        parent: Number of that frame among the placed ones; None if there is none.
        T_parent_body: (4, 4) the pose.
        covariance: (6, 6) of it, in its tangent.
    """

    parent: int | None
    T_parent_body: Transform
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Smoothed:
    """A frame's step, and its doubts that are due to unseen motions."""

    step: _Step
    doubts: tuple[Doubt, ...]


class _Path:
    """The placed frames of a log, numbered in time order.

    Attributes:
        seconds: (N,) since the first.
        T_world_body: (N, 4, 4) poses.
        steps: N of them.
        is_keyframe: Whether each is a keyframe.
        unseen: Unseen motions of each; None if it has none.
        names: Names of these.
    """

    def __init__(self, tracks: Sequence[FrameResult]) -> None:
        self._tracks = tracks
        self._placed = [index for index, track in enumerate(tracks) if track.node is not None]
        placed = [tracks[index] for index in self._placed]
        stamps_ns = np.array([track.stamp_ns for track in placed])
        self.seconds = (stamps_ns - stamps_ns[0]) / NS_PER_S
        self.is_keyframe = [track.is_keyframe for track in placed]
        self.unseen = [track.unseen for track in placed]
        self.names = [track.diagnostics.unobservable for track in placed]
        factors = {factor.j: factor for track in tracks for factor in track.factors}
        numbers = {track.node: number for number, track in enumerate(placed) if track.is_keyframe}
        self.steps: list[_Step] = []
        for track in placed:
            factor = factors.get(track.node) if track.is_keyframe and track.node is not None else None
            if factor is not None:
                covariance = np.asarray(np.linalg.inv(factor.information), np.float64)
                step = _Step(numbers.get(factor.i), factor.T_i_j, covariance)
            elif track.is_keyframe or track.covariance is None:
                step = _Step(None, track.T_world_body, np.zeros((6, 6)))
            else:
                step = _Step(numbers.get(track.node), track.T_node_body, track.covariance)
            self.steps.append(step)
        self.T_world_body = self._chained(self.steps)
        is_shown = np.array([not track.doubts and not track.diagnostics.unobservable for track in placed])
        begins = np.array([step.parent is None for step in self.steps])
        self._interruptions = np.cumsum(~is_shown | begins)

    def velocity(self, begin: int, end: int) -> Array:
        """Return the (6,) mean velocity between two frames, in the tangent of the first: rad/s and m/s."""
        T_world_begin, T_world_end = self.T_world_body[begin], self.T_world_body[end]
        duration_s = float(self.seconds[end] - self.seconds[begin])
        return twist_between(T_world_begin, T_world_end, duration_s=duration_s).vector

    def acceleration_density(self) -> Array | None:
        """Return the (6,) power spectral density of the acceleration on the frames whose motion is all seen.

        Mean velocities over two adjacent intervals t differ by 2/3 t of it.

        Returns:
            rad²/s³ and m²/s³, of an axis at least the mean of the three; None if there are too few such
            frames in a row.
        """
        numbers = np.arange(len(self.seconds))
        middles = np.searchsorted(self.seconds, self.seconds + _AROUND_S)
        ends = np.searchsorted(self.seconds, self.seconds[np.minimum(middles, numbers[-1])] + _AROUND_S)
        whole = np.flatnonzero(ends <= numbers[-1])
        whole = whole[self._interruptions[whole] == self._interruptions[ends[whole]]]
        if len(whole) < _FEWEST_WINDOWS:
            return None
        densities = []
        for begin in whole[np.unique(np.linspace(0, len(whole) - 1, _WINDOWS).astype(int))].tolist():
            middle, end = int(middles[begin]), int(ends[begin])
            change = self.velocity(middle, end) - self.velocity(begin, middle)
            densities.append(change**2 / ((self.seconds[end] - self.seconds[begin]) / 3.0))
        density = np.maximum(np.mean(densities, axis=0), _LEAST_DENSITY)
        means = np.repeat(density.reshape(2, 3).mean(axis=1), 3)
        return np.asarray(np.maximum(density, means), np.float64)

    def stretches(self) -> Iterator[tuple[int, int]]:
        """Yield the first frame of each stretch of unseen motions, and the first one after it."""
        begin: int | None = None
        last = 0
        for number, step in enumerate(self.steps):
            is_far = self.seconds[number] - self.seconds[last] > _AROUND_S
            if begin is not None and (step.parent is None or is_far):
                yield begin, last + 1
                begin = None
            if self.unseen[number] is not None and step.parent is not None:
                begin, last = (number if begin is None else begin), number
        if begin is not None:
            yield begin, last + 1

    def around(self, begin: int, end: int) -> tuple[int, int]:
        """Return a stretch with the frames of the same sub-map around it, as far as a second goes."""
        first, stop, count = begin, end, len(self.steps)
        while self._is_near(first, begin) and self.steps[first - 1].parent is not None:
            first -= 1
        while self._is_near(stop - 1, end - 1) and stop < count and self.steps[stop].parent is not None:
            stop += 1
        return first, stop

    def _is_near(self, one: int, other: int) -> bool:
        return abs(float(self.seconds[one] - self.seconds[other])) < _AROUND_S

    def changed(self, changes: Mapping[int, _Smoothed]) -> list[FrameResult]:
        """Return the results of all frames of the log, with some frames smoothed."""
        results = list(self._tracks)
        if not changes:
            return results
        steps = [changes[k].step if k in changes else step for k, step in enumerate(self.steps)]
        T_world_body, first = self._chained(steps), min(changes)
        factors: dict[int, BetweenFactor] = {}
        tree = KeyframeTree(len(steps))
        for number, (index, step) in enumerate(zip(self._placed, steps, strict=True)):
            track, covariance = self._tracks[index], step.covariance
            parent = None if step.parent is None else self._tracks[self._placed[step.parent]].node
            if parent is None or track.node is None:
                tree.clear()
            elif track.is_keyframe:
                if number in changes:
                    information = information_of(covariance)
                    factors[track.node] = BetweenFactor(parent, track.node, step.T_parent_body, information)
                covariance = tree.add(track.node, parent, T_world_body[number], covariance)
            if number >= first and parent is not None:
                results[index] = replace(
                    track,
                    T_node_body=track.T_node_body if track.is_keyframe else step.T_parent_body,
                    T_world_body=T_world_body[number],
                    doubts=_doubts(track, changes.get(number)),
                    covariance=covariance,
                )
        return [
            replace(result, factors=tuple(factors.get(factor.j, factor) for factor in result.factors))
            for result in results
        ]

    def _chained(self, steps: Sequence[_Step]) -> list[Transform]:
        """Return the (4, 4) poses that steps lead to."""
        poses: list[Transform] = []
        for step in steps:
            T_parent = np.eye(4) if step.parent is None else poses[step.parent]
            poses.append(T_parent @ step.T_parent_body)
        return poses


def _doubts(track: FrameResult, smoothed: _Smoothed | None) -> tuple[Doubt, ...]:
    """Return the doubts about a frame, of which those about unseen motions are as smoothed."""
    if smoothed is None or track.unseen is None:
        return track.doubts
    return (*(doubt for doubt in track.doubts if doubt not in track.unseen.doubts), *smoothed.doubts)


class _Stretch:
    """A stretch of frames with unseen motions, and seen ones around it.

    The unknowns are shifts of each frame's pose relative to its parent: of a frame with unseen motions along
    these, metres; of others around and between them in all six directions of its tangent. A shift of a frame
    moves those that are placed relative to it, too.
    """

    def __init__(self, path: _Path, begin: int, end: int, density: Array) -> None:
        """Set up the equations.

        Args:
            path: All frames.
            begin: First frame of the stretch.
            end: First frame after it.
            density: (6,) power spectral density of the acceleration.
        """
        self._path, self._begin, self._end = path, begin, end
        self._first, self._stop = path.around(begin, end)
        self._unknowns: dict[int, slice] = {}
        count = 0
        for number in range(self._first, self._stop):
            unseen = path.unseen[number]
            size = 6 if unseen is None else len(unseen.motions)
            self._unknowns[number] = slice(count, count + size)
            count += size
        self._shifts = self._shifts_of_poses(count)
        hessian, gradient = self._measured(count), np.zeros(count)
        for number in range(self._first, self._stop - 1):
            rows, misses = self._acceleration(number, density)
            hessian += rows.T @ rows
            gradient += rows.T @ misses
        self._covariance = np.linalg.inv(hessian)
        self._solution = -self._covariance @ gradient

    def smoothed(self) -> dict[int, _Smoothed]:
        """Return the frames with unseen motions, by their numbers."""
        result, inflation = {}, self._inflation()
        for number in range(self._begin, self._end):
            unseen = self._path.unseen[number]
            if unseen is None:
                continue
            step, unknowns = self._path.steps[number], self._unknowns[number]
            shift = unseen.motions.T @ self._solution[unknowns]
            variance = self._covariance[unknowns, unknowns]
            if self._path.is_keyframe[number]:
                variance = inflation * variance
            result[number] = _Smoothed(
                _Step(
                    step.parent,
                    step.T_parent_body @ exp(shift[:3], shift[3:]),
                    unseen.covariance + unseen.motions.T @ variance @ unseen.motions,
                ),
                self._doubts(number),
            )
        return result

    def _shifts_of_poses(self, count: int) -> dict[int, Array]:
        """Return, by frame, the (6, count) shift of its pose in its tangent for each unknown."""
        shifts: dict[int, Array] = {self._first - 1: np.zeros((6, count))}
        for number in range(self._first, self._stop):
            step, unseen = self._path.steps[number], self._path.unseen[number]
            shift = np.zeros((6, count))
            if step.parent is not None and step.parent >= self._first:
                shift = adjoint(inverse(step.T_parent_body)) @ shifts[step.parent]
            shift[:, self._unknowns[number]] += np.eye(6) if unseen is None else unseen.motions.T
            shifts[number] = shift
        return shifts

    def _measured(self, count: int) -> Array:
        """Return the (count, count) information on the unknowns from surfaces."""
        information = np.zeros((count, count))
        for number in range(self._first, self._stop):
            unseen, unknowns = self._path.unseen[number], self._unknowns[number]
            if unseen is None:
                information[unknowns, unknowns] = np.linalg.inv(self._path.steps[number].covariance)
            else:
                information[unknowns, unknowns] = np.diag(unseen.sigmas_m**-2.0)
        return information

    def _acceleration(self, number: int, density: Array) -> tuple[Array, Array]:
        """Return the equations of the acceleration from the way to a frame to the way from it.

        Returns:
            (K, count) Jacobian and (K,) misses in standard deviations: along the unseen motions of both ways,
            or in all directions where both are seen.
        """
        path = self._path
        before_s, after_s = np.diff(path.seconds[number - 1 : number + 2])
        change = path.velocity(number, number + 1) - path.velocity(number - 1, number)
        slope = self._motion(number, number + 1) / after_s - self._motion(number - 1, number) / before_s
        unseen = [ends for ends in path.unseen[number : number + 2] if ends is not None]
        parts = np.vstack([ends.parts for ends in unseen]) if unseen else np.eye(6)
        # Motions that both ways leave open are counted twice, at half the weight.
        variances = np.square(parts) @ density * (0.5 * (before_s + after_s)) * max(1, len(unseen))
        rows = parts / np.sqrt(variances)[:, None]
        return rows @ slope, rows @ change

    def _motion(self, begin: int, end: int) -> Array:
        """Return the (6, count) change of the motion between two frames, in the tangent of the second."""
        T_end_begin = inverse(self._path.T_world_body[end]) @ self._path.T_world_body[begin]
        return self._shifts[end] - adjoint(T_end_begin) @ self._shifts[begin]

    def _inflation(self) -> float:
        """Return the ratio of the variance of the way through the stretch to the sum of its steps' variances.

        An error of the velocity is alike in all steps, and factors of a graph are taken for independent.
        """
        last = number = self._end - 1
        together = self._translation_variance(self._shifts[last])
        apart = 0.0
        while number >= self._first:
            unknowns = self._unknowns[number]
            own = np.zeros_like(self._shifts[last])
            own[:, unknowns] = self._shifts[last][:, unknowns]
            apart += self._translation_variance(own)
            parent = self._path.steps[number].parent
            number = -1 if parent is None else parent
        return max(1.0, together / apart)

    def _translation_variance(self, shift: Array) -> float:
        """Return the variance of a (6, count) shift's translation, m²."""
        return float(np.trace(shift[3:] @ self._covariance @ shift[3:].T))

    def _doubts(self, number: int) -> tuple[Doubt, ...]:
        """Return the doubts about a frame's unseen motions, where the motion of no second at it is known."""
        seconds = self._path.seconds
        before = int(np.searchsorted(seconds, seconds[number] - _AROUND_S, side="right")) - 1
        after = int(np.searchsorted(seconds, seconds[number] + _AROUND_S))
        ways = [(before, number)] if before >= self._first - 1 else []
        ways += [(number, after)] if after < self._stop else []
        sigmas = [self._sigmas(*way) for way in ways or [(self._first - 1, self._stop - 1)]]
        if any(rad <= TRUSTED_RAD and m <= TRUSTED_M for rad, m in sigmas):
            return ()
        rad, m = min(sigmas, key=lambda sigma: sigma[1])
        return (predicted_motion(self._path.names[number], rad, m),)

    def _sigmas(self, begin: int, end: int) -> tuple[float, float]:
        """Return the largest standard deviations of the motion between two frames: rad and m."""
        motion = self._motion(begin, end)
        rad, m = largest_sigmas(motion @ self._covariance @ motion.T).tolist()
        return rad, m
