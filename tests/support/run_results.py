"""Results of runs, made without a log: a walk of keyframes and frames between them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import exp
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.odometry.base import Diagnostics
from mapper.run.frame_records import FrameRecord
from mapper.run.manifest import Levelling, Manifest
from mapper.run.manifest_logs import Input
from mapper.run.pose_covariances import uncertain_poses
from mapper.run.results import RunResults

STEP_NS = 100_000_000
STEP_M = 0.05
KEYFRAME_EVERY = 5
MANIFEST = Manifest(
    status="building",
    input=Input(path="/log", kind="tum", fingerprint="sha256:0"),
    levelling=Levelling(method="planes", detail="floor seen in 40 of 90 patches"),
)
JUMP = Doubt("jump", "jump of 0.31 m where 0.09 m was predicted")
_HOW = Diagnostics(100, 50, 40, 0.01, "m", "map")


def results_of(
    count: int = 200,
    *,
    changed: Mapping[int, Mapping[str, Any]] | None = None,
    sigmas: PoseSigmas | None = None,
    wide_steps: Mapping[int, PoseSigmas] | None = None,
    stamps_ns: Mapping[int, int] | None = None,
) -> RunResults:
    """Return the results of a straight walk.

    Args:
        count: Number of frames.
        changed: Fields of the records of some frames, by index; one whose ``node`` is None has no pose.
        sigmas: Of the odometry's factors.
        wide_steps: The same of the factors that lead to some nodes.
        stamps_ns: Of some frames.
    """
    sigmas = sigmas or PoseSigmas(0.001, 0.002)
    graph, poses, records = PoseGraph(), [], []
    for k in range(count):
        stamp_ns = (stamps_ns or {}).get(k, k * STEP_NS)
        node, is_keyframe = k // KEYFRAME_EVERY, k % KEYFRAME_EVERY == 0
        T = exp(np.zeros(3), np.array([STEP_M * k, 0.0, 1.0]))
        if is_keyframe:
            graph.add_node(node, stamp_ns, T)
            if node:
                step = exp(np.zeros(3), np.array([STEP_M * KEYFRAME_EVERY, 0.0, 0.0]))
                information = (wide_steps or {}).get(node, sigmas).information
                graph.add_factors([BetweenFactor(node - 1, node, step, information)])
        record = FrameRecord(stamp_ns, "tracked", node, is_keyframe, _HOW, sigmas=(1e-3,) * 6)
        record = replace(record, **dict((changed or {}).get(k, {})))
        records.append(record)
        if record.node is not None:
            poses.append((stamp_ns, T))
    trajectory: Trajectory = trajectory_from(poses)
    return RunResults(trajectory, graph, records, [], {}, None, uncertain_poses(trajectory, graph, records))


def lost(method: str = "lost") -> dict[str, Any]:
    """Return the changed fields of a lost frame's record."""
    return {
        "outcome": "lost",
        "node": None,
        "is_keyframe": False,
        "diagnostics": replace(_HOW, method=method),
        "sigmas": None,
    }


def doubted(doubt: Doubt = JUMP, *, unobservable: str = "") -> dict[str, Any]:
    """Return the changed fields of a doubtful frame's record, in which a motion may be unobservable."""
    return {
        "outcome": "doubtful",
        "doubts": (doubt,),
        "diagnostics": replace(_HOW, unobservable=unobservable),
    }
