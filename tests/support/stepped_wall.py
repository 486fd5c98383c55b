"""Images of a painted wall with a step in it, from near and from far."""

import cv2
import numpy as np

from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.core.geometry import Transform, rotation_exp, transform

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
_PX_PER_M = 150
_SIZE_PX = 1200
_STEP_M = 0.8


def painting(seed: int) -> np.ndarray:
    """Return an image of blocks of many sizes, 8 by 8 metres."""
    rng = np.random.default_rng(seed)
    sizes = (6, 12, 24, 60, 150)
    layers = [
        cv2.resize(rng.uniform(0, 255, (n, n)), (_SIZE_PX, _SIZE_PX), interpolation=cv2.INTER_NEAREST)
        for n in (_SIZE_PX // size for size in sizes)
    ]
    return np.mean(layers, axis=0)


def wall_image(painted: np.ndarray, T_world_camera: Transform, stamp_ns: int) -> RgbdFrame:
    """Return the view of the wall z = 0, whose half x > 0 stands nearer by 0.8 m, towards −z.

    Args:
        painted: Image on the wall.
        T_world_camera: (4, 4) pose of a camera that looks along z.
        stamp_ns: Stamp of the frame.
    """
    columns, rows = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    rays = np.stack(
        [(columns - CAMERA.cx_px) / CAMERA.fx_px, (rows - CAMERA.cy_px) / CAMERA.fy_px, np.ones(rows.shape)],
        -1,
    )
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    directions = rays @ R.T
    depth_m, at = np.zeros(rows.shape), np.zeros((*rows.shape, 2))
    for front_m in (0.0, -_STEP_M):
        z = (front_m - t[2]) / directions[..., 2]
        x = t[0] + z * directions[..., 0]
        hit = (z > 0.0) & ((x > 0.0) == (front_m < 0.0)) & ((depth_m == 0.0) | (z < depth_m))
        depth_m[hit] = z[hit]
        at[hit] = np.stack([x, t[1] + z * directions[..., 1]], -1)[hit]
    # a camera far away averages what lies within its pixels
    blurred = cv2.GaussianBlur(
        painted, (0, 0), max(0.5 * float(np.median(depth_m)) * _PX_PER_M / CAMERA.fx_px, 0.3)
    )
    index = np.clip(np.rint(at * _PX_PER_M + _SIZE_PX / 2), 0, _SIZE_PX - 1).astype(int)
    grey = blurred[index[..., 1], index[..., 0]]
    stretched = 128.0 + 2.5 * (grey - 128.0)
    return RgbdFrame(
        stamp_ns, np.clip(stretched, 0, 255).astype(np.uint8), depth_m.astype(np.float32), CAMERA
    )


def facing(x: float, y: float, z: float, *, yaw: float = 0.0) -> Transform:
    """Return the (4, 4) pose of a camera that looks at the wall."""
    return transform(rotation_exp(np.array([0.0, yaw, 0.0])), np.array([x, y, z]))
