"""The scene of a camera: walls, floors, ceilings, doors, furniture and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import assert_never

import numpy as np

from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.simulation import textures
from mapper.simulation.boxes import Boxes
from mapper.simulation.builder import DAYLIGHT, ORIGIN, Atlas, Builder, Faces, Light, Place, Skin, build_atlas
from mapper.simulation.config import SynthConfig
from mapper.simulation.furniture import PIECES, Studio, desk
from mapper.simulation.plan import (
    DESK_SIZE_M,
    DOOR_HEIGHT_M,
    DOOR_WIDTH_M,
    TWIN_DISTANCE_M,
    WALL_M,
    Plan,
    Room,
    Wall,
    make_plan,
    route_points,
)
from mapper.simulation.streams import TRIES, Stream, rng_of

_SLAB_M = 0.2
_WHITE = np.array([232.0, 230.0, 226.0])
_ROUTE_CLEARANCE_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """World that can be rendered, with exact geometry.

    Attributes:
        boxes: Every solid; ``boxes.occupied`` and ``boxes.signed_distance_m`` are the ground truth of maps.
        faces: Faces of the boxes.
        atlas: The textures.
        plan: Rooms, doors and the free way round.
    """

    boxes: Boxes
    faces: Faces
    atlas: Atlas
    plan: Plan


@dataclass(frozen=True, slots=True)
class _Footprint:
    """An upright rectangle, aligned with the axes, that something stands on."""

    low: tuple[float, float]
    high: tuple[float, float]
    height_m: float

    def overlaps(self, other: "_Footprint") -> bool:
        """Return whether two footprints overlap."""
        return all(self.low[k] < other.high[k] and other.low[k] < self.high[k] for k in (0, 1))

    def distance_m(self, points: Array) -> float:
        """Return the distance to the nearest of (N, 2) points."""
        outside = np.maximum(np.maximum(self.low - points, points - self.high), 0.0)
        return float(np.linalg.norm(outside, axis=1).min())


def make_scene(config: SynthConfig) -> Scene:
    """Return the scene of a configuration; its seed determines everything that is left open."""
    plan = make_plan(config, rng_of(config.seed, Stream.PLAN))
    builder = Builder()
    rng = rng_of(config.seed, Stream.FURNITURE)
    another_day = rng_of(config.seed, Stream.DAY, config.day) if config.day > 0 else None
    studio = Studio(builder, rng, another_day, px_per_m=config.texture_px_per_m)
    match config.scene:
        case "flat":
            _flat(config, studio, plan)
        case "hall":
            _hall(config, studio, plan)
        case "twin-rooms":
            _twin_rooms(config, studio, plan)
        case _:
            assert_never(config.scene)
    faces, textures = builder.faces(_light(config)), builder.textures
    if config.texture_contrast < 1.0:
        textures = [_whitened(texture, config.texture_contrast) for texture in textures]
        shades = 1.0 - config.texture_contrast * (1.0 - faces.shades)
        faces = faces._replace(shades=shades)
    return Scene(builder.boxes(), faces, build_atlas(textures), plan)


def _light(config: SynthConfig) -> Light:
    """Return the light of a day."""
    if config.day == 0:
        return DAYLIGHT
    rng = rng_of(config.seed, Stream.DAY, config.day)
    yaw_rad, swing, gain = rng.uniform((-np.pi, 0.05, 0.6), (np.pi, 0.14, 1.0)).tolist()
    return Light(yaw_rad, swing, gain)


def _whitened(texture: Image, contrast: float) -> Image:
    """Return a texture of which a share is left, the rest white."""
    return np.rint(contrast * texture + (1.0 - contrast) * _WHITE).astype(np.uint8)


def _flat(config: SynthConfig, studio: Studio, plan: Plan) -> None:
    """Build the rooms, their doors, and a desk in the first of them."""
    strips = [_room_surfaces(config, studio.builder, room, number) for number, room in enumerate(plan.rooms)]
    footprints: list[_Footprint] = []
    for wall in plan.walls:
        _build_wall(config, studio, wall, plan=plan, strips=strips)
        if wall.door_m is not None:
            footprints.append(_hang_door(studio, wall, wall.door_m))
    before_desk = plan.desk_center + np.array([[-0.4, 1.0], [0.0, 1.0], [0.4, 1.0]])
    keep_free = np.vstack([route_points(plan), before_desk])
    place = Place(plan.desk_center[0], plan.desk_center[1], 0.0)
    footprints.append(_footprint(place, DESK_SIZE_M))
    desk(studio, place, DESK_SIZE_M)
    for room in plan.rooms:
        _furnish(config, studio, room, keep_free=keep_free, footprints=footprints)
        _hang_pictures(config, studio, room, plan=plan, footprints=footprints)


def _hall(config: SynthConfig, studio: Studio, plan: Plan) -> None:
    """Build one room with painted walls, closed doors along its sides, and little else."""
    (room,) = plan.rooms
    strips = [_room_surfaces(config, studio.builder, room, 0, plain=True)]
    for wall in plan.walls:
        _build_wall(config, studio, wall, plan=plan, strips=strips)
    footprints = _close_doors(studio, room)
    _furnish(config, studio, room, keep_free=route_points(plan), footprints=footprints)
    _hang_pictures(config, studio, room, plan=plan, footprints=footprints)


def _close_doors(studio: Studio, room: Room) -> list[_Footprint]:
    """Add closed doors with a sign beside each, some metres apart along all four walls."""
    size, footprints = (0.95, 0.05, 2.05), []
    width_m, depth_m = room.x1_m - room.x0_m, room.y1_m - room.y0_m
    for yaw_rad, length_m, back_m in (
        (0.0, width_m, depth_m),
        (np.pi, width_m, depth_m),
        (-np.pi / 2, depth_m, width_m),
        (np.pi / 2, depth_m, width_m),
    ):
        wall = Place(float(room.center_m[0]), float(room.center_m[1]), yaw_rad)
        at_m = -length_m / 2 + studio.rng.uniform(0.8, 2.5)
        while at_m < length_m / 2 - 1.2:
            place = Place(*wall.world(at_m, -back_m / 2 + 0.03), yaw_rad)
            footprints.append(_footprint(place, (size[0] + 0.9, 0.4, size[2])))
            front = {3: studio.front((size[0], size[2]), columns=1, rows=2)}
            low = (-size[0] / 2, -size[1] / 2, 0.0)
            studio.builder.box("door", place, low=low, size=size, skin=studio.wood(), faces=front)
            sign = (0.2, 0.02, 0.14)
            faces = {3: studio.print(textures.document, (sign[0], sign[2]))}
            low = (size[0] / 2 + 0.1, -0.03, 1.5)
            studio.builder.box("sign", place, low=low, size=sign, skin=studio.paint(), faces=faces)
            at_m += studio.rng.uniform(3.0, 6.0)
    return footprints


def _twin_rooms(config: SynthConfig, studio: Studio, plan: Plan) -> None:
    """Build one room, copy all of it, and lay the corridor before both."""
    first, _, corridor = plan.rooms
    number = len(plan.rooms) - 1
    strips = [_room_surfaces(config, studio.builder, first, 0)] * 2
    begin = len(studio.builder.names)
    corridor_strip = _room_surfaces(config, studio.builder, corridor, number, plain=True)
    own = len(studio.builder.names)
    strips.append(corridor_strip)
    ours = [wall for wall in plan.walls if 0 in (wall.room_below, wall.room_above)]
    shift = np.array([TWIN_DISTANCE_M, 0.0])
    footprints: list[_Footprint] = []
    for wall in ours:
        _build_wall(config, studio, wall, plan=plan, strips=strips)
        if wall.door_m is not None:
            footprints.append(_hang_door(studio, wall, wall.door_m))
    keep_free = np.vstack([route_points(plan), route_points(plan) - shift])
    _furnish(config, studio, first, keep_free=keep_free, footprints=footprints)
    _hang_pictures(config, studio, first, plan=plan, footprints=footprints)
    studio.builder.repeat([*range(begin), *range(own, len(studio.builder.names))], shift_m=TWIN_DISTANCE_M)
    for wall in plan.walls:
        if not {0, 1} & {wall.room_below, wall.room_above}:
            _build_wall(config, studio, wall, plan=plan, strips=strips)
    _hang_pictures(config, studio, corridor, plan=plan, footprints=[])


def _room_surfaces(
    config: SynthConfig, builder: Builder, room: Room, number: int, *, plain: bool = False
) -> Skin:
    """Add a room's floor and ceiling; return the strip of wall covering that runs once around it."""
    rng = rng_of(config.seed, Stream.SURFACES, number)
    px_per_m = float(config.texture_px_per_m)
    x0, y0 = room.x0_m - WALL_M / 2, room.y0_m - WALL_M / 2
    width, depth = room.x1_m - room.x0_m + WALL_M, room.y1_m - room.y0_m + WALL_M
    shape = (round(depth * px_per_m), round(width * px_per_m))
    pave = textures.linoleum if plain else textures.FLOORS[(number + config.seed) % len(textures.FLOORS)]
    floor = pave(rng, shape, px_per_m)
    ceiling = (textures.painted if plain else textures.plaster)(rng, shape, px_per_m)
    for name, low, image in (("floor", -_SLAB_M, floor), ("ceiling", config.room_height_m, ceiling)):
        skin = Skin(builder.texture(image))
        builder.box(name, ORIGIN, low=(x0, y0, low), size=(width, depth, _SLAB_M), skin=skin)
    around = 2 * (room.x1_m - room.x0_m + room.y1_m - room.y0_m)
    strip = (round(config.room_height_m * px_per_m), round(around * px_per_m))
    covering = textures.painted if plain else textures.WALLS[(number + config.seed) % len(textures.WALLS)]
    return Skin(builder.texture(covering(rng, strip, px_per_m)), px_per_m)


