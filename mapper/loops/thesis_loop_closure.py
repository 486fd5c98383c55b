"""Loop closure of Somlyai (PhD thesis, §4.3), step by step."""

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from statistics import median

from mapper.core.geometry import Transform
from mapper.core.timebase import NS_PER_S
from mapper.features.frame_view import ImageView
from mapper.loops.base import Verifier, verify_proposal
from mapper.loops.closure import LoopClosure
from mapper.loops.config import ThesisLoopsConfig
from mapper.loops.detector import LoopDetector, ViewOf
from mapper.loops.nearby_proposer import PoseProposer
from mapper.loops.online_pose_estimator import OnlinePoseEstimator
from mapper.odometry.base import FrameResult
from mapper.odometry.sharpest_keyframe import SharpestKeyframes
from mapper.runtime.archived import Archived, ArchivedMapping, archived

_MAX_ANGLE_RAD = 0.5
"""Largest angle between two viewing directions, which the thesis leaves open."""


class ThesisLoopDetector(LoopDetector):
    """Loop detector of the thesis: sharp frames are compared with the keyframes near their estimate.

    No loop is compared with the odometry, so none is noted.
    """

    def __init__(
        self, config: ThesisLoopsConfig, verifier: Verifier[ImageView], estimator: OnlinePoseEstimator
    ) -> None:
        self._config = config
        self._verifier = verifier
        self._estimator = estimator
        self._proposer: PoseProposer[ImageView] = PoseProposer(
            estimator,
            lambda view: view.T_body_camera,
            max_distance_m=config.max_distance_m,
            max_angle_rad=_MAX_ANGLE_RAD,
            drift_ratio=0.0,
        )
        self._sharpest = SharpestKeyframes(config.keyframe_interval)
        self._features: deque[int] = deque(maxlen=config.keyframe_interval)
        self._recent: deque[tuple[int, ImageView]] = deque(maxlen=config.keyframe_interval)
        self._views: dict[int, Archived[ImageView]] = {}
        self._stamps_ns: list[int] = []
        self._closures: list[LoopClosure] = []

    def add(self, node: int, track: FrameResult, view: ViewOf, /) -> None:
        """Search loops if the frame is sharp, and keep the sharpest of every ``keyframe_interval`` frames."""
        self._estimator.add(node, track)
        seen, features = self._verifier.describe(view()), track.diagnostics.features
        self._features.append(features)
        self._recent.append((node, seen))
        if features > self._config.sharp_ratio * median(self._features):
            self._search(node, seen)
        keyframe = self._sharpest.add(node, features)
        for recent, recent_view in self._recent:
            if recent == keyframe:
                self._views[recent] = archived(recent_view)
                self._stamps_ns.append(recent_view.stamp_ns)
                self._proposer.add(recent, recent_view)

    def closures(self) -> Sequence[LoopClosure]:
        """Return every candidate so far."""
        return tuple(self._closures)

    def current_estimate(self, node: int) -> Transform:
        """Return the (4, 4) current estimate of a node's pose, with the loops so far."""
        return self._estimator.pose_of(node)

    def places(self) -> Mapping[int, ImageView]:
        """Return the keyframes so far."""
        return ArchivedMapping(self._views)

    def _search(self, node: int, seen: ImageView) -> None:
        old = bisect_right(self._stamps_ns, seen.stamp_ns - round(self._config.min_gap_s * NS_PER_S))
        for proposal in self._proposer.propose(node, seen, before=old, limit=self._config.max_candidates):
            known = self._views[proposal.node].data
            closure = verify_proposal(proposal, node, known, seen, self._verifier)
            self._closures.append(closure)
            if closure.verdict == "accepted":
                self._estimator.close(closure)
                return
