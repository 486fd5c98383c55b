"""Wheel odometry alone: every frame has the pose of the wheels at its stamp (Somlyai, PhD thesis, §2.6.3)."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from mapper.core.deskew import Motion, Twist, twist_at
from mapper.core.frames import Scan
from mapper.core.geometry import Transform, inverse
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.features.factory import build_detector
from mapper.features.frame_view import FrameView
from mapper.graph.model import BetweenFactor
from mapper.graph.wheel_factors import WheelNode, wheel_factor
from mapper.odometry.base import Diagnostics, FrameResult, lost_frame
from mapper.odometry.camera.image_observation import observe_image
from mapper.odometry.config import GivenOdometryConfig, LocalMapConfig, WheelsOdometryConfig
from mapper.odometry.keyframe_distance import is_far
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.odometry.scans.scan_observation import observe_scan
from mapper.places.vocabulary import Vocabulary, load_vocabulary
from mapper.sensing.wheel_kinematics import Odometer, pose_at
from mapper.sources.base import FrameRef


class WheelsOdometry:
    """Odometry of either sensor's frames by their stamps; see :class:`mapper.odometry.base.Odometry`.

    Keyframes are the nodes, numbered from 0, each with a factor to the one before it. In a gap of the
    readings frames are lost, but the wheels kept counting: the next keyframe has a factor across the gap.
    """

    method = "wheels"
    readings = "the wheels' readings"

    def __init__(self, config: WheelsOdometryConfig | GivenOdometryConfig, wheels: Trajectory) -> None:
        """Start before the first frame.

        Args:
            config: Settings.
            wheels: T_odom_body of the log's wheel odometry.
        """
        self._config = config
        self._detector = build_detector(config.detector)
        self._wheels = wheels
        self._odometer = Odometer(wheels)
        self._T_world_odom: Transform | None = None
        self._T_world_body: Transform = np.eye(4)
        self._keyframe: WheelNode | None = None

    def read(self, entry: FrameRef) -> FrameRef:
        """Return the entry itself: its stamp is enough."""
        return entry

    def track(self, observation: FrameRef) -> FrameResult:
        """Track the next frame, in time order."""
        stamp_ns = observation.stamp_ns
        max_gap_ns = round(self._config.max_gap_s * NS_PER_S)
        T_odom_body = pose_at(self._wheels, stamp_ns, max_gap_ns=max_gap_ns)
        if T_odom_body is None:
            return self._lost(stamp_ns)
        if self._T_world_odom is None:
            self._T_world_odom = inverse(T_odom_body)
        self._T_world_body = self._T_world_odom @ T_odom_body
        last = keyframe = self._keyframe
        factors: tuple[BetweenFactor, ...] = ()
        if last is None:
            keyframe = WheelNode(0, stamp_ns, T_odom_body)
        elif is_far(inverse(last.T_odom_body) @ T_odom_body, self._config):
            keyframe = WheelNode(last.node + 1, stamp_ns, T_odom_body)
            factors = (wheel_factor(last, keyframe, self._odometer, self._config, origin="odometry"),)
        assert keyframe is not None
        self._keyframe = keyframe
        return FrameResult(
            stamp_ns=stamp_ns,
            node=keyframe.node,
            T_node_body=inverse(keyframe.T_odom_body) @ T_odom_body,
            T_world_body=self._T_world_body,
            is_keyframe=keyframe is not last,
            diagnostics=Diagnostics(0, 0, 0, 0.0, "m", self.method),
            factors=factors,
            links=factors,
            twist=self._twist(stamp_ns),
        )

    def view(self, observation: FrameRef, twist: Motion | None = None, /) -> FrameView:
        """Read the frame now, and return the view for place recognition. Pure.

        Raises:
            FrameError: The frame cannot be read or used.
        """
        frame = observation.load(colour=False)
        if isinstance(frame, Scan):
            return observe_scan(frame, GicpOdometryConfig()).view(twist)
        return observe_image(frame, self._detector, self._vocabulary, LocalMapConfig()).view()

    def matches(self) -> None:
        """Return None: the pose is not from features."""

    def finish(self) -> Sequence[BetweenFactor]:
        """Return nothing: every measurement was final when its frame was tracked."""
        return ()

    @cached_property
    def _vocabulary(self) -> Vocabulary:
        return load_vocabulary()

    def _twist(self, stamp_ns: int) -> Twist | None:
        """Return the body's motion at a time, by the readings around it."""
        return twist_at(self._wheels, int(np.searchsorted(self._wheels.stamps_ns, stamp_ns)))

    def _lost(self, stamp_ns: int) -> FrameResult:
        """Return the result of a frame at whose stamp there are no readings."""
        first_ns, last_ns = self._wheels.stamps_ns[[0, -1]]
        where = "in a gap of" if first_ns < stamp_ns < last_ns else "outside"
        return lost_frame(stamp_ns, self._T_world_body, method=f"lost {where} {self.readings}")