def _build_wall(config: SynthConfig, studio: Studio, wall: Wall, *, plan: Plan, strips: list[Skin]) -> None:
    """Add a wall, in three parts if it has a door, each side in its room's covering."""
    top = config.room_height_m
    parts = [(wall.low_m, wall.high_m, 0.0)]
    if wall.door_m is not None:
        left, right = wall.door_m - DOOR_WIDTH_M / 2, wall.door_m + DOOR_WIDTH_M / 2
        parts = [(wall.low_m, left, 0.0), (left, right, DOOR_HEIGHT_M), (right, wall.high_m, 0.0)]
    paint = studio.paint()
    for begin, end, bottom in parts:
        faces = {}
        for side, number in ((0, wall.room_below), (1, wall.room_above)):
            if number is not None:
                offset = (_along_strip(plan.rooms[number], wall, (begin, end), above=side == 1), 0.0)
                strip = strips[number]
                faces[2 * (1 - wall.axis) + side] = Skin(strip.texture, strip.px_per_m, offset)
        low, size = [0.0, 0.0, bottom], [0.0, 0.0, top - bottom]
        low[wall.axis], low[1 - wall.axis] = begin, wall.across_m - WALL_M / 2
        size[wall.axis], size[1 - wall.axis] = end - begin, WALL_M
        studio.builder.box("wall", ORIGIN, low=low, size=size, skin=paint, faces=faces)


