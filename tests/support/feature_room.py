"""Views of made-up rooms: points with descriptors of their own, seen by a pinhole camera."""

import numpy as np

from mapper.core.geometry import Transform, apply, exp, inverse
from mapper.features.frame_view import ImageView
from mapper.graph.model import PoseSigmas
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.places.config import PlacesConfig

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5])
BODY_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0]]
)
"""T_body_camera: body x forward, camera z forward."""
NODES, LAP = 60, 40
LINK = PoseSigmas(rotation_rad=0.02, translation_m=0.02).information
# Random bits fall into random words, so views of one place share fewer of them than real images do.
PLACES = PlacesConfig(min_similarity=0.1)


class Room:
    """Points all around within a few metres, each with 256 random bits."""

    def __init__(self, seed: int, *, points: int = 4000, size_m: float = 6.0) -> None:
        self._rng = np.random.default_rng(seed)
        self.points = self._rng.uniform(-0.5, 0.5, (points, 3)) * [size_m, size_m, 3.0]
        self.bits = self._rng.integers(0, 256, (points, 32), dtype=np.uint8)

    def view(self, T_world_body: Transform, stamp_ns: int, *, noise_px: float = 0.3) -> ImageView:
        """Return what is seen between 0.5 and 4 m, with a few pixels of noise and some wrong bits."""
        points_camera = apply(inverse(T_world_body @ BODY_CAMERA), self.points)
        z = np.maximum(points_camera[:, 2:], 1e-6)
        pixels = points_camera[:, :2] / z * INTRINSICS[:2] + INTRINSICS[2:]
        seen = ((pixels > 0.0) & (pixels < [640.0, 480.0])).all(axis=1)
        seen &= (points_camera[:, 2] > 0.5) & (points_camera[:, 2] < 4.0)
        n = int(seen.sum())
        flipped = np.packbits(self._rng.random((n, 256)) < 0.05, axis=1)
        noisy = pixels[seen] + self._rng.normal(0.0, noise_px, (n, 2))
        depth_m = points_camera[seen, 2:] * (1.0 + self._rng.normal(0.0, 0.002, (n, 1)))
        rays = np.column_stack([(noisy - INTRINSICS[2:]) / INTRINSICS[:2], np.ones(n)])
        return ImageView(
            stamp_ns=stamp_ns,
            pixels=noisy,
            sigma_px=np.ones(n),
            descriptors=self.bits[seen] ^ flipped,
            points_camera=rays * depth_m,
            intrinsics=INTRINSICS,
            T_body_camera=BODY_CAMERA,
        )


def track(node: int, stamp_ns: int, T_world_body: Transform, links=(), *, features: int = 500) -> FrameResult:
    """Return the track of a frame that became a node."""
    return FrameResult(
        stamp_ns=stamp_ns,
        node=node,
        T_node_body=np.eye(4),
        T_world_body=T_world_body,
        is_keyframe=True,
        diagnostics=Diagnostics(features, features, features, 0.5, "px", "map"),
        links=tuple(links),
    )


def walked() -> list[Transform]:
    """One and a half laps on a circle, looking outwards."""
    poses = []
    for k in range(NODES):
        yaw = 2.0 * np.pi * k / LAP
        T = exp(np.array([0.0, 0.0, yaw]), np.zeros(3))
        T[:2, 3] = [0.5 * np.cos(yaw), 0.5 * np.sin(yaw)]
        poses.append(T)
    return poses
