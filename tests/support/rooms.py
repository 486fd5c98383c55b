"""A room of rectangles, seen by depth cameras in a tilted world, and how level frames of it err."""

from dataclasses import dataclass

import numpy as np

from mapper.core.frames import PinholeCamera, Scan, ray_table
from mapper.core.geometry import apply, exp, rotation_exp, transform
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import AXES
from mapper.mapping.config import LevelConfig
from mapper.mapping.levelling import find_level

CAMERA = PinholeCamera(width_px=160, height_px=120, fx_px=130.0, fy_px=130.0, cx_px=79.5, cy_px=59.5)
MS = 1_000_000
_DEFAULTS = LevelConfig()


@dataclass
class Rectangle:
    """A patch of the plane where coordinate ``axis`` equals ``at``; bounds of the other two, metres."""

    axis: int
    at: float
    low: tuple[float, float] = (-3.0, -3.0)
    high: tuple[float, float] = (3.0, 3.0)


FLOOR = Rectangle(2, 0.0)
CEILING = Rectangle(2, 2.6)
WALLS = [Rectangle(0, 3.0, (-3.0, 0.0), (3.0, 2.6)), Rectangle(1, 3.0, (-3.0, 0.0), (3.0, 2.6))]
OTHER_WALLS = [Rectangle(0, -3.0, (-3.0, 0.0), (3.0, 2.6)), Rectangle(1, -3.0, (-3.0, 0.0), (3.0, 2.6))]
ROOM = [FLOOR, CEILING, *WALLS, *OTHER_WALLS]
DESK = Rectangle(2, 0.75, (0.3, -1.5), (2.9, 1.5))


def pose(x, y, z, *, yaw_deg, down_deg, roll_deg=0.0):
    """T_room_camera of a camera facing along yaw (0 is +x) and down."""
    yaw, down, roll = np.radians([yaw_deg, down_deg, roll_deg])
    R_room_level_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    R = rotation_exp(np.array([0.0, 0.0, yaw])) @ R_room_level_camera
    return transform(
        R @ rotation_exp(np.array([-down, 0.0, 0.0])) @ rotation_exp(np.array([0.0, 0.0, roll])), [x, y, z]
    )


def seen(scene, T_room_camera, *, rng, stamp_ns=0):
    """What a depth camera with Kinect-like noise sees of the rectangles."""
    rays_camera = np.dstack([ray_table(CAMERA), np.ones((120, 160))])[::2, ::2].reshape(-1, 3)
    rays = rays_camera @ T_room_camera[:3, :3].T
    eye = T_room_camera[:3, 3]
    depth_m = np.full(len(rays), np.inf)
    for rectangle in scene:
        others = [k for k in range(3) if k != rectangle.axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (rectangle.at - eye[rectangle.axis]) / rays[:, rectangle.axis]
            hits = eye + t[:, None] * rays
        within = (hits[:, others] >= rectangle.low) & (hits[:, others] <= rectangle.high)
        depth_m = np.where((t > 0.3) & within.all(axis=1) & (t < depth_m), t, depth_m)
    got = depth_m < 5.0
    noisy = depth_m[got] + rng.normal(0.0, 1.0, got.sum()) * 0.0012 * depth_m[got] ** 2
    return Scan(stamp_ns, (rays_camera[got] * noisy[:, None]).astype(np.float32))


def log_of(scene, T_room_cameras, *, seed=0):
    """Scans and trajectory in a world that is tilted against the room, as the first camera's frame is."""
    rng = np.random.default_rng(seed)
    T_world_room = exp(rng.normal(0, 1, 3), rng.normal(0, 2, 3))
    T_world_cameras = np.array([T_world_room @ T for T in T_room_cameras])
    stamps_ns = np.arange(len(T_world_cameras), dtype=np.int64) * 33 * MS
    scans = [
        (seen(scene, T_room, rng=rng, stamp_ns=int(stamp)), T_world)
        for stamp, T_room, T_world in zip(stamps_ns, T_room_cameras, T_world_cameras, strict=True)
    ]
    return scans, Trajectory(stamps_ns, T_world_cameras), T_world_room


def around(*, x=0.0, down_deg=25.0, n=12, height_m=1.4, span_deg=90.0):
    rolls = np.linspace(-4, 4, n)
    return [
        pose(x, 0.0, height_m, yaw_deg=yaw, down_deg=down_deg, roll_deg=roll)
        for yaw, roll in zip(np.linspace(0, span_deg, n), rolls, strict=True)
    ]


def level_of(scans, trajectory, accelerations=None, config=_DEFAULTS, axes=AXES["rgbd"]):
    return find_level(scans, trajectory=trajectory, accelerations=accelerations, config=config, axes=axes)


def tilt_deg(level, T_world_room):
    up_level = level.T_level_world[:3, :3] @ T_world_room[:3, 2]
    return np.degrees(np.arccos(np.clip(up_level[2], -1.0, 1.0)))


def floor_height_m(level, T_world_room):
    """Where the room's own floor, below the first pose, lies in the level frame."""
    return float(apply(level.T_level_world @ T_world_room, np.zeros((1, 3)))[0, 2])