def _along_strip(room: Room, wall: Wall, span: tuple[float, float], *, above: bool) -> float:
    """Return where a wall face's left end, seen from inside the room, lies on the room's strip, metres.

    The strip runs along the walls y = y1, x = x0, y = y0, x = x1. ``above`` is true where the room is on
    the wall's upper side.
    """
    width, depth = room.x1_m - room.x0_m, room.y1_m - room.y0_m
    if wall.axis == 0:
        return width + depth + room.x1_m - span[1] if above else span[0] - room.x0_m
    return width + span[0] - room.y0_m if above else 2 * width + depth + room.y1_m - span[1]


def _hang_door(studio: Studio, wall: Wall, door_m: float) -> _Footprint:
    """Add a door leaf that stands open, a little past a right angle, in the room above the wall."""
    hinge, leaf = [0.0, 0.0], (0.9, 0.04, 2.0)
    hinge[wall.axis] = door_m + DOOR_WIDTH_M / 2
    hinge[1 - wall.axis] = wall.across_m + WALL_M / 2 + 0.01
    past_rad = studio.rng.uniform(0.1, 0.4)
    yaw_rad = np.pi / 2 - past_rad if wall.axis == 0 else past_rad
    place = Place(hinge[0], hinge[1], float(yaw_rad))
    front = studio.front((leaf[0], leaf[2]), columns=1, rows=2)
    faces = {2: front, 3: front}
    low_y = -leaf[1] if wall.axis == 0 else 0.0
    studio.builder.box("door", place, low=(0, low_y, 0.01), size=leaf, skin=studio.wood(), faces=faces)
    x, y = place.world(leaf[0] / 2, low_y + leaf[1] / 2)
    return _footprint(Place(x, y, place.yaw_rad), leaf)


