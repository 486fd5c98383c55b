"""The outdoor world: ground that slopes and undulates, and solids that stand on it.

A solid fills a turned box, as a cuboid, an upright cylinder or an ellipsoid.
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.simulation.boxes import Boxes
from mapper.simulation.builder import Place

_WAVES = 3
_SHORTEST_WAVE_M, _LONGEST_WAVE_M = 25.0, 70.0


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """z = slope · (x, y) + Σ amplitude · sin(wave · (x, y) + phase).

    Attributes:
        slope: (2,) rise per metre along x and y.
        waves: (K, 4) amplitude in metres, wave vector x and y in radians per metre, phase in radians.
    """

    slope: Array
    waves: Array

    def height_m(self, points_xy: Array) -> Array:
        """Return (N,) heights above z = 0 at (N, 2) places."""
        return points_xy @ self.slope + np.sin(self._angles(points_xy)) @ self.waves[:, 0]

    def normals(self, points_xy: Array) -> Array:
        """Return (N, 3) unit normals, upwards, at (N, 2) places."""
        swing = np.cos(self._angles(points_xy)) * self.waves[:, 0]
        rise = self.slope + swing @ self.waves[:, 1:3]
        normals = np.column_stack([-rise, np.ones(len(rise))])
        unit: Array = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return unit

    def as_json(self) -> dict[str, list[Any]]:
        """Return both attributes, with every digit."""
        return {"slope": self.slope.tolist(), "waves": self.waves.tolist()}

    def _angles(self, points_xy: Array) -> Array:
        return points_xy @ self.waves[:, 1:3].T + self.waves[:, 3]


def make_ground(rng: np.random.Generator, *, slope_rad: float, undulation_m: float) -> Ground:
    """Return ground that rises by an angle in any direction and swings by at most ``undulation_m``."""
    uphill_rad = rng.uniform(0.0, 2.0 * np.pi)
    amplitudes_m = undulation_m * rng.dirichlet(np.ones(_WAVES))
    directions_rad, phases_rad = rng.uniform(0.0, 2.0 * np.pi, (2, _WAVES))
    rates = 2.0 * np.pi / rng.uniform(_SHORTEST_WAVE_M, _LONGEST_WAVE_M, _WAVES)
    return Ground(
        slope=math.tan(slope_rad) * np.array([np.cos(uphill_rad), np.sin(uphill_rad)]),
        waves=np.column_stack(
            [amplitudes_m, rates * np.cos(directions_rad), rates * np.sin(directions_rad), phases_rad]
        ),
    )


class Shape(IntEnum):
    """Shape of a solid in its box; in units of the box's half sizes all three are unit shapes."""

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """Solids of an outdoor scene.

    Attributes:
        hulls: The box around each solid.
        shapes: (N,) int64: the ``Shape`` that fills it.
    """

    hulls: Boxes
    shapes: NDArray[np.int64]

    def __post_init__(self) -> None:
        if self.shapes.shape != (len(self.hulls),):
            raise DataError(f"solids: {len(self.hulls)} boxes with shapes {self.shapes.shape}, want (N,)")

    def __len__(self) -> int:
        return len(self.hulls)

    def bounds_world(self) -> tuple[Array, Array]:
        """Return the lowest and highest x, y, z, each (N, 3) metres, that a solid's box may reach."""
        cosine, sine = np.abs(np.cos(self.hulls.yaws_rad)), np.abs(np.sin(self.hulls.yaws_rad))
        half_x, half_y, half_z = self.hulls.half_sizes_m.T
        reach = np.column_stack([cosine * half_x + sine * half_y, sine * half_x + cosine * half_y, half_z])
        return self.hulls.centers_world - reach, self.hulls.centers_world + reach

    def as_json(self) -> list[dict[str, Any]]:
        """Return one ``{name, center_m, size_m, yaw_rad, shape}`` a solid, with every digit."""
        names = [Shape(shape).name.lower() for shape in self.shapes]
        return [row | {"shape": name} for row, name in zip(self.hulls.as_json(), names, strict=True)]


@dataclass(slots=True)
class Site:
    """Builder of the outdoor world.

    Attributes:
        ground: Ground on which everything stands.
    """

    ground: Ground
    _names: list[str] = field(default_factory=list)
    _shapes: list[Shape] = field(default_factory=list)
    _rows: list[tuple[float, ...]] = field(default_factory=list)

    def add(
        self,
        name: str,
        place: Place,
        *,
        center: tuple[float, float, float],
        size: tuple[float, float, float],
        shape: Shape = Shape.BOX,
    ) -> None:
        """Add one solid.

        Args:
            name: Name of the thing that it is part of.
            place: Frame in which ``center`` is given; its origin lies on the ground.
            center: Middle of the solid's box, metres.
            size: Extent of the box along x, y, z, metres.
            shape: Shape that fills the box.
        """
        x, y = place.world(center[0], center[1])
        base_m = float(self.ground.height_m(np.array([[place.x_m, place.y_m]]))[0])
        self._names.append(name)
        self._shapes.append(shape)
        self._rows.append((x, y, base_m + center[2], *(extent / 2.0 for extent in size), place.yaw_rad))

    def solids(self) -> Solids:
        """Return what was built."""
        table = np.array(self._rows, dtype=np.float64).reshape(-1, 7)
        hulls = Boxes(tuple(self._names), table[:, :3].copy(), table[:, 3:6].copy(), table[:, 6].copy())
        return Solids(hulls, np.array(self._shapes, dtype=np.int64))
