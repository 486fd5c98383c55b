"""Tracking of scans whose poses were found: their noise and doubts, and what they change in the state."""

from dataclasses import replace

import numpy as np

from mapper.core.doubts import Doubt
from mapper.core.geometry import Array, adjoint, inverse
from mapper.graph.model import BetweenFactor
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.odometry.keyframe_distance import is_far
from mapper.odometry.scan_to_map.config import ScanOdometryConfig
from mapper.odometry.scan_to_map.placed_scan import PlacedScan
from mapper.odometry.scan_to_map.pose_search import PoseSearch
from mapper.odometry.scan_to_map.scan_fit import ScanKeyframe
from mapper.odometry.scan_to_map.scan_noise import PoseNoise, doubtful_covariance, information_of
from mapper.odometry.scan_to_map.scan_observation import ScanObservation
from mapper.odometry.scan_to_map.scan_state import ScanState


class ScanTracker:
    """Tracker of scans: extends the map by those that fit, and makes those that are far keyframes."""

    def __init__(self, config: ScanOdometryConfig, state: ScanState, search: PoseSearch) -> None:
        self._config = config
        self._state = state
        self._search = search

    def track(self, observation: ScanObservation, placed: PlacedScan) -> FrameResult:
        """Return the result of a scan whose pose was found."""
        found, state = placed.found, self._state
        at_stamp = observation.middle_s**2 * placed.covariance_to_stamp
        doubts = self._doubts(observation, placed)
        noise = self._noise(observation, placed, at_stamp, is_doubtful=bool(doubts))
        state.motion.follow(
            observation.middle_ns,
            found.T_world_middle,
            is_certain=found.is_measured and not doubts,
            pose_covariance=noise.independent,
            measured=None if placed.twist is None else (placed.twist, placed.velocity_covariance),
        )
        T_middle_body = state.motion.twist.over(-observation.middle_s)
        T_world_body = found.T_world_middle @ T_middle_body
        T_key_body = inverse(found.keyframe.T_world_body) @ T_world_body
        is_keyframe = is_far(T_key_body, self._config)
        scan = ScanKeyframe(state.next_node, placed.deskewed, found.T_world_middle, T_world_body, at_stamp)
        take = state.doubt if doubts else state.accept
        take(scan, found, is_keyframe=is_keyframe)
        state.last = scan
        points = len(placed.deskewed.prepared.points)
        result = FrameResult(
            stamp_ns=observation.scan.stamp_ns,
            node=found.keyframe.node,
            T_node_body=T_key_body,
            T_world_body=T_world_body,
            is_keyframe=is_keyframe,
            diagnostics=Diagnostics(
                features=points,
                matches=points,
                inliers=len(found.fit.points),
                residual=found.fit.rmse_m,
                residual_unit="m",
                method=found.method,
                unobservable=found.fit.unobservable,
            ),
            twist=state.motion.twist,
            doubts=(*doubts, *noise.doubts),
            covariance=noise.covariance,
            unseen=None if noise.unseen is None else noise.unseen.at(T_middle_body),
        )
        return self._as_keyframe(result, scan, noise.covariance) if is_keyframe else result

    def _as_keyframe(self, result: FrameResult, scan: ScanKeyframe, covariance: Array) -> FrameResult:
        """Return a scan's result as a new node's, with a factor to the keyframe it was compared with."""
        assert result.node is not None
        self._state.next_node += 1
        self._state.noise.restart()
        factor = BetweenFactor(result.node, scan.node, result.T_node_body, information_of(covariance))
        return replace(
            result,
            node=scan.node,
            T_node_body=np.eye(4),
            factors=(factor,),
            links=(factor,),
            covariance=self._state.tree.add(scan.node, result.node, scan.T_world_body, covariance),
        )

    def _doubts(self, observation: ScanObservation, placed: PlacedScan) -> tuple[Doubt, ...]:
        """Return the evidence against a scan's pose, and that its points may be displaced."""
        doubts = self._search.doubts(placed.found)
        if self._config.usual_ratio == 0.0:
            return doubts
        return (*doubts, *observation.doubts(placed.velocity_covariance))

    def _noise(
        self, observation: ScanObservation, placed: PlacedScan, at_stamp: Array, *, is_doubtful: bool
    ) -> PoseNoise:
        """Return the noise of a scan's pose relative to the keyframe that it was compared with."""
        found, state = placed.found, self._state
        T_key_scan = inverse(found.keyframe.T_world_middle) @ found.T_world_middle
        Ad = adjoint(inverse(T_key_scan))
        noise = state.noise.of(
            found.fit,
            found.blend,
            T_key_scan,
            inverse(state.motion.T_world_last) @ found.T_world_middle,
            state.motion.elapsed_s(observation.middle_ns),
            at_stamp + Ad @ found.keyframe.covariance_at_stamp @ Ad.T,
        )
        if is_doubtful:
            return noise.with_more(doubtful_covariance(found.jump))
        if state.usual.is_weak(found.shares):
            return noise.with_more(found.fit.weak_covariance(placed.deskewed.prepared.voxel_m))
        return noise