def _furnish(
    config: SynthConfig, studio: Studio, room: Room, *, keep_free: Array, footprints: list[_Footprint]
) -> None:
    """Add pieces where they neither stand in the way nor in each other; what fits nowhere stays out."""
    rng = studio.rng
    order = rng.permutation(len(PIECES))
    for i in range(config.furniture_per_room):
        piece = PIECES[order[i % len(PIECES)]]
        size_array = rng.uniform(piece.smallest, piece.largest)
        size = (float(size_array[0]), float(size_array[1]), float(size_array[2]))
        for _ in range(TRIES):
            place = _at_a_wall(rng, room, size) if piece.at_wall else _anywhere(rng, room, size)
            footprint = _footprint(place, size)
            in_the_way = footprint.distance_m(keep_free) < _ROUTE_CLEARANCE_M
            if in_the_way or any(map(footprint.overlaps, footprints)):
                continue
            footprints.append(footprint)
            if studio.another_day is not None and not piece.at_wall:
                place = _moved(
                    studio.another_day, room, size, place, keep_free=keep_free, footprints=footprints
                )
            piece.build(studio, place, size)
            break


def _moved(
    rng: np.random.Generator,
    room: Room,
    size: tuple[float, float, float],
    place: Place,
    *,
    keep_free: Array,
    footprints: Sequence[_Footprint],
) -> Place:
    """Return where a piece stands on another day: at a free spot of the room, or where it was."""
    for _ in range(TRIES):
        other = _anywhere(rng, room, size)
        footprint = _footprint(other, size)
        free = not any(map(footprint.overlaps, footprints))
        if free and footprint.distance_m(keep_free) >= _ROUTE_CLEARANCE_M:
            return other
    return place


def _at_a_wall(rng: np.random.Generator, room: Room, size: tuple[float, float, float]) -> Place:
    back, side = size[1] / 2 + 0.01, size[0] / 2 + 0.02
    x, y = rng.uniform(room.x0_m + side, room.x1_m - side), rng.uniform(room.y0_m + side, room.y1_m - side)
    return (
        Place(x, room.y0_m + back, 0.0),
        Place(x, room.y1_m - back, np.pi),
        Place(room.x0_m + back, y, -np.pi / 2),
        Place(room.x1_m - back, y, np.pi / 2),
    )[int(rng.integers(4))]


def _anywhere(rng: np.random.Generator, room: Room, size: tuple[float, float, float]) -> Place:
    reach = np.hypot(size[0], size[1]) / 2
    x = rng.uniform(room.x0_m + reach, room.x1_m - reach)
    y = rng.uniform(room.y0_m + reach, room.y1_m - reach)
    return Place(x, y, rng.uniform(-np.pi, np.pi))


def _footprint(place: Place, size: tuple[float, float, float]) -> _Footprint:
    cosine, sine = abs(np.cos(place.yaw_rad)), abs(np.sin(place.yaw_rad))
    reach_x = (cosine * size[0] + sine * size[1]) / 2
    reach_y = (sine * size[0] + cosine * size[1]) / 2
    low, high = (place.x_m - reach_x, place.y_m - reach_y), (place.x_m + reach_x, place.y_m + reach_y)
    return _Footprint(low, high, size[2])


def _hang_pictures(
    config: SynthConfig, studio: Studio, room: Room, *, plan: Plan, footprints: list[_Footprint]
) -> None:
    """Hang posters side by side on walls, where no door and no tall furniture is."""
    rng = studio.rng
    doors = [_doorway(wall, wall.door_m) for wall in plan.walls if wall.door_m is not None]
    taken = [*doors, *(footprint for footprint in footprints if footprint.height_m > 1.2)]
    for _ in range(config.posters_per_room):
        size = (float(rng.uniform(0.35, 0.9)), 0.02, float(rng.uniform(0.35, 0.9)))
        for _ in range(TRIES):
            place = _at_a_wall(rng, room, size)
            footprint = _footprint(place, (size[0] + 0.06, 0.1, size[2]))
            if any(map(footprint.overlaps, taken)):
                continue
            taken.append(footprint)
            low = (-size[0] / 2, -size[1] / 2 - 0.01, float(rng.uniform(1.25, 1.3)))
            faces = {3: studio.print(textures.poster, (size[0], size[2]))}
            studio.builder.box("picture", place, low=low, size=size, skin=studio.wood(), faces=faces)
            break


def _doorway(wall: Wall, door_m: float) -> _Footprint:
    center = (door_m, wall.across_m) if wall.axis == 0 else (wall.across_m, door_m)
    reach = DOOR_WIDTH_M / 2 + WALL_M
    low, high = (center[0] - reach, center[1] - reach), (center[0] + reach, center[1] + reach)
    return _Footprint(low, high, DOOR_HEIGHT_M)
