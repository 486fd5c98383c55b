"""Inertial readings of the body: angular velocities and accelerations at the same times."""

from dataclasses import dataclass, replace

import numpy as np

from mapper.core.geometry import Array
from mapper.core.rotations import rotation_from_quaternion
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
_ITERATIONS = 5


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
        """Return whether readings cover the time between two times, without a gap."""
        first = int(np.searchsorted(self.stamps_ns, begin_ns, side="right")) - 1
        last = int(np.searchsorted(self.stamps_ns, end_ns))
        if first < 0 or last >= len(self.stamps_ns):
            return False
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
        lever = self._lever_turns()
        place_m = self._lever_arm_m(stamps_ns, T_world_body, lever)
        if not place_m.any():
            return self
        return replace(self, accelerations_mps2=self.accelerations_mps2 - lever @ place_m)

    def _lever_turns(self) -> Array:
        """Return (N, 3, 3) what a lever arm is multiplied by: [α]× + [ω]×²."""
        x, y, z = self.rates_radps.T
        ax, ay, az = np.gradient(self.rates_radps, self._times_s, axis=0).T
        rows = [
            [-y * y - z * z, x * y - az, x * z + ay],
            [x * y + az, -x * x - z * z, y * z - ax],
            [x * z - ay, y * z + ax, -x * x - y * y],
        ]
        return np.array(rows).transpose(2, 0, 1)

    @property
    def _times_s(self) -> Array:
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) / NS_PER_S, np.float64)

    def _lever_arm_m(self, stamps_ns: Stamps, T_world_body: Array, lever: Array) -> Array:
        times_s, poses_s = self._times_s, (stamps_ns - self.stamps_ns[0]) / NS_PER_S
        after = np.clip(np.searchsorted(poses_s, times_s), 1, len(poses_s) - 1)
        nearest = np.where(poses_s[after] - times_s < times_s - poses_s[after - 1], after, after - 1)
        turned = self.rates_radps * (times_s - poses_s[nearest])[:, None]
        R_world_body = T_world_body[nearest, :3, :3] @ _rotations(turned)
        felt = np.einsum("nij,nj->ni", R_world_body, self.accelerations_mps2)
        turns, positions = R_world_body @ lever, T_world_body[:, :3, 3]
        rows, values = [], []
        for k in range(0, len(poses_s), max(1, len(poses_s) // _MOST_TRIPLES)):
            begin, end = np.searchsorted(poses_s, [poses_s[k] - _HALF_S, poses_s[k] + _HALF_S])
            if end >= len(poses_s):
                break
            before_s, after_s = poses_s[k] - poses_s[begin], poses_s[end] - poses_s[k]
            if min(before_s, after_s) < 0.5 * _HALF_S or max(before_s, after_s) > 2.0 * _HALF_S:
                continue
            s = slice(*np.searchsorted(times_s, [poses_s[begin], poses_s[end]]))
            rising, falling = (times_s[s] - poses_s[begin]) / before_s, (poses_s[end] - times_s[s]) / after_s
            weights = np.minimum(rising, falling) * np.gradient(times_s[s])
            weighted = [np.einsum("n,nij->ij", weights, one[s]) for one in (R_world_body, turns)]
            rows.append(np.hstack([weights.sum() * np.eye(3), -weighted[0], -weighted[1]]))
            moved = (positions[end] - positions[k]) / after_s - (positions[k] - positions[begin]) / before_s
            values.append(moved - weights @ felt[s])
        if len(rows) < _FEWEST_TRIPLES:
            return np.zeros(3)
        A, b = np.vstack(rows), np.concatenate(values)
        prior, weight, sigma = (
            np.diag(np.repeat([0.0, _BIAS_MPS2**-2.0, _PLACE_M**-2.0], 3)),
            np.ones(len(b)),
            1.0,
        )
        for _ in range(_ITERATIONS):
            information = A.T @ (A * (weight / sigma**2)[:, None]) + prior
            found = np.linalg.solve(information, A.T @ (b * weight) / sigma**2)
            off = np.abs(b - A @ found)
            sigma = max(SIGMAS_PER_MAD * float(np.median(off)), 1e-4)
            weight = np.minimum(1.0, 2.0 * sigma / np.maximum(off, 1e-12))
        place_m = np.asarray(found[6:], np.float64)
        covariance = np.linalg.inv(information)[6:, 6:]
        is_certain = place_m @ np.linalg.solve(covariance, place_m) > _CERTAIN_CHI2
        return place_m if is_certain else np.zeros(3)

    def _at(self, values: Array, stamp_ns: int) -> Array:
        after = min(max(int(np.searchsorted(self.stamps_ns, stamp_ns)), 1), len(values) - 1)
        begin_ns, end_ns = self.stamps_ns[after - 1 : after + 1].tolist()
        share = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        interpolated: Array = (1.0 - share) * values[after - 1] + share * values[after]
        return interpolated

    def _density(self, values: Array) -> float:
        """Return the noise of readings by their second differences, which motion hardly changes."""
        seconds = float(np.median(np.diff(self.stamps_ns))) / NS_PER_S
        sigma = SIGMAS_PER_MAD * float(np.median(np.abs(np.diff(values, n=2, axis=0)))) / np.sqrt(6.0)
        return float(sigma * np.sqrt(seconds))


def _rotations(vectors: Array) -> Array:
    """Return the (N, 3, 3) rotations of (N, 3) short rotation vectors."""
    half = 0.5 * vectors
    w = np.sqrt(np.maximum(1.0 - (half**2).sum(axis=1), 0.0))
    return rotation_from_quaternion(np.column_stack([half, w]))
