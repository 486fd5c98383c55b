"""Proposer of similar scans among those that may be near, by Scan Context (Kim & Kim 2018)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Transform, apply
from mapper.loops.base import Proposal, Proposer
from mapper.loops.config import ScanLoopsConfig
from mapper.loops.nearby_proposer import CombinedProposer, NodePoses, PoseProposer
from mapper.loops.odometry_drift import OdometryChain
from mapper.loops.online_pose_estimator import OnlinePoseEstimator
from mapper.places.config import ScanContextConfig
from mapper.places.scan_context import ScanContext, ScanContexts, scan_context
from mapper.runtime.archived import Archivable

MAX_SIMILAR = 2
"""Largest number of candidates of a loop that are proposed for their similarity; the others, as near."""
_MAX_TILT_RAD = 0.8
"""Largest angle between the upright axes of nearby places; poses that differ more are not of one vehicle."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanPlace(Archivable):
    """Description of a scan, thin enough that ten thousand can be kept.

    Attributes:
        stamp_ns: The scan's stamp.
        points_body: (N, 3) float32 metres, one per voxel.
        T_level_body: (4, 4) turns z up and puts the ground below the sensor at z = 0.
    """

    stamp_ns: int
    points_body: Points32
    T_level_body: Transform


Among = Callable[[int, ScanPlace, Sequence[int]], NDArray[np.bool_]]
"""Returns which of some nodes' places the scan of a node may be of, (N,)."""


class ScanContextProposer:
    """Scan context proposer: similar scans, in any heading, among those that may be one."""

    def __init__(self, config: ScanContextConfig, among: Among, *, most: int = MAX_SIMILAR) -> None:
        """Start without places.

        Args:
            config: Scan contexts, and their least similarity.
            among: Function that excludes places.
            most: Largest number that is proposed, whatever the limit.
        """
        self._config = config
        self._among = among
        self._most = most
        self._index = ScanContexts(config)
        self._nodes: list[int] = []
        self._context = lru_cache(1)(self._context_of)  # a place is queried and then added

    def propose(self, node: int, seen: ScanPlace, /, *, before: int, limit: int) -> list[Proposal]:
        """Return the most similar places, the most similar first."""
        among = self._among(node, seen, self._nodes[:before])
        if not among.any():
            return []
        found = self._index.query(self._context(seen), among, limit=min(limit, self._most))
        return [Proposal(other, "scans", similarity) for other, similarity in found]

    def add(self, node: int, seen: ScanPlace) -> None:
        """Add a place."""
        self._index.add(node, self._context(seen))
        self._nodes.append(node)

    def _context_of(self, place: ScanPlace) -> ScanContext:
        points_level = apply(place.T_level_body, place.points_body.astype(np.float64))
        return scan_context(points_level, self._config)


def scan_proposer(
    config: ScanLoopsConfig, estimator: OnlinePoseEstimator, chain: OdometryChain
) -> Proposer[ScanPlace]:
    """Return the proposer of scans: by similarity and by pose.

    Where a path leads to a place, the odometry's drift on it bounds its distance; streets far apart are
    similar more often than they are one. Disconnected places may be anywhere.
    """
    by_pose = nearby_scans(config, estimator)

    def among(node: int, seen: ScanPlace, nodes: Sequence[int]) -> NDArray[np.bool_]:
        return ~chain.connected(node, nodes) | by_pose.within_reach(node, seen, before=len(nodes))

    return CombinedProposer(ScanContextProposer(config.context, among), by_pose)


def nearby_scans(config: ScanLoopsConfig, poses: NodePoses) -> PoseProposer[ScanPlace]:
    """Return the proposer of scans by pose."""
    return PoseProposer(
        poses,
        lambda _: np.eye(4),  # a scanner sees all around: its upright axis stands for a viewing direction
        max_distance_m=config.max_distance_m,
        max_angle_rad=_MAX_TILT_RAD,
        drift_ratio=config.gate.drift_ratio,
    )
