"""What loops remember of a scan, and which known scans look like one or are believed to be near."""

from dataclasses import dataclass

import numpy as np

from mapper.core.frames import Points32
from mapper.core.geometry import Transform, apply
from mapper.loops.base import Proposal, Proposer
from mapper.loops.config import ScanLoopsConfig
from mapper.loops.odometry_chain import OdometryChain
from mapper.loops.online_poses import OnlinePoseEstimator
from mapper.loops.proposals import ByBoth, ByPose
from mapper.places.config import ScanContextConfig
from mapper.places.scan_context import ScanContext, ScanContexts, scan_context


@dataclass(frozen=True, slots=True, eq=False)
class ScanPlace:
    """A scan, thin enough that ten thousand can be kept.

    Attributes:
        stamp_ns: The scan's stamp.
        points_body: (N, 3) float32 metres, one per voxel.
        T_level_body: (4, 4) turns z up and puts the ground below the sensor at z = 0.
    """

    stamp_ns: int
    points_body: Points32
    T_level_body: Transform


class ByContext:
    """Proposes what looks alike, whichever way it heads, of what may be near.

    Where a way leads to a place, the odometry's drift on it bounds how far off it can be; streets far apart
    look alike more often than they are one.
    """

    def __init__(
        self, config: ScanContextConfig, by_pose: ByPose[ScanPlace], chain: OdometryChain, *, most: int
    ) -> None:
        """Start without places.

        Args:
            config: What looks alike.
            by_pose: Tells how near is near; it has to remember the same places.
            chain: Which nodes are tied to which.
            most: How many it proposes at most, to leave room.
        """
        self._most = most
        self._config = config
        self._by_pose = by_pose
        self._chain = chain
        self._index = ScanContexts(config)
        self._nodes: list[int] = []
        self._described: tuple[ScanPlace, ScanContext] | None = None

    def propose(self, node: int, seen: ScanPlace, /, *, before: int, limit: int) -> list[Proposal]:
        """Return the most similar places, the most similar first."""
        part = self._chain.component_of(node)
        untied = np.array(
            [self._chain.component_of(place) != part for place in self._nodes[:before]], np.bool_
        )
        among = untied | self._by_pose.within_reach(node, seen, before=before)
        if not among.any():
            return []
        found = self._index.query(self._context(seen), among, limit=min(limit, self._most))
        return [Proposal(other, "scans", similarity) for other, similarity in found]

    def add(self, node: int, seen: ScanPlace) -> None:
        """Take a place in."""
        self._index.add(node, self._context(seen))
        self._nodes.append(node)

    def _context(self, place: ScanPlace) -> ScanContext:
        """Return what the place looks like; the last one is kept, for who is compared is then remembered."""
        if self._described is None or self._described[0] is not place:
            points_level = apply(place.T_level_body, place.points_body.astype(np.float64))
            self._described = place, scan_context(points_level, self._config)
        return self._described[1]


def scan_proposer(
    config: ScanLoopsConfig, _first: ScanPlace, estimator: OnlinePoseEstimator, chain: OdometryChain, /
) -> Proposer[ScanPlace]:
    """Return the proposer of scans: by looks, which leave room, and by pose."""
    by_pose: ByPose[ScanPlace] = ByPose(
        estimator,
        lambda _: np.eye(4),  # a scanner looks all round: its heading is nothing, its upright axis is all
        max_distance_m=config.max_distance_m,
        max_angle_rad=config.max_tilt_rad,
        drift_ratio=config.gate.drift_ratio,
    )
    return ByBoth(ByContext(config.context, by_pose, chain, most=config.max_lookalikes), by_pose)
