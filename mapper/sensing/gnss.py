"""Fixes of a GNSS receiver: where they are, how accurate they say they are, and what is wrong with them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapper.core.geodesy import ecef_from_geodetic
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S, Stamps

NO_FIX = -1
"""Status of a message without a position; 0 is a fix, 1 one with satellite-based, 2 with ground-based
augmentation (sensor_msgs/NavSatStatus)."""
STATUS_NAMES = {0: "without augmentation", 1: "with SBAS", 2: "differential or RTK"}
_LARGEST_SIGMA_M = 1e4
"""A receiver that is farther off does not know where it is; some write such covariances instead of none."""
_FASTEST_MPS = 50.0
"""Of a vehicle with a sensor that maps."""
_JUMP_SIGMAS = 5.0
_DEGREE = np.pi / 180.0


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes:
    """Positions of an antenna on WGS 84.

    Attributes:
        name: Topic, file or folder.
        stamps_ns: (N,) int64 nanoseconds, strictly increasing.
        geodetic: (N, 3) latitude and longitude in degrees, metres above the ellipsoid.
        covariances_enu: (N, 3, 3) of east, north and up, m²; NaN where the receiver states none.
        status: (N,) int8 as of ``NO_FIX``.
        antenna_body: (3,) position of the antenna in the body, metres; None if the log does not state it.
    """

    name: str
    stamps_ns: Stamps
    geodetic: Array
    covariances_enu: Array
    status: NDArray[np.int8]
    antenna_body: Array | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def sigmas_m(self) -> Array:
        """(N,) horizontal standard deviation of each fix, the mean of both axes; NaN where none is stated."""
        variances = self.covariances_enu.diagonal(axis1=1, axis2=2)
        sigmas: Array = np.sqrt(variances[:, :2].mean(axis=1))
        return sigmas

    @property
    def median_sigma_m(self) -> float | None:
        """Median of ``sigmas_m``; None where no fix states any."""
        known = self.sigmas_m[np.isfinite(self.sigmas_m)]
        return float(np.median(known)) if len(known) else None

    @property
    def status_text(self) -> str:
        """Number of fixes of each status, as text."""
        counts = {name: int((self.status == status).sum()) for status, name in STATUS_NAMES.items()}
        return ", ".join(f"{count} {name}" for name, count in counts.items() if count)

    def of(self, kept: NDArray[np.bool_] | NDArray[np.intp]) -> "GnssFixes":
        """Return some of the fixes, by (N,) flags or by their indices."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[kept],
            geodetic=self.geodetic[kept],
            covariances_enu=self.covariances_enu[kept],
            status=self.status[kept],
        )

    def without_invalid(self) -> tuple["GnssFixes | None", list[str]]:
        """Return the messages with a position, None if there are none, and notes on the others and on jumps.

        A covariance that is zero, not positive or absurd becomes NaN: none is stated.
        """
        notes = []
        latitude, longitude, height_m = self.geodetic.T
        with np.errstate(invalid="ignore"):
            is_place = ((np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 360.0) & np.isfinite(height_m)) & (
                (latitude != 0.0) | (longitude != 0.0)
            )
        has_fix = self.status > NO_FIX
        for count, what in (
            (int((~has_fix).sum()), "have the status of no fix"),
            (int((has_fix & ~is_place).sum()), "have no place (NaN, zeros, or no degrees)"),
        ):
            if count:
                notes.append(f"{self.name}: {count} of {len(self)} messages {what}; left out")
        kept = self.of(has_fix & is_place)
        if not len(kept):
            return None, [*notes, f"{self.name}: no fixes"]
        known = _are_covariances(kept.covariances_enu)
        if unknown := int((~known).sum()):
            notes.append(
                f"{self.name}: {unknown} of {len(kept)} fixes state no covariance, or an impossible one"
            )
        kept = replace(kept, covariances_enu=np.where(known[:, None, None], kept.covariances_enu, np.nan))
        if jumps := kept.jumps():
            notes.append(
                f"{self.name}: {len(jumps)} jumps between consecutive fixes, the largest of "
                f"{max(jumps):.1f} m (beyond {_FASTEST_MPS:g} m/s and {_JUMP_SIGMAS:g} σ)"
            )
        return kept, notes

    def in_degrees(self, stamps_ns: Stamps, positions: Array) -> "GnssFixes":
        """Return the fixes in degrees: those π/180 times as spread as a path are in radians.

        Args:
            stamps_ns: (N,) times of the path.
            positions: (N, 3) positions then, metres, whatever their frame.
        """
        since_s, at_s = ((ns - stamps_ns[0]) / NS_PER_S for ns in (stamps_ns, self.stamps_ns))
        beside = (at_s >= 0.0) & (at_s <= since_s[-1])
        if not beside.any() or (np.abs(self.geodetic[:, :2]) > [0.5 * np.pi, np.pi]).any():
            return self
        path_m = np.column_stack([np.interp(at_s[beside], since_s, column) for column in positions.T])
        fixes_m = ecef_from_geodetic(self.geodetic[beside] * [1.0, 1.0, 0.0])
        if fixes_m.std(axis=0).max() >= np.sqrt(_DEGREE) * path_m.std(axis=0).max():
            return self
        degrees = self.geodetic / [_DEGREE, _DEGREE, 1.0]
        return replace(self, name=f"{self.name} (in radians, as its path is)", geodetic=degrees)

    def jumps(self) -> list[float]:
        """Return the lengths of steps between consecutive fixes that no motion explains, metres."""
        steps_m = np.linalg.norm(np.diff(ecef_from_geodetic(self.geodetic), axis=0), axis=1)
        variances = np.nan_to_num(self.covariances_enu).trace(axis1=1, axis2=2)
        apart_s = np.diff(self.stamps_ns) / NS_PER_S
        limits_m = _FASTEST_MPS * apart_s + _JUMP_SIGMAS * np.sqrt(variances[:-1] + variances[1:])
        jumped: list[float] = steps_m[steps_m > limits_m].tolist()
        return jumped


def _are_covariances(covariances: Array) -> NDArray[np.bool_]:
    """Return which of (N, 3, 3) matrices are positive definite and not absurdly large."""
    finite = np.where(np.isfinite(covariances), covariances, 0.0)  # a row of zeros is not definite
    variances = np.linalg.eigvalsh(0.5 * (finite + finite.transpose(0, 2, 1)))
    is_known: NDArray[np.bool_] = variances[:, 0] > 0.0
    return is_known & (variances[:, 2] < _LARGEST_SIGMA_M**2)
