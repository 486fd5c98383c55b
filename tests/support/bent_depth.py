"""Depth images of a corner of three planes, seen by a camera with or without depth distortion."""

import numpy as np

from mapper.core.frames import PinholeCamera, RgbdFrame, ray_table
from mapper.core.geometry import exp
from tests.support.logs import MemoryEntry, log_in_memory

CAMERA = PinholeCamera(width_px=160, height_px=120, fx_px=140.0, fy_px=140.0, cx_px=79.5, cy_px=59.5)
RAYS = np.concatenate([ray_table(CAMERA).astype(np.float64), np.ones((120, 160, 1))], axis=2)
_NORMALS = np.array([[0.3, 0.1, 1.0], [-0.8, 0.2, 0.6], [0.1, 0.9, 0.4]])
_NORMALS /= np.linalg.norm(_NORMALS, axis=1, keepdims=True)
_HEIGHTS_M = np.array([3.0, 2.2, 1.6])
_PERIOD_NS = 100_000_000


def smooth_error(rms_per_m=0.004):
    """Return an (H, W) error of the inverse depth that has no part affine in the rays."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 160), np.linspace(0.0, 1.0, 120))
    error = off_planes(np.sin(5.0 * x + 1.0) * np.cos(4.0 * y) + 0.5 * np.cos(9.0 * x - 3.0 * y))
    return rms_per_m / error.std() * error


def off_planes(error):
    """Return an (H, W) image without its part that is affine in the rays."""
    rays = RAYS.reshape(-1, 3)
    return error - (rays @ np.linalg.lstsq(rays, error.ravel(), rcond=None)[0]).reshape(error.shape)


def poses(frames, *, moves=True):
    """Return the (N, 4, 4) poses of a camera that sways and turns, or stands still."""
    phases = 0.4 * np.arange(frames) * moves
    turn_rad, shift_m = np.array([0.2, 0.4, 0.1]), np.array([0.5, 0.3, 0.9])
    return np.array(
        [exp(turn_rad * np.cos(0.7 * phase), shift_m * np.sin(phase + np.arange(3))) for phase in phases]
    )


def images(*, error_per_m=0.0, sigma_per_m=0.002, frames=40, moves=True):
    """Return (H, W) float32 depths of the corner from a camera on these poses."""
    rng = np.random.default_rng(5)
    made = []
    for T_world_camera in poses(frames, moves=moves):
        heights_m = _HEIGHTS_M - _NORMALS @ T_world_camera[:3, 3]
        inverses = (RAYS @ T_world_camera[:3, :3].T @ _NORMALS.T / heights_m).max(axis=2)
        noisy = inverses + error_per_m + sigma_per_m * rng.standard_normal(inverses.shape)
        made.append((1.0 / noisy).astype(np.float32))
    return made


def bent_log(**how):
    """Return a log of such images; ``how`` is that of ``images``."""
    grey = np.zeros((120, 160), np.uint8)
    return log_in_memory(
        [
            MemoryEntry(k * _PERIOD_NS, RgbdFrame(k * _PERIOD_NS, grey, depth_m, CAMERA))
            for k, depth_m in enumerate(images(**how))
        ]
    )
