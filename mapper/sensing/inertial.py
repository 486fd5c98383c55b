"""Inertial readings of the body: angular velocities and accelerations at the same times."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.geometry import Array
from mapper.core.rotations import right_angled_frames, rotation_from_quaternion
from mapper.core.running_median import SIGMAS_PER_MAD
from mapper.core.timebase import NS_PER_S, Stamps

_LEAST_RATE_DENSITY, _LEAST_ACCELERATION_DENSITY = 5e-4, 1e-3
"""rad/s/√Hz and m/s²/√Hz: better ones are those of larger units than robots carry."""

_HALF_S, _MOST_TRIPLES, _FEWEST_TRIPLES = 0.4, 2000, 20
"""Time between the poses of a triple: the error of poses by its square is that of an acceleration."""
_PLACE_M, _BIAS_MPS2 = 0.1, 0.3
"""Prior standard deviations of a unit's distance from the body's origin, and of its bias."""
_CERTAIN_CHI2 = 16.3
"""99.9 % of χ² with three degrees of freedom."""
_TURN_S = 0.02  # on either side: of single readings the angular acceleration would be noise
_ITERATIONS = 5
_CLEARLY = 0.5
"""Share of what others leave that the right axes of an accelerometer leave at most."""
_UNEXPLAINED = 0.5
"""Median of what accelerations leave of the path's changes of velocity, relative to theirs, that is too much:
of a sensor that hardly moves, errors of the poses would be taken for the motion."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialReadings:
    """Angular velocities and accelerations of the body, in its axes and the frames' clock.

    Attributes:
        stamps_ns: (N,) increasing times.
        rates_radps: (N, 3).
        accelerations_mps2: (N, 3) specific force: it points up at rest.
        gap_ns: Time between two readings beyond which the motion between them is unknown.
    """

    stamps_ns: Stamps
    rates_radps: Array
    accelerations_mps2: Array
    gap_ns: int

    @property
    def rate_density(self) -> float:
        """Noise of the angular velocities, rad/s/√Hz."""
        return max(self._density(self.rates_radps), _LEAST_RATE_DENSITY)

    @property
    def acceleration_density(self) -> float:
        """Noise of the accelerations, m/s²/√Hz."""
        return max(self._density(self.accelerations_mps2), _LEAST_ACCELERATION_DENSITY)

    def covers(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether readings cover the time between two times, without a gap: half of one at an end."""
        reach_ns = self.gap_ns // 2
        if begin_ns < self.stamps_ns[0] - reach_ns or end_ns > self.stamps_ns[-1] + reach_ns:
            return False
        first = max(int(np.searchsorted(self.stamps_ns, begin_ns, side="right")) - 1, 0)
        last = int(np.searchsorted(self.stamps_ns, end_ns))
        return bool((np.diff(self.stamps_ns[first : last + 1]) <= self.gap_ns).all())

    def between(self, begin_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
        """Return (M, 3) mean angular velocities and accelerations of the pieces between, and (M,) seconds."""
        first = int(np.searchsorted(self.stamps_ns, begin_ns, side="right"))
        last = int(np.searchsorted(self.stamps_ns, end_ns))
        inner = self.stamps_ns[first:last]
        knots_ns = np.concatenate([[begin_ns], inner, [end_ns]])
        means = []
        for values in (self.rates_radps, self.accelerations_mps2):
            ends = [self._at(values, begin_ns), self._at(values, end_ns)]
            at = np.vstack([ends[0], values[first:last], ends[1]])
            means.append(0.5 * (at[1:] + at[:-1]))
        return means[0], means[1], np.diff(knots_ns) / NS_PER_S

    def at_body(self, stamps_ns: Stamps, T_world_body: Array) -> "InertialReadings":
        """Return the readings as of a unit at the body's origin.

        A unit beside it feels αr + ω×(ω×r) more. Its place r is the one for which the double integrals of the
        accelerations agree best with triples of poses, by least squares together with bias and gravity; it
        is taken for the origin unless the path shows otherwise for certain.

        Args:
            stamps_ns: (M,) increasing times.
            T_world_body: (M, 4, 4) poses then, in one world.
        """
        triples = self._triples(stamps_ns, T_world_body)
        if triples is None:
            return self
        found, covariance = _fit(triples.columns, triples.moved_mps - triples.felt_mps)
        place_m = found[-3:]
        if place_m @ np.linalg.solve(covariance[-3:, -3:], place_m) <= _CERTAIN_CHI2:
            return self
        return self.moved_from(place_m)

    def moved_from(self, place_m: Array) -> "InertialReadings":
        """Return the readings of a unit at (3,) a place in the body, metres, as of one at its origin."""
        return replace(self, accelerations_mps2=self.accelerations_mps2 - self._lever_turns() @ place_m)

    def path_scale(self, stamps_ns: Stamps, T_world_body: Array) -> tuple[float, float] | None:
        """Return the ratio of a path's lengths to metres by accelerations, and its standard deviation.

        It is negative where the accelerations point down at rest: gravity cannot be told from its opposite,
        but changes of velocity can. None with too few poses, or where accelerations explain less than half of
        these changes.

        Args:
            stamps_ns: (M,) increasing times.
            T_world_body: (M, 4, 4) poses then, in one world; what no surface shows must not be among them.
        """
        triples = self._triples(stamps_ns, T_world_body)
        if triples is None:
            return None
        found, covariance = _fit(np.column_stack([triples.felt_mps, triples.columns]), triples.moved_mps)
        left_mps = triples.moved_mps - triples.felt_mps * found[0] - triples.columns @ found[1:]
        if np.median(np.abs(left_mps)) >= _UNEXPLAINED * np.median(np.abs(triples.moved_mps)):
            return None  # nothing is explained where nothing moved, either
        return float(found[0]), float(np.sqrt(covariance[0, 0]))

    def felt_axes(
        self, R_body_unit: Array, stamps_ns: Stamps, T_world_body: Array, *, are_stated: bool
    ) -> Array | None:
        """Return what (3, 3) the accelerometer's axes are in those of the gyroscope, but for their sign.

        Of all right-angled ones those under which accelerations agree best with the path, by the least
        squares of ``at_body``: with others gravity turns with the body. None where others agree as well.

        Args:
            R_body_unit: (3, 3) mounting by which the accelerations became the body's.
            stamps_ns: (M,) increasing times.
            T_world_body: (M, 4, 4) poses then, in one world.
            are_stated: Whether both have the same axes unless the path shows otherwise.
        """
        triples = self._triples(stamps_ns, T_world_body)
        if triples is None:
            return np.eye(3) if are_stated else None
        costs = []
        for axes in right_angled_frames():
            if np.linalg.det(axes) < 0.0:
                continue
            felt_mps = np.einsum("njk,jk->n", triples.felt_by_axes, R_body_unit @ axes @ R_body_unit.T)
            left = []
            for opposite in (1.0, -1.0):
                off_mps = triples.moved_mps - opposite * felt_mps
                left.append(np.median(np.abs(off_mps - triples.columns @ _fit(triples.columns, off_mps)[0])))
            costs.append((float(min(left)), axes))
        costs.sort(key=lambda one: one[0])
        (least, best), stated = costs[0], next(cost for cost, axes in costs if np.trace(axes) == 3.0)
        if are_stated and least >= _CLEARLY * stated:
            return np.eye(3)
        return best if least < _CLEARLY * costs[1][0] else None

    def _lever_turns(self) -> Array:
        """Return (N, 3, 3) what a lever arm is multiplied by: [α]× + [ω]×²."""
        x, y, z = self.rates_radps.T
        times_s = self._times_s
        first = np.searchsorted(times_s, times_s - _TURN_S)
        last = np.searchsorted(times_s, times_s + _TURN_S, side="right") - 1
        turned = self.rates_radps[last] - self.rates_radps[first]
        ax, ay, az = (turned / np.maximum(times_s[last] - times_s[first], _TURN_S)[:, None]).T
        rows = [
            [-y * y - z * z, x * y - az, x * z + ay],
            [x * y + az, -x * x - z * z, y * z - ax],
            [x * z - ay, y * z + ax, -x * x - y * y],
        ]
        return np.array(rows).transpose(2, 0, 1)

    @property
    def _times_s(self) -> Array:
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) / NS_PER_S, np.float64)

    def _triples(self, stamps_ns: Stamps, T_world_body: Array) -> "_Triples | None":
        times_s, poses_s = self._times_s, (stamps_ns - self.stamps_ns[0]) / NS_PER_S
        if len(poses_s) < _FEWEST_TRIPLES:
            return None
        after = np.clip(np.searchsorted(poses_s, times_s), 1, len(poses_s) - 1)
        nearest = np.where(poses_s[after] - times_s < times_s - poses_s[after - 1], after, after - 1)
        turned = self.rates_radps * (times_s - poses_s[nearest])[:, None]
        R_world_body = T_world_body[nearest, :3, :3] @ _rotations(turned)
        turns, positions = R_world_body @ self._lever_turns(), T_world_body[:, :3, 3]
        columns, felts, moves = [], [], []
        for k in range(0, len(poses_s), max(1, len(poses_s) // _MOST_TRIPLES)):
            begin, end = np.searchsorted(poses_s, [poses_s[k] - _HALF_S, poses_s[k] + _HALF_S])
            if end >= len(poses_s):
                break
            before_s, after_s = poses_s[k] - poses_s[begin], poses_s[end] - poses_s[k]
            if min(before_s, after_s) < 0.5 * _HALF_S or max(before_s, after_s) > 2.0 * _HALF_S:
                continue
            if not self.covers(int(stamps_ns[begin]), int(stamps_ns[end])):
                continue
            s = slice(*np.searchsorted(times_s, [poses_s[begin], poses_s[end]]))
            rising, falling = (times_s[s] - poses_s[begin]) / before_s, (poses_s[end] - times_s[s]) / after_s
            weights = np.minimum(rising, falling) * np.gradient(times_s[s])
            weighted = [np.einsum("n,nij->ij", weights, one[s]) for one in (R_world_body, turns)]
            columns.append(np.hstack([weights.sum() * np.eye(3), -weighted[0], -weighted[1]]))
            felts.append(np.einsum("n,nij,nk->ijk", weights, R_world_body[s], self.accelerations_mps2[s]))
            moves.append(
                (positions[end] - positions[k]) / after_s - (positions[k] - positions[begin]) / before_s
            )
        if len(columns) < _FEWEST_TRIPLES:
            return None
        return _Triples(np.vstack(columns), np.concatenate(felts), np.concatenate(moves))

    def _at(self, values: Array, stamp_ns: int) -> Array:
        after = min(max(int(np.searchsorted(self.stamps_ns, stamp_ns)), 1), len(values) - 1)
        begin_ns, end_ns = self.stamps_ns[after - 1 : after + 1].tolist()
        share = min(max((stamp_ns - begin_ns) / (end_ns - begin_ns), 0.0), 1.0)
        interpolated: Array = (1.0 - share) * values[after - 1] + share * values[after]
        return interpolated

    def _density(self, values: Array) -> float:
        """Return the noise of readings by their second differences, which motion hardly changes."""
        seconds = float(np.median(np.diff(self.stamps_ns))) / NS_PER_S
        sigma = SIGMAS_PER_MAD * float(np.median(np.abs(np.diff(values, n=2, axis=0)))) / np.sqrt(6.0)
        return float(sigma * np.sqrt(seconds))


@dataclass(frozen=True, slots=True, eq=False)
class _Triples:
    """Triples of poses: changes of the mean velocity before the middle one to that after it.

    Attributes:
        columns: (3 T, 9) what gravity, the accelerations' bias and the unit's place add to them.
        felt_by_axes: (3 T, 3, 3) by double integrals of the accelerations: what each of these adds, by the
            axis of the body along which it is taken.
        moved_mps: (3 T,) by the poses.
    """

    columns: Array
    felt_by_axes: Array
    moved_mps: Array

    @property
    def felt_mps(self) -> Array:
        """(3 T,) by double integrals of the accelerations."""
        return np.asarray(np.einsum("njj->n", self.felt_by_axes))


def _fit(A: Array, b: Array) -> tuple[Array, Array]:
    """Return x of A x = b by Huber's kernel and its covariance; the last six columns are bias and place."""
    precisions = np.zeros(A.shape[1])
    precisions[-6:] = np.repeat([_BIAS_MPS2**-2.0, _PLACE_M**-2.0], 3)
    weight, sigma = np.ones(len(b)), 1.0
    for _ in range(_ITERATIONS):
        information = A.T @ (A * (weight / sigma**2)[:, None]) + np.diag(precisions)
        covariance = np.linalg.pinv(information, hermitian=True)  # of a still log it is singular
        found = covariance @ (A.T @ (b * weight)) / sigma**2
        off = np.abs(b - A @ found)
        sigma = max(SIGMAS_PER_MAD * float(np.median(off)), 1e-4)
        weight = np.minimum(1.0, 2.0 * sigma / np.maximum(off, 1e-12))
    return np.asarray(found, np.float64), np.asarray(covariance, np.float64)


def _rotations(vectors: Array) -> Array:
    """Return the (N, 3, 3) rotations of (N, 3) short rotation vectors."""
    half = 0.5 * vectors
    w = np.sqrt(np.maximum(1.0 - (half**2).sum(axis=1), 0.0))
    return rotation_from_quaternion(np.column_stack([half, w]))
