"""Floor plan of the flat: rooms in two rows, the doors that join them, and the walking route."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array
from mapper.simulation.config import SynthConfig

WALL_M = 0.16
DOOR_WIDTH_M = 1.0
DOOR_HEIGHT_M = 2.05
DESK_SIZE_M = (1.6, 0.7, 0.74)
_ROUTE_STEP_M = 0.05


@dataclass(frozen=True, slots=True)
class Room:
    """The inside of one room, from wall face to wall face, metres in the world frame."""

    x0_m: float
    y0_m: float
    x1_m: float
    y1_m: float

    @property
    def center_m(self) -> Array:
        """(2,) middle of the floor."""
        return np.array([self.x0_m + self.x1_m, self.y0_m + self.y1_m]) / 2.0


@dataclass(frozen=True, slots=True)
class Wall:
    """A straight wall between two grid nodes.

    Attributes:
        axis: 0 if it runs along x, 1 along y.
        low_m: Where it begins along that axis.
        high_m: Where it ends.
        across_m: Its middle line on the other axis.
        door_m: Middle of its door along the axis, if it has one.
        room_below: Room on the smaller side of ``across_m``; None is outdoors.
        room_above: Room on the larger side.
    """

    axis: int
    low_m: float
    high_m: float
    across_m: float
    door_m: float | None
    room_below: int | None
    room_above: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Floor plan: rooms, walls and the walking route.

    Attributes:
        rooms: In the order in which the route visits them.
        walls: All of them, doors included.
        route: (R, 2) control points of the closed uniform cubic B-spline one walks, world x and y in metres.
        desk_center: (2,) middle of the desk in room 0, which stands against the wall y = y0.
    """

    rooms: tuple[Room, ...]
    walls: tuple[Wall, ...]
    route: Array
    desk_center: Array


def make_plan(config: SynthConfig, rng: np.random.Generator) -> Plan:
    """Return a plan with rooms of slightly different sizes and doors off the middle."""
    columns = config.rooms // 2
    xs = np.concatenate([[0.0], np.cumsum(config.room_size_m * rng.uniform(0.92, 1.08, columns))])
    ys = np.concatenate([[0.0], np.cumsum(config.room_size_m * rng.uniform(0.92, 1.08, 2))])
    cells = [(column, 0) for column in range(columns)] + [(column, 1) for column in reversed(range(columns))]
    index = {cell: room for room, cell in enumerate(cells)}
    half = WALL_M / 2.0
    rooms = tuple(Room(xs[i] + half, ys[j] + half, xs[i + 1] - half, ys[j + 1] - half) for i, j in cells)

    walls: list[Wall] = []
    for j in range(3):
        for i in range(columns):
            inside_end = j == 1 and i in (0, columns - 1)
            door = float(xs[i : i + 2].mean() + rng.uniform(-0.5, 0.5)) if inside_end else None
            below, above = index.get((i, j - 1)), index.get((i, j))
            walls.append(Wall(0, xs[i] - half, xs[i + 1] + half, ys[j], door, below, above))
    for i in range(columns + 1):
        for j in range(2):
            door = float(ys[j : j + 2].mean() + rng.uniform(-0.5, 0.5)) if 0 < i < columns else None
            below, above = index.get((i - 1, j)), index.get((i, j))
            walls.append(Wall(1, ys[j] + half, ys[j + 1] - half, xs[i], door, below, above))
    desk_center = np.array([rooms[0].center_m[0] - 0.3, rooms[0].y0_m + DESK_SIZE_M[1] / 2.0 + 0.01])
    return Plan(rooms, tuple(walls), _route(rooms, walls), desk_center)


def closed_spline(control: Array, parameter: Array) -> Array:
    """Return points of the closed uniform cubic B-spline, which is C² (de Boor 1978, ch. IX).

    Args:
        control: (R, D) control points.
        parameter: (N,) position; one turn is R long.
    """
    u = np.mod(parameter, len(control))
    first = np.floor(u).astype(np.intp)
    f = (u - first)[:, None]
    weights = ((1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3)
    points = np.zeros((len(u), control.shape[1]))
    for k, weight in enumerate(weights):
        points += weight / 6.0 * control[(first + k - 1) % len(control)]
    return points


def route_points(plan: Plan) -> Array:
    """Return (N, 2) points of the way round, about 5 cm apart, that furniture must leave free."""
    length_m = np.linalg.norm(np.diff(plan.route, axis=0, append=plan.route[:1]), axis=1).sum()
    count = int(length_m / _ROUTE_STEP_M) + 1
    return closed_spline(plan.route, np.linspace(0.0, len(plan.route), count, endpoint=False))


def _route(rooms: tuple[Room, ...], walls: list[Wall]) -> Array:
    """Straight through every door, and wide around every room's middle."""
    middle = np.mean([room.center_m for room in rooms], axis=0)
    points: list[Array] = []
    for number, room in enumerate(rooms):
        outward = room.center_m - middle
        # Rooms in the middle of a long row lie above or below the building's centre, not beside it.
        outward = np.sign(outward) * np.minimum(np.abs(outward), 0.45)
        points.append(room.center_m + outward)
        pair = {number, (number + 1) % len(rooms)}
        wall = next(w for w in walls if w.door_m is not None and {w.room_below, w.room_above} == pair)
        ahead = 1.0 if wall.room_below == number else -1.0
        for step_m in (-0.75, 0.0, 0.75):
            point = np.empty(2)
            point[wall.axis], point[1 - wall.axis] = wall.door_m, wall.across_m + ahead * step_m
            points.append(point)
    return np.array(points)
