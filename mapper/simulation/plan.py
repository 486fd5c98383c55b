"""Floor plans: rooms in two rows, one hall, or two rooms on a corridor; doors, and the walking route."""

import math
from dataclasses import dataclass
from typing import assert_never

import numpy as np

from mapper.core.geometry import Array
from mapper.simulation.config import SynthConfig

WALL_M = 0.16
DOOR_WIDTH_M = 1.0
DOOR_HEIGHT_M = 2.05
DESK_SIZE_M = (1.6, 0.7, 0.74)
TWIN_DISTANCE_M = 10.0
"""Between the same corners of two rooms that are alike."""
_ROUTE_STEP_M = 0.05
_HALL_STEP_M = 1.5


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
        low_m: Its lower end along that axis.
        high_m: Its upper end.
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
        rooms: Rooms in the order in which the route visits them.
        walls: All of them, doors included.
        route: (R, 2) control points of the closed uniform cubic B-spline one walks, world x and y in metres.
        desk_center: (2,) middle of the desk in room 0, which stands against the wall y = y0; only in a flat.
    """

    rooms: tuple[Room, ...]
    walls: tuple[Wall, ...]
    route: Array
    desk_center: Array


def make_plan(config: SynthConfig, rng: np.random.Generator) -> Plan:
    """Return the plan of a configuration's scene."""
    match config.scene:
        case "flat":
            return _flat(config, rng)
        case "hall":
            return _hall(config)
        case "twin-rooms":
            return _twin_rooms(config)
        case _:
            assert_never(config.scene)


def _flat(config: SynthConfig, rng: np.random.Generator) -> Plan:
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


def _hall(config: SynthConfig) -> Plan:
    """Return one room and a way round it: two straights with half circles at their ends."""
    length_m, width_m, clearance_m = config.hall_length_m, config.hall_width_m, config.hall_clearance_m
    room, half = Room(0.0, 0.0, length_m, width_m), WALL_M / 2.0
    walls = (
        Wall(0, -WALL_M, length_m + WALL_M, -half, None, None, 0),
        Wall(0, -WALL_M, length_m + WALL_M, width_m + half, None, 0, None),
        Wall(1, 0.0, width_m, -half, None, None, 0),
        Wall(1, 0.0, width_m, length_m + half, None, 0, None),
    )
    across_m, along_m = sorted((length_m / 2.0 - clearance_m, width_m / 2.0 - clearance_m))
    straight_m = along_m - across_m
    side = np.linspace(-straight_m, straight_m, max(math.ceil(2.0 * straight_m / _HALL_STEP_M), 1) + 1)
    turns_rad = np.linspace(-np.pi / 2.0, np.pi / 2.0, 5)[1:-1]
    cap = np.column_stack([straight_m + across_m * np.cos(turns_rad), across_m * np.sin(turns_rad)])
    oval = np.concatenate([np.column_stack([side, np.full(len(side), -across_m)]), cap])
    oval = np.concatenate([oval, -oval])
    if width_m > length_m:
        oval = oval[:, ::-1] * (-1.0, 1.0)
    return Plan((room,), walls, room.center_m + oval, room.center_m)


def _twin_rooms(config: SynthConfig) -> Plan:
    """Return two rooms of one size beside a corridor along y < 0, and a way into both and back."""
    size_m, corridor_m, beyond_m = config.room_size_m, 2.4, 1.6
    half = WALL_M / 2.0
    door_m = 0.5 * size_m
    end_m = TWIN_DISTANCE_M + size_m + beyond_m
    rooms = tuple(Room(x, half, x + size_m, size_m + half) for x in (0.0, TWIN_DISTANCE_M))
    corridor = Room(-beyond_m, -corridor_m, end_m, -half)
    walls = [
        Wall(0, size_m, TWIN_DISTANCE_M, 0.0, None, 2, None),
        Wall(0, -beyond_m, 0.0, 0.0, None, 2, None),
        Wall(0, TWIN_DISTANCE_M + size_m, end_m, 0.0, None, 2, None),
        Wall(0, -beyond_m - WALL_M, end_m + WALL_M, -corridor_m - half, None, None, 2),
        Wall(1, -corridor_m, half, -beyond_m - half, None, None, 2),
        Wall(1, -corridor_m, half, end_m + half, None, 2, None),
    ]
    for number, room in enumerate(rooms):
        x0, x1 = room.x0_m, room.x1_m
        walls += [
            Wall(0, x0, x1, 0.0, x0 + door_m, 2, number),
            Wall(0, x0 - WALL_M, x1 + WALL_M, room.y1_m + half, None, number, None),
            Wall(1, half, room.y1_m, x0 - half, None, None, number),
            Wall(1, half, room.y1_m, x1 + half, None, number, None),
        ]
    across_m = 0.18 * size_m
    visit = [(0.0, y) for y in (-0.75, 0.0, 0.75)]
    visit += [(across_m, 0.4 * size_m), (across_m, 0.68 * size_m), (-across_m, 0.68 * size_m)]
    visit += [(-across_m, 0.4 * size_m), (0.0, 0.75), (0.0, 0.0), (0.0, -0.75)]
    first, second = (np.add(visit, (room.x0_m + door_m, 0.0)) for room in rooms)
    out, back = first[0, 0] + 1.2, second[0, 0] - 1.2
    there = [(x, -1.0) for x in np.linspace(out, back, 5)]
    return_ = [(x, -1.5) for x in np.linspace(back, out, 5)]
    route = np.concatenate([first, there, second, return_])
    return Plan((*rooms, corridor), tuple(walls), route, rooms[0].center_m)


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
