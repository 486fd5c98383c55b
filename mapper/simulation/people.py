"""People who cross the view of the camera near by, each walking straight on; some stop there for a while."""

from dataclasses import dataclass

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array
from mapper.simulation.builder import ORIGIN, Builder, Skin
from mapper.simulation.config import SynthConfig
from mapper.simulation.path import Motion
from mapper.simulation.scene import Scene
from mapper.simulation.streams import Stream, rng_of

_PARTS: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((-0.16, -0.14, 0.02), (0.32, 0.28, 0.80)),
    ((-0.24, -0.15, 0.82), (0.48, 0.30, 0.62)),
    ((-0.09, -0.10, 1.46), (0.18, 0.20, 0.24)),
)
"""Lowest corner and size, metres: legs, trunk, head."""
PARTS = len(_PARTS)
_NEAREST_M, _FARTHEST_M = 0.9, 2.0
_SLOWEST_MPS, _FASTEST_MPS = 0.7, 1.5
_APART_M = 0.6
_TRIES = 50


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
        """Return (P, 2) where they are so many seconds after the start."""
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
        for _ in range(_TRIES):
            turn = float(rng.choice([-1.0, 1.0]) * np.pi / 2 + rng.uniform(-0.4, 0.4))
            across = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ ahead
            crossing = T_world_camera[:2, 3] + rng.uniform(_NEAREST_M, _FARTHEST_M) * ahead
            velocities[i] = rng.uniform(_SLOWEST_MPS, _FASTEST_MPS) * across
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
