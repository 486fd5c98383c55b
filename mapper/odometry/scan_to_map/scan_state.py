"""State of scan-to-map odometry: the map, its last keyframes, and what is known of fits, noise and motion."""

import copy
from collections import deque
from dataclasses import dataclass, field, fields, replace

import numpy as np

from mapper.core.deskew import STILL, Twist
from mapper.core.geometry import Transform
from mapper.odometry.scan_to_map.keyframe_tree import KeyframeTree
from mapper.odometry.scan_to_map.motion_model import MotionModel
from mapper.odometry.scan_to_map.pose_candidate import PoseCandidate
from mapper.odometry.scan_to_map.scan_fit import ScanKeyframe
from mapper.odometry.scan_to_map.scan_matcher import ScanMatcher
from mapper.odometry.scan_to_map.scan_noise import ScanNoise
from mapper.odometry.scan_to_map.scan_observation import ScanObservation
from mapper.odometry.scan_to_map.usual_fit import UsualFit

_KEYFRAMES = 5  # so many last ones are compared with


@dataclass(slots=True, eq=False)
class ScanState:
    """What tracking a scan changes.

    Attributes:
        matcher: With the map.
        usual: Fit of recent scans.
        noise: Of poses relative to the last keyframe.
        motion: Of the sensor.
        tree: Of the last keyframes.
        keyframes: The last ones, the newest first; empty before the first scan.
        doubtful: Keyframe after them whose pose is in doubt.
        last: The last scan.
        next_node: Number of the next keyframe.
    """

    matcher: ScanMatcher
    usual: UsualFit = field(default_factory=UsualFit)
    noise: ScanNoise = field(default_factory=ScanNoise)
    motion: MotionModel = field(default_factory=lambda: MotionModel(0, np.eye(4)))
    tree: KeyframeTree = field(default_factory=lambda: KeyframeTree(4 * _KEYFRAMES))
    keyframes: deque[ScanKeyframe] = field(default_factory=lambda: deque(maxlen=_KEYFRAMES))
    doubtful: ScanKeyframe | None = None
    last: ScanKeyframe | None = None
    next_node: int = 0

    def begin_map(
        self,
        first: ScanObservation,
        T_world_middle: Transform,
        twist: Twist = STILL,
        sigma_radps: float = 0.0,
    ) -> None:
        """Begin a map, unconnected to earlier ones.

        Args:
            first: Its first scan, which becomes a keyframe without a factor.
            T_world_middle: (4, 4) pose of the body in the middle of the sweep.
            twist: Velocity then.
            sigma_radps: Standard deviation of the velocity's rotation.
        """
        self.matcher.clear()
        self.usual.clear()
        self.noise.restart()
        self.tree.clear()
        self.keyframes.clear()
        self.motion = MotionModel(first.middle_ns, T_world_middle)
        self.motion.twist = twist
        deskewed = first.deskew(twist)
        T_world_body = T_world_middle @ twist.over(-first.middle_s)
        covariance = np.diag([(first.middle_s * sigma_radps) ** 2] * 3 + [0.0] * 3)
        self.matcher.add(deskewed, T_world_middle, is_keyframe=True)
        self.keyframes.append(
            ScanKeyframe(self.next_node, deskewed, T_world_middle, T_world_body, covariance)
        )
        self.doubtful = self.last = None
        self.next_node += 1

    def begin_again(self, first: ScanObservation, twist: Twist, sigma_radps: float) -> None:
        """Begin the map again with its first scan, whose pose at the stamp stays, by another velocity."""
        keyframe = self.keyframes[0]
        self.next_node = keyframe.node
        self.begin_map(first, keyframe.T_world_body @ twist.over(first.middle_s), twist, sigma_radps)

    def accept(self, scan: ScanKeyframe, found: PoseCandidate, *, is_keyframe: bool) -> None:
        """Extend the map by a scan that fits; if it fits the doubtful keyframe, the map begins there."""
        if found.keyframe is self.doubtful:
            self.matcher.clear()
            self.matcher.add(self.doubtful.deskewed, self.doubtful.T_world_middle, is_keyframe=True)
            self.keyframes.clear()
            self.keyframes.appendleft(self.doubtful)
        self.doubtful = None
        self.usual.add(found.shares)
        self.matcher.add(scan.deskewed, scan.T_world_middle, is_keyframe=is_keyframe)
        if is_keyframe:
            self.keyframes.appendleft(scan)

    def doubt(self, scan: ScanKeyframe, found: PoseCandidate, *, is_keyframe: bool) -> None:
        """Keep a doubtful scan out of the map; if it is a keyframe, it is one in doubt."""
        self.usual.add_doubtful(found.shares)
        if is_keyframe:
            self.doubtful = scan

    def keyframe_of(self, node: int) -> ScanKeyframe:
        """Return the keyframe of a node, one of the last or the doubtful one."""
        known = self.keyframes if self.doubtful is None else (*self.keyframes, self.doubtful)
        return next(keyframe for keyframe in known if keyframe.node == node)

    def copy(self) -> "ScanState":
        """Return a copy; scans, which do not change, are shared."""
        changing = (self.matcher, self.usual, self.noise, self.motion, self.tree)
        matcher, usual, noise, motion, tree = copy.deepcopy(changing)
        return replace(
            self,
            matcher=matcher,
            usual=usual,
            noise=noise,
            motion=motion,
            tree=tree,
            keyframes=self.keyframes.copy(),
        )

    def restore(self, other: "ScanState") -> None:
        """Go on from another state, whose parts become those of this one."""
        for part in fields(self):
            setattr(self, part.name, getattr(other, part.name))
