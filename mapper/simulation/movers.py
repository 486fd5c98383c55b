"""Moving objects, which are never part of the truth: boxes, low enough for the camera, and people."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array, distances_along
from mapper.simulation.boxes import Boxes
from mapper.simulation.builder import ORIGIN, Builder, Faces, Skin
from mapper.simulation.config import SynthConfig
from mapper.simulation.path import Motion
from mapper.simulation.plan import closed_spline
from mapper.simulation.scene import Scene
from mapper.simulation.streams import TRIES, Stream, rng_of

_PARTS: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((-0.16, -0.14, 0.02), (0.32, 0.28, 0.80)),
    ((-0.24, -0.15, 0.82), (0.48, 0.30, 0.62)),
    ((-0.09, -0.10, 1.46), (0.18, 0.20, 0.24)),
)
"""Lowest corner and size, metres: legs, trunk, head."""
PARTS = len(_PARTS)
_PASSING_M = (0.9, 2.0)
_WALKING_MPS = (0.7, 1.5)
_APART_M = 0.6
_SMALLEST_M, _LARGEST_M = (0.35, 0.35, 0.5), (0.55, 0.55, 0.75)
_ROLLING_MPS = (0.3, 0.7)
_CLEARANCE_M = 0.03
_SAMPLES_PER_POINT = 400


@dataclass(frozen=True, slots=True, eq=False)
class Walkers:
    """Straight walks of P people.

    Attributes:
        positions: (P, 2) where each is at the start, world x and y, metres.
        velocities_mps: (P, 2) while they walk.
        stops_s: (P,) when each stops.
        stand_s: Duration that each stands.
    """

    positions: Array
    velocities_mps: Array
    stops_s: Array
    stand_s: float

    def at(self, time_s: float) -> Array:
        """Return (P, 2) where they are at a time, seconds after the start."""
        walked_s = time_s - np.clip(time_s - self.stops_s, 0.0, self.stand_s)
        return self.positions + self.velocities_mps * walked_s[:, None]


def make_walkers(config: SynthConfig, motion: Motion) -> Walkers:
    """Return walks that cross the view at times spread over the log and never run into the camera.

    Raises:
        SourceError: There is no such walk.
    """
    rng, count = rng_of(config.seed, Stream.PEOPLE), config.people
    times_s = motion.duration_s * (np.arange(count) + rng.uniform(0.3, 0.7, count)) / max(count, 1)
    stops_s = times_s - 0.5 * config.people_stand_s
    clock_s = np.arange(0.0, motion.duration_s, 0.1)
    camera_xy = motion.poses(clock_s)[:, :2, 3]
    positions, velocities = np.empty((count, 2)), np.empty((count, 2))
    for i, T_world_camera in enumerate(motion.poses(times_s)):
        ahead = T_world_camera[:2, 2] / np.linalg.norm(T_world_camera[:2, 2])
        for _ in range(TRIES):
            turn = float(rng.choice([-1.0, 1.0]) * np.pi / 2 + rng.uniform(-0.4, 0.4))
            across = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ ahead
            crossing = T_world_camera[:2, 3] + rng.uniform(*_PASSING_M) * ahead
            velocities[i] = rng.uniform(*_WALKING_MPS) * across
            positions[i] = crossing - velocities[i] * stops_s[i]
            walked_s = clock_s - np.clip(clock_s - stops_s[i], 0.0, config.people_stand_s)
            walked = positions[i] + velocities[i] * walked_s[:, None]
            if np.linalg.norm(walked - camera_xy, axis=1).min(initial=np.inf) > _APART_M:
                break
        else:
            raise SourceError(f"people {count}: person {i + 1} has no free way past the camera; want fewer")
    return Walkers(positions, velocities, stops_s, config.people_stand_s)


def build_people(config: SynthConfig, scene: Scene, builder: Builder) -> None:
    """Add the parts of all people, each standing on the world's origin."""
    rng = rng_of(config.seed, Stream.PEOPLE, 1)
    for _ in range(config.people):
        turn_rad = float(rng.uniform(0.0, np.pi))
        for low, size in _PARTS:
            skin = Skin(int(rng.choice(scene.faces.textures.ravel())), float(config.texture_px_per_m))
            builder.box("person", ORIGIN, low=low, size=size, skin=skin, turn_rad=turn_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Movers:
    """Boxes on the closed way round and people on straight ways, each at its own constant speed.

    Attributes:
        still: The boxes, then all parts of the people, standing on the world's origin.
        faces: Faces in the textures of the scene; None if there are no boxes.
        route: (R, 2) control points of the way, as in ``Plan``.
        starts_m: (M,) where along the way each box is at the start.
        speeds_mps: (M,) negative against the walker's direction.
        walkers: The ways of the people.
    """

    still: Boxes
    faces: Faces | None
    route: Array
    starts_m: Array
    speeds_mps: Array
    walkers: Walkers

    def __len__(self) -> int:
        return len(self.still)

    def boxes_at(self, time_s: float) -> Boxes:
        """Return the boxes at a time in seconds after the start."""
        parameter, along_m = _lengths(self.route)
        here_m = np.mod(self.starts_m + self.speeds_mps * time_s, along_m[-1])
        xy = closed_spline(self.route, np.interp(here_m, along_m, parameter))
        xy = np.concatenate([xy, np.repeat(self.walkers.at(time_s), PARTS, axis=0)])
        return replace(self.still, centers_world=self.still.centers_world + np.pad(xy, ((0, 0), (0, 1))))

    def scene_at(self, scene: Scene, time_s: float) -> Scene:
        """Return the scene with the boxes in it."""
        if self.faces is None:
            return scene
        a, b = scene.boxes, self.boxes_at(time_s)
        boxes = Boxes(
            a.names + b.names,
            np.concatenate([a.centers_world, b.centers_world]),
            np.concatenate([a.half_sizes_m, b.half_sizes_m]),
            np.concatenate([a.yaws_rad, b.yaws_rad]),
        )
        faces = Faces._make(map(np.concatenate, zip(scene.faces, self.faces, strict=True)))
        return replace(scene, boxes=boxes, faces=faces)

    def as_json(self, times_s: Array) -> list[dict[str, Any]]:
        """Return one ``{name, size_m, yaw_rad, center_m, centers_m}`` a box; one of ``centers_m`` a time."""
        rows = self.still.as_json()
        centers = np.array([self.boxes_at(float(time_s)).centers_world for time_s in times_s])
        return [{**row, "centers_m": centers[:, i].tolist()} for i, row in enumerate(rows)]


def make_movers(config: SynthConfig, scene: Scene, motion: Motion) -> Movers:
    """Return the moving boxes of a configuration, spread over the way round, and the people it meets."""
    rng, count = rng_of(config.seed, Stream.MOVERS), config.moving_boxes
    builder = Builder()
    for _ in range(count):
        size = rng.uniform(_SMALLEST_M, _LARGEST_M).tolist()
        low = (-size[0] / 2.0, -size[1] / 2.0, _CLEARANCE_M)
        texture = int(rng.choice(scene.faces.textures.ravel()))
        skin = Skin(texture, float(config.texture_px_per_m))
        builder.box(
            "moving box", ORIGIN, low=low, size=size, skin=skin, turn_rad=float(rng.uniform(0.0, np.pi))
        )
    lap_m = float(_lengths(scene.plan.route)[1][-1])
    starts_m = lap_m * (np.arange(count) + rng.uniform(0.2, 0.8, count)) / max(count, 1)
    speeds_mps = rng.uniform(*_ROLLING_MPS, count) * rng.choice([-1.0, 1.0], count)
    build_people(config, scene, builder)
    faces = builder.faces() if builder.names else None
    walkers = make_walkers(config, motion)
    return Movers(builder.boxes(), faces, scene.plan.route, starts_m, speeds_mps, walkers)


def _lengths(route: Array) -> tuple[Array, Array]:
    """Return the spline's parameters, densely, and the metres walked up to each."""
    parameter = np.linspace(0.0, len(route), _SAMPLES_PER_POINT * len(route) + 1)
    return parameter, distances_along(closed_spline(route, parameter))
