"""Test of poses by surfaces that lie elsewhere than in earlier depth images."""

from collections import deque
from dataclasses import dataclass

from mapper.core.doubts import Doubt
from mapper.core.timebase import NS_PER_S
from mapper.odometry.local_map.depth.earlier_depth import Displacement
from mapper.odometry.local_map.observation.image_observation import FEW_MOVING
from mapper.odometry.local_map.pose.assessment import UNDOUBTED, Assessment
from mapper.odometry.local_map.pose.pose_tracker import TrackedPose

_MOST, _MOST_FAR = 0.5, 0.2
"""When a larger share of the surfaces that two images have in common lies elsewhere, the pose is doubtful: a
real desk's edges give up to 0.48 under right poses. Where much moves the farther half decides: under right
poses one frame in a hundred has more than 0.2 there, under a passer-by's every second one."""
_AROUND_NS = 2 * NS_PER_S
"""Time around a frame in which moving features count: someone who walks ahead of the camera does not seem to
move while they are followed."""


@dataclass(slots=True)
class _Frame:
    stamp_ns: int
    moving_ratio: float
    displaced: Displacement
    among_movers: bool = False


class DisplacedSurfaces:
    """Test whether surfaces lie where they were in an earlier depth image.

    While much moves, only the farther half of the surfaces is tested: people who pass are nearer than the
    walls, and lie elsewhere under right poses.
    """

    def __init__(self) -> None:
        self._earlier: dict[int, Displacement] = {}  # of frames made doubtful, as much moved after them
        self._frames: deque[_Frame] = deque()

    def doubt_of(self, tracked_pose: TrackedPose, displaced: Displacement) -> Doubt | None:
        """Return that surfaces lie elsewhere by the next frame's pose; None if they may."""
        moving_ratio = len(tracked_pose.moving) / max(len(tracked_pose.observation), 1)
        frame = _Frame(tracked_pose.stamp_ns, moving_ratio, displaced)
        self._frames.append(frame)
        while self._frames[0].stamp_ns < frame.stamp_ns - _AROUND_NS:
            self._frames.popleft()
        if sum(there.moving_ratio for there in self._frames) > FEW_MOVING * len(self._frames):
            for there in self._frames:
                if not there.among_movers and there.displaced.far_ratio > _MOST_FAR and there is not frame:
                    self._earlier[there.stamp_ns] = there.displaced
                there.among_movers = True
        if frame.among_movers:
            return _far_doubt(displaced) if displaced.far_ratio > _MOST_FAR else None
        return _doubt(displaced.ratio, "", displaced) if displaced.ratio > _MOST else None

    def doubt_of_earlier(self, stamp_ns: int) -> Assessment:
        """Return the doubt that later frames add to an earlier one."""
        displaced = self._earlier.get(stamp_ns)
        if displaced is None:
            return UNDOUBTED
        return Assessment((_far_doubt(displaced),), 0.0, displaced.distance_m)


def _far_doubt(displaced: Displacement) -> Doubt:
    return _doubt(displaced.far_ratio, "farther ", displaced)


def _doubt(ratio: float, which: str, displaced: Displacement) -> Doubt:
    return Doubt(
        f"displaced {which}surfaces",
        f"{ratio:.0%} of the {which}surfaces lie elsewhere than {displaced.since_s:.1f} s before",
    )
