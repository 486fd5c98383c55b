"""Normals of points whose neighbours lie on one scan line, from the scan lines beside it.

Such neighbours leave open how the surface is turned about their line. The range's noise spreads them along
the beams, so that the plane through them contains the sensor: a wall gets the normal of a floor, and the
ground a slope towards the sensor, alike all around. The next scan lines, searched by their directions from
the sensor, show the surface; behind a pole or a wire they do not continue it, and its normal stays.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array

_LINE = 12.0
"""Ratio of the two largest variances of a point's neighbours, from which on they lie on a line."""
_FIRST_RAD = 0.025
"""Angle at which the next scan line is searched first, to within half of it; then at twice and at four times
this angle. Scan lines nearer than that lie among the nearest points."""
_SEARCHES = 3
_SECOND_SHARE = 0.4  # of the angle to it within which the line after the next lies; half would find the next
_FARTHEST = 0.5  # lines farther from the point than this part of its range tell nothing about its surface
_STRAIGHT = 0.9  # least cosine of a surface's bend from one line to the next, 26 degrees, with it between
_STRAIGHT_BESIDE = 0.95  # 18 degrees, where both lines are on one side, as at the end of a wall
_ALONG_BEAM = 0.1  # least sine of the angle between a beam and a line that was scanned across it
_SQUARINGS = 3  # of a covariance: its second axis is left with a part of _LINE⁻⁸
_CELL = 0.05  # edge of the cells that beams are sorted into, about the angles that are searched
_CELLS = 48  # along each axis, from -_EDGE: they hold all unit vectors
_EDGE = 1.2


def fit_across_lines(
    points: Array, about: NDArray[np.int64], elongation: Array, origin: Array, normals: Array, breadth: Array
) -> None:
    """Replace the normals of points on scan lines, and the breadths of their planes.

    Args:
        points: (N, 3).
        about: (N, K) numbers of the points nearest to each.
        elongation: (N,) ratio of the two largest variances of these.
        origin: (3,) where the beams begin, metres.
        normals: (N, 3) is changed.
        breadth: (N,) is changed.
    """
    numbers = np.flatnonzero(elongation > _LINE)
    if len(numbers) == 0:
        return
    beams = points - origin
    ranges_m = np.sqrt(_dots(beams, beams))
    beams /= np.maximum(ranges_m, np.finfo(float).tiny)[:, None]
    lines = _ScanLines(points, beams, about, numbers, _FARTHEST * ranges_m[numbers])
    one, other = lines.next_lines(1.0), lines.next_lines(-1.0)
    way = one.offsets_m - other.offsets_m
    off = one.offsets_m.copy()
    is_known = one.found & other.found & _is_straight(one.offsets_m, -other.offsets_m, _STRAIGHT)
    for sign, beside in ((1.0, one), (-1.0, other)):
        after = lines.lines_after(beside, sign, beside.found & ~is_known)
        beyond_m = after.offsets_m - beside.offsets_m
        goes_on = after.found & _is_straight(beside.offsets_m, beyond_m, _STRAIGHT_BESIDE)
        way[goes_on], off[goes_on] = after.offsets_m[goes_on], beside.offsets_m[goes_on]
        is_known |= goes_on
    across = np.cross(way, lines.along)
    lengths = np.sqrt(_dots(across, across))
    is_known &= lengths > 0.0
    kept = numbers[is_known]
    across = across[is_known] / lengths[is_known, None]
    across *= np.where(_dots(across, points[kept]) > 0.0, -1.0, 1.0)[:, None]
    normals[kept] = across
    apart = 0.25 * _dots(way, way)[is_known]
    off_plane = _dots(across, off[is_known]) ** 2 + lines.variances[is_known] / about.shape[1]
    breadth[kept] = np.maximum(1.0, apart / np.maximum(off_plane, np.finfo(float).tiny))


@dataclass(frozen=True, slots=True, eq=False)
class _LinesBeside:
    """Scan lines beside those of some points.

    Attributes:
        found: (L,) whether there is one.
        offsets_m: (L, 3) from the point's line to it, at right angles.
        angles: (L,) between them, as the sensor sees them, radians.
    """

    found: NDArray[np.bool_]
    offsets_m: Array
    angles: Array


