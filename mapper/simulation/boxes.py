"""Solids of the simulated flat: boxes turned about the vertical, and exact distances to them."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Array, Points, Transform
from mapper.runtime.atomic import write_json


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Solid boxes in the world frame (z up, floor at z = 0).

    Attributes:
        names: Name of the thing that each box is part of, e.g. "wall" or "desk".
        centers_world: (N, 3) float64 metres.
        half_sizes_m: (N, 3) float64 metres, along the box's own axes.
        yaws_rad: (N,) float64 turn of each box about the vertical.
    """

    names: tuple[str, ...]
    centers_world: Array
    half_sizes_m: Array
    yaws_rad: Array

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.centers_world.shape, self.half_sizes_m.shape, self.yaws_rad.shape)
        if shapes != ((n, 3), (n, 3), (n,)):
            raise DataError(f"boxes: {n} names with {shapes}, want (N, 3), (N, 3), (N,)")
        if not (self.half_sizes_m > 0.0).all():
            i = int(np.flatnonzero((self.half_sizes_m <= 0.0).any(axis=1))[0])
            raise DataError(f"boxes: {self.names[i]} has size {2 * self.half_sizes_m[i]} m, want > 0")

    def __len__(self) -> int:
        return len(self.names)

    def signed_distance_m(self, points_world: Points) -> Array:
        """Return how far each of (N, 3) points is from the nearest solid, metres.

        Positive outside, where it is the exact distance to the nearest surface; negative inside, where
        its size is the exact way out of the deepest box.
        """
        points = np.ascontiguousarray(points_world, dtype=np.float64)
        distances: Array = _signed_distances(points, self.centers_world, self.half_sizes_m, self.yaws_rad)
        return distances

    def occupied(self, points_world: Points) -> NDArray[np.bool_]:
        """Return for each of (N, 3) points whether it is inside or on a solid."""
        return self.signed_distance_m(points_world) <= 0.0

    def as_json(self) -> list[dict[str, Any]]:
        """Return one ``{name, center_m, size_m, yaw_rad}`` a box, with every digit."""
        return [
            {
                "name": name,
                "center_m": center.tolist(),
                "size_m": (2.0 * half).tolist(),
                "yaw_rad": float(yaw),
            }
            for name, center, half, yaw in zip(
                self.names, self.centers_world, self.half_sizes_m, self.yaws_rad, strict=True
            )
        ]


class BoxView(NamedTuple):
    """N boxes seen by a camera, as plain arrays for compiled code.

    Attributes:
        halves: (N, 3) half sizes of the boxes, metres.
        R_box_camera: (N, 3, 3) the camera's axes in the box frames.
        origin_box: (N, 3) the camera's centre in the box frames, metres.
        intrinsics: (4,) fx, fy, cx, cy in pixels.
    """

    halves: Array
    R_box_camera: Array
    origin_box: Array
    intrinsics: Array


def view_of(boxes: Boxes, camera: PinholeCamera, T_world_camera: Transform) -> BoxView:
    """Return the boxes in the view of a camera without distortion."""
    cosine, sine = np.cos(boxes.yaws_rad), np.sin(boxes.yaws_rad)
    R_box_world = np.zeros((len(boxes), 3, 3))
    R_box_world[:, 0, 0], R_box_world[:, 0, 1] = cosine, sine
    R_box_world[:, 1, 0], R_box_world[:, 1, 1] = -sine, cosine
    R_box_world[:, 2, 2] = 1.0
    R_box_camera = np.ascontiguousarray(R_box_world @ T_world_camera[:3, :3])
    origin_box = np.einsum("nij,nj->ni", R_box_world, T_world_camera[:3, 3] - boxes.centers_world)
    return BoxView(boxes.half_sizes_m, R_box_camera, origin_box, camera.intrinsics)


def write_scene(
    path: Path, boxes: Boxes, config: dict[str, Any], *, moving: Sequence[dict[str, Any]] = ()
) -> None:
    """Write the exact geometry and its configuration as JSON; ``moving`` only if anything moves."""
    scene: dict[str, Any] = {"config": config, "boxes": boxes.as_json()}
    if moving:
        scene["moving"] = list(moving)
    write_json(path, scene, indent=1)


def read_scene(path: Path) -> Boxes:
    """Read the boxes that ``write_scene`` wrote.

    Raises:
        DataError: The file cannot be read, or is not such a scene.
    """
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["boxes"]
        return Boxes(
            names=tuple(str(row["name"]) for row in rows),
            centers_world=np.array([row["center_m"] for row in rows], dtype=np.float64).reshape(-1, 3),
            half_sizes_m=np.array([row["size_m"] for row in rows], dtype=np.float64).reshape(-1, 3) / 2.0,
            yaws_rad=np.array([row["yaw_rad"] for row in rows], dtype=np.float64),
        )
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a scene of `mapper synth`: {error!r}; write it again") from None


@njit(cache=True, nogil=True)
def _signed_distances(points: Array, centers: Array, halves: Array, yaws: Array) -> Array:
    n = len(points)
    boxes = len(centers)
    cosines, sines = np.cos(yaws), np.sin(yaws)
    radii = np.sqrt((halves**2).sum(axis=1))
    distances = np.full(n, np.inf)
    for i in range(n):
        best = np.inf
        for b in range(boxes):
            dx = points[i, 0] - centers[b, 0]
            dy = points[i, 1] - centers[b, 1]
            dz = points[i, 2] - centers[b, 2]
            reach = max(best, 0.0) + radii[b]
            if dx * dx + dy * dy + dz * dz > reach * reach:
                continue  # the box's bounding sphere is already too far
            qx = abs(cosines[b] * dx + sines[b] * dy) - halves[b, 0]
            qy = abs(cosines[b] * dy - sines[b] * dx) - halves[b, 1]
            qz = abs(dz) - halves[b, 2]
            inner = max(qx, qy, qz)
            if inner > 0.0:
                inner = math.sqrt(max(qx, 0.0) ** 2 + max(qy, 0.0) ** 2 + max(qz, 0.0) ** 2)
            best = min(best, inner)
        distances[i] = best
    return distances
