"""Ray casting among solids that are sorted into square cells of the ground plan.

A ray visits the cells under it in order (Amanatides & Woo 1987), skips what it passes above or below
there, and ends where a solid is met before the cell is left. In units of a solid's half sizes the three
shapes are the unit cube, cylinder and sphere, each the part of the ray between two roots.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.simulation.lidar.solids import Ground, Shape, Solids

_CELL_M = 2.0
_TOUCH_M = 1e-6
_STEPS = 100
_CYLINDER, _ELLIPSOID = float(Shape.CYLINDER), float(Shape.ELLIPSOID)

Vector = tuple[float, float, float]


class World(NamedTuple):
    """Solids and their cells, as plain arrays for compiled code.

    Attributes:
        solids: (N, 11): centre, inverse half sizes, cosine and sine of the yaw, ``Shape``, lowest and
            highest z.
        corner: (2,) lowest x and y of the cells, metres.
        starts: (X, Y + 1) where each cell's members begin; a column's last entry ends its last cell.
        members: (M,) solids, cell after cell.
        tops: (X, Y) height of each cell's highest solid, metres; −inf where there is none.
        slope: (2,) of the ground.
        waves: (K, 4) of the ground.
    """

    solids: Array
    corner: Array
    starts: NDArray[np.int64]
    members: NDArray[np.int64]
    tops: Array
    slope: Array
    waves: Array


def sort_into_cells(solids: Solids, ground: Ground) -> World:
    """Return a world that can be cast into."""
    low, high = solids.bounds_world()
    corner = low[:, :2].min(axis=0)
    first = np.floor((low[:, :2] - corner) / _CELL_M).astype(np.int64)
    last = np.floor((high[:, :2] - corner) / _CELL_M).astype(np.int64)
    columns, rows = last.max(axis=0) + 1
    cells: list[list[list[int]]] = [[[] for _ in range(rows)] for _ in range(columns)]
    tops = np.full((columns, rows), -np.inf)
    for solid, (i0, j0), (i1, j1) in zip(range(len(solids)), first, last, strict=True):
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                cells[i][j].append(solid)
                tops[i, j] = max(tops[i, j], high[solid, 2])
    counts = np.array([[len(cell) for cell in column] for column in cells])
    ends = np.cumsum(counts).reshape(columns, rows)
    starts = np.column_stack([ends[:, :1] - counts[:, :1], ends])
    members = np.array([solid for column in cells for cell in column for solid in cell], dtype=np.int64)
    hulls = solids.hulls
    turns = np.column_stack([np.cos(hulls.yaws_rad), np.sin(hulls.yaws_rad)])
    table = np.column_stack(
        [hulls.centers_world, 1.0 / hulls.half_sizes_m, turns, solids.shapes, low[:, 2], high[:, 2]]
    )
    return World(table, corner, starts, members, tops, ground.slope, ground.waves)


@njit(cache=True, nogil=True)
def cast(world: World, origins: Array, directions: Array, max_range_m: float, meets_ground: bool) -> Array:
    """Return (A, E) float64 ranges in metres along unit rays; inf where nothing is met in range.

    A ray that starts inside a solid does not see it.

    Args:
        world: World that the rays are cast into.
        origins: (A, 3) world frame, metres.
        directions: (A, E, 3) unit vectors, world frame.
        max_range_m: Length of the rays.
        meets_ground: Whether rays end on the ground; otherwise they end on solids alone.
    """
    # Unpacked here, because compiled code counts references to every array of a tuple at every call.
    solids, starts, members, tops = world.solids, world.starts, world.members, world.tops
    corner, slope, waves = world.corner, world.slope, world.waves
    ranges = np.empty(directions.shape[:2])
    tested = np.full(len(solids), -1, dtype=np.int64)
    ray = 0
    for a in range(directions.shape[0]):
        origin = (origins[a, 0], origins[a, 1], origins[a, 2])
        for e in range(directions.shape[1]):
            direction = (directions[a, e, 0], directions[a, e, 1], directions[a, e, 2])
            nearest = _solid_range_m(
                solids, corner, starts, members, tops, origin, direction, max_range_m, tested, ray
            )
            if meets_ground:
                limit_m = min(nearest, max_range_m)
                nearest = min(nearest, _ground_range_m(slope, waves, origin, direction, limit_m))
            ranges[a, e] = nearest
            ray += 1
    return ranges


@njit(cache=True, nogil=True, error_model="numpy")
def _solid_range_m(
    solids: Array,
    corner: Array,
    starts: NDArray[np.int64],
    members: NDArray[np.int64],
    tops: Array,
    origin: Vector,
    direction: Vector,
    max_range_m: float,
    tested: NDArray[np.int64],
    ray: int,
) -> float:
    """Return where a ray enters the first solid, metres; inf if it meets none.

    ``tested`` holds each solid's last ray, so that one in many cells is tried once (Amanatides & Woo).
    """
    columns, rows = tops.shape
    dx, dy, dz = direction
    x, y = (origin[0] - corner[0]) / _CELL_M, (origin[1] - corner[1]) / _CELL_M
    per_column = _CELL_M / abs(dx) if dx != 0.0 else np.inf
    per_row = _CELL_M / abs(dy) if dy != 0.0 else np.inf
    # The part of the ray above the cells.
    begin, end = 0.0, max_range_m
    for position, span, step, per_cell in ((x, columns, dx, per_column), (y, rows, dy, per_row)):
        if step > 0.0:
            begin, end = max(begin, -position * per_cell), min(end, (span - position) * per_cell)
        elif step < 0.0:
            begin, end = max(begin, (position - span) * per_cell), min(end, position * per_cell)
        elif position < 0.0 or position > span:
            return np.inf
    if begin >= end:
        return np.inf
    i = min(max(math.floor(x + begin * dx / _CELL_M), 0), columns - 1)
    j = min(max(math.floor(y + begin * dy / _CELL_M), 0), rows - 1)
    next_column, next_row = np.inf, np.inf
    if dx != 0.0:
        next_column = (i + 1 - x if dx > 0.0 else x - i) * per_column
    if dy != 0.0:
        next_row = (j + 1 - y if dy > 0.0 else y - j) * per_row
    nearest, enter = np.inf, begin
    while True:
        leave = min(next_column, next_row, end)
        lowest = origin[2] + dz * (enter if dz > 0.0 else leave)
        highest = origin[2] + dz * (leave if dz > 0.0 else enter)
        if lowest <= tops[i, j]:
            for k in range(starts[i, j], starts[i, j + 1]):
                solid = members[k]
                if tested[solid] != ray and solids[solid, 9] <= highest and lowest <= solids[solid, 10]:
                    tested[solid] = ray
                    nearest = min(nearest, _one_range_m(solids, solid, origin, direction))
        if nearest <= leave or leave >= end:
            break
        if next_column <= next_row:
            i += 1 if dx > 0.0 else -1
            next_column += per_column
        else:
            j += 1 if dy > 0.0 else -1
            next_row += per_row
        if i < 0 or j < 0 or i >= columns or j >= rows:
            break
        enter = leave
    return nearest if nearest <= max_range_m else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _one_range_m(solids: Array, solid: int, origin: Vector, direction: Vector) -> float:
    """Return where a ray enters a solid, metres; inf if it does not."""
    cosine, sine = solids[solid, 6], solids[solid, 7]
    x, y = origin[0] - solids[solid, 0], origin[1] - solids[solid, 1]
    ox = (cosine * x + sine * y) * solids[solid, 3]
    oy = (cosine * y - sine * x) * solids[solid, 4]
    oz = (origin[2] - solids[solid, 2]) * solids[solid, 5]
    vx = (cosine * direction[0] + sine * direction[1]) * solids[solid, 3]
    vy = (cosine * direction[1] - sine * direction[0]) * solids[solid, 4]
    vz = direction[2] * solids[solid, 5]
    if solids[solid, 8] == _ELLIPSOID:
        across = ox * vx + oy * vy + oz * vz
        enter, leave = _between_roots(vx**2 + vy**2 + vz**2, across, ox**2 + oy**2 + oz**2 - 1.0)
    elif solids[solid, 8] == _CYLINDER:
        enter, leave = _between_roots(vx**2 + vy**2, ox * vx + oy * vy, ox**2 + oy**2 - 1.0)
        begin, end = _slab(oz, vz)
        enter, leave = max(enter, begin), min(leave, end)
    else:
        enter, leave = _slab(ox, vx)
        begin, end = _slab(oy, vy)
        enter, leave = max(enter, begin), min(leave, end)
        begin, end = _slab(oz, vz)
        enter, leave = max(enter, begin), min(leave, end)
    return enter if 0.0 < enter <= leave else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _slab(origin: float, direction: float) -> tuple[float, float]:
    """Return between which parameters a ray lies in −1 … 1 (Kay & Kajiya 1986)."""
    if direction == 0.0:
        return (-np.inf, np.inf) if abs(origin) <= 1.0 else (np.inf, -np.inf)
    per_unit = 1.0 / direction
    middle, reach = -origin * per_unit, abs(per_unit)
    return middle - reach, middle + reach


@njit(cache=True, nogil=True, error_model="numpy")
def _between_roots(a: float, half_b: float, c: float) -> tuple[float, float]:
    """Return between which parameters a·t² + 2·half_b·t + c ≤ 0, for a ≥ 0."""
    if a == 0.0:
        return (-np.inf, np.inf) if c <= 0.0 else (np.inf, -np.inf)
    discriminant = half_b * half_b - a * c
    if discriminant < 0.0:
        return np.inf, -np.inf
    root = math.sqrt(discriminant)
    return (-half_b - root) / a, (-half_b + root) / a


@njit(cache=True, nogil=True)
def _ground_range_m(slope: Array, waves: Array, origin: Vector, direction: Vector, limit_m: float) -> float:
    """Return how far along a ray the ground is, metres; inf where it is not within the limit.

    No step is longer than where the ray could be at the soonest if the ground rose towards it as fast as
    the waves' curvature lets it: the root of gap + rate·s − bend·s²/2. So none passes through, as in sphere
    tracing (Hart 1996), and the last steps converge like Newton's.
    """
    dx, dy, dz = direction
    bend = 1e-12
    for k in range(len(waves)):
        bend += abs(waves[k, 0]) * (waves[k, 1] * dx + waves[k, 2] * dy) ** 2
    t = 0.0
    for _ in range(_STEPS):
        x, y = origin[0] + t * dx, origin[1] + t * dy
        gap = origin[2] + t * dz - slope[0] * x - slope[1] * y
        rate = dz - slope[0] * dx - slope[1] * dy
        for k in range(len(waves)):
            angle = waves[k, 1] * x + waves[k, 2] * y + waves[k, 3]
            gap -= waves[k, 0] * math.sin(angle)
            rate -= waves[k, 0] * math.cos(angle) * (waves[k, 1] * dx + waves[k, 2] * dy)
        if gap < _TOUCH_M:
            return t
        root = math.sqrt(rate * rate + 2.0 * bend * gap)
        t += (rate + root) / bend if rate > 0.0 else 2.0 * gap / (root - rate)
        if t > limit_m:
            return np.inf
    return np.inf
