"""Drives with known truth as tracking would leave them: a graph of steps, and a receiver's fixes."""

from collections.abc import Callable

import numpy as np

from mapper.core.geometry import Array, exp, inverse
from mapper.core.rotations import rotation_from_euler
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.pipeline.tracking_result import TrackingResult
from mapper.simulation.path import START_NS

STEP = PoseSigmas(rotation_rad=5e-4, translation_m=0.01)
SPEED_MPS = 10.0


def drive(length_m: float) -> Callable[[Array], Array]:
    """Return the poses of a car at (N,) seconds on an ellipse with a hill, of about this perimeter."""
    a = length_m / 5.5
    b = 0.75 * a

    def poses(times_s: Array) -> Array:
        angles = np.asarray(times_s) * SPEED_MPS * 2.0 * np.pi / length_m
        x, y, z = a * np.sin(angles), b * (1.0 - np.cos(angles)), 3.0 * (1.0 - np.cos(angles))
        yaws = np.arctan2(b * np.sin(angles), a * np.cos(angles))
        T = np.tile(np.eye(4), (len(angles), 1, 1))
        T[:, :3, :3] = [rotation_from_euler(0.0, 0.0, yaw) for yaw in yaws.tolist()]
        T[:, :3, 3] = np.column_stack([x, y, z + 1.5])
        return T

    return poses


def truth_of(poses: Callable[[Array], Array], duration_s: float, rate_hz: float = 5.0) -> Trajectory:
    times_s = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    return Trajectory(START_NS + np.round(times_s * NS_PER_S).astype(np.int64), poses(times_s))


def tracked(truth: Trajectory, seed: int, *, drift: float = 0.0) -> TrackingResult:
    """Return the tracking of a drive whose steps have noise, and of which a share of the path is drift."""
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], 3)
    graph, tracks = PoseGraph(), []
    T_world_body = truth.T_world_body[0]
    for k, stamp_ns in enumerate(truth.stamps_ns.tolist()):
        factors: tuple[BetweenFactor, ...] = ()
        if k:
            step = inverse(truth.T_world_body[k - 1]) @ truth.T_world_body[k]
            step_m = float(np.linalg.norm(step[:3, 3]))
            turns = np.array([0.0, 0.01 * signs[0], 0.02 * signs[1]]) * drift * step_m
            error = exp(turns + rng.normal(0.0, STEP.rotation_rad / 5.0, 3), rng.normal(0.0, 0.01, 3))
            step = step @ error
            step[:3, 3] *= 1.0 + drift * signs[2]
            factors = (BetweenFactor(k - 1, k, step, STEP.information),)
            T_world_body = T_world_body @ step
        graph.add_node(k, stamp_ns, T_world_body)
        graph.add_factors(factors)
        tracks.append(FrameResult(stamp_ns, k, np.eye(4), T_world_body, True, Diagnostics(), factors))
    return TrackingResult(tuple(tracks), (), graph, (), {})