class _ScanLines:
    """Lines on which points lie with those about them.

    Attributes:
        along: (L, 3) their directions.
        variances: (L,) across them, square metres.
    """

    def __init__(
        self,
        points: Array,
        beams: Array,
        about: NDArray[np.int64],
        numbers: NDArray[np.intp],
        farthest_m: Array,
    ) -> None:
        """Find the lines.

        Args:
            points: (N, 3).
            beams: (N, 3) their directions from the sensor.
            about: (N, K) numbers of the points nearest to each.
            numbers: (L,) of the points on lines.
            farthest_m: (L,) largest distance of the lines beside them.
        """
        self._points, self._beams, self._sorted = points, beams, _sorted_by_cell(beams)
        self._own, self._farthest_m = beams[numbers], farthest_m
        self._centres, self.along, self.variances = _fitted(points, about, numbers)
        across = np.cross(self._own, self.along)
        sines = np.sqrt(_dots(across, across))
        self._is_across = sines > _ALONG_BEAM
        self._across = across / np.maximum(sines, _ALONG_BEAM)[:, None]

    def next_lines(self, sign: float) -> _LinesBeside:
        """Return the next scan lines on one side, at the first angle at which there is one."""
        numbers, angle = np.full(len(self._own), -1), _FIRST_RAD
        for _ in range(_SEARCHES):
            open_ones = np.flatnonzero(self._is_across & (numbers < 0))
            numbers[open_ones] = self._nearest(open_ones, sign * angle, 0.5 * angle)
            angle *= 2.0
        return self._beside(numbers, sign)

    def lines_after(self, beside: _LinesBeside, sign: float, wanted: NDArray[np.bool_]) -> _LinesBeside:
        """Return the scan lines after the next ones on a side, of some points."""
        numbers, ones = np.full(len(self._own), -1), np.flatnonzero(wanted)
        angles = 2.0 * beside.angles[ones]
        numbers[ones] = self._nearest(ones, sign * angles, _SECOND_SHARE * angles)
        return self._beside(numbers, sign)

    def _nearest(
        self, ones: NDArray[np.intp], angles: Array | float, within: Array | float
    ) -> NDArray[np.int64]:
        """Return the points whose beams are nearest to directions beside some lines; -1 if none is near."""
        queries = self._own[ones] + np.reshape(angles, (-1, 1)) * self._across[ones]
        found: NDArray[np.int64] = _nearest_within(
            *self._sorted, queries, np.broadcast_to(np.asarray(within, np.float64), len(ones))
        )
        return found

    def _beside(self, numbers: NDArray[np.int64], sign: float) -> _LinesBeside:
        """Return where scan lines lie by one point of each; -1 is none."""
        offsets_m = self._points[numbers] - self._centres
        offsets_m -= _dots(offsets_m, self.along)[:, None] * self.along
        angles = sign * _dots(self._beams[numbers] - self._own, self._across)
        found = (numbers >= 0) & (_dots(offsets_m, offsets_m) <= self._farthest_m**2)
        return _LinesBeside(found, offsets_m, angles)


def _dots(one: Array, other: Array) -> Array:
    """Return the (N,) products of (N, 3) vectors."""
    products: Array = np.einsum("ni,ni->n", one, other)
    return products


def _is_straight(one: Array, other: Array, cosine: float) -> NDArray[np.bool_]:
    """Return (N,) whether (N, 3) vectors differ by less than an angle of this cosine."""
    return np.asarray(_dots(one, other) > cosine * np.sqrt(_dots(one, one) * _dots(other, other)))


@njit(cache=True, nogil=True)
def _sorted_by_cell(beams):  # type: ignore[no-untyped-def]
    """Return unit vectors in the order of their cells, their numbers, and where each cell begins."""
    begins = np.zeros(_CELLS**3 + 1, np.int64)
    cells = np.empty(len(beams), np.int64)
    for i in range(len(beams)):
        cell = 0
        for k in range(3):
            cell = cell * _CELLS + int((beams[i, k] + _EDGE) / _CELL)
        cells[i] = cell
        begins[cell + 1] += 1
    for cell in range(_CELLS**3):
        begins[cell + 1] += begins[cell]
    ends = begins.copy()
    ordered, order = np.empty_like(beams), np.empty(len(beams), np.int64)
    for i in range(len(beams)):
        at = ends[cells[i]]
        ends[cells[i]] += 1
        order[at] = i
        for k in range(3):
            ordered[at, k] = beams[i, k]
    return ordered, order, begins


@njit(cache=True, nogil=True)
def _nearest_within(beams, order, begins, queries, limits):  # type: ignore[no-untyped-def]
    """Return the (Q,) numbers of the beams nearest to directions; -1 if none is within a distance."""
    found = np.full(len(queries), -1)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for q in range(len(queries)):
        least = limits[q] * limits[q]
        for k in range(3):
            low[k] = max(int((queries[q, k] - limits[q] + _EDGE) / _CELL), 0)
            high[k] = min(int((queries[q, k] + limits[q] + _EDGE) / _CELL), _CELLS - 1)
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                column = (x * _CELLS + y) * _CELLS
                for i in range(begins[column + low[2]], begins[column + high[2] + 1]):
                    squared = 0.0
                    for k in range(3):
                        squared += (beams[i, k] - queries[q, k]) ** 2
                    if squared < least:
                        least, found[q] = squared, order[i]
    return found


@njit(cache=True, nogil=True)
def _fitted(points, about, numbers):  # type: ignore[no-untyped-def]
    """Return the centres and the directions of lines through points, and the variances across them."""
    centres, along, variances = (
        np.empty((len(numbers), 3)),
        np.empty((len(numbers), 3)),
        np.empty(len(numbers)),
    )
    for n in range(len(numbers)):
        variances[n] = _line(points, about, numbers[n], centres[n], along[n])
    return centres, along, variances


@njit(cache=True, nogil=True)
def _line(points, about, i, centre, along):  # type: ignore[no-untyped-def]
    """Fill in the centre and the direction of the line through a point; return the variance across it."""
    count = about.shape[1]
    for k in range(3):
        centre[k] = 0.0
        for j in about[i]:
            centre[k] += points[j, k] / count
    xx = xy = xz = yy = yz = zz = 0.0
    for j in about[i]:
        x, y, z = points[j, 0] - centre[0], points[j, 1] - centre[1], points[j, 2] - centre[2]
        xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
        yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
    total = xx + yy + zz
    a, b, c, d, e, f = xx / total, xy / total, xz / total, yy / total, yz / total, zz / total
    for _ in range(_SQUARINGS):
        a, b, c, d, e, f = (
            a * a + b * b + c * c,
            a * b + b * d + c * e,
            a * c + b * e + c * f,
            b * b + d * d + e * e,
            b * c + d * e + e * f,
            c * c + e * e + f * f,
        )
    if a >= d and a >= f:
        x, y, z = a, b, c
    elif d >= f:
        x, y, z = b, d, e
    else:
        x, y, z = c, e, f
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    along[0], along[1], along[2] = x, y, z
    largest = x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz)
    return max(total - largest, 0.0) / count
