"""Variants of ISVD on one log in lockstep: what their settings have in common is computed once."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, FrameError, MapperError
from mapper.core.frames import Frame, Image
from mapper.core.trajectory import Trajectory
from mapper.features.base import Features
from mapper.features.config import DetectorConfig
from mapper.features.factory import build_detector
from mapper.features.matching import Pairs
from mapper.graph.model import PoseGraph
from mapper.loops.closure import accepted_loops
from mapper.loops.factory import build_loop_detector
from mapper.odometry.base import FrameResult
from mapper.odometry.config import IsvdOdometryConfig, MatchConfig
from mapper.odometry.isvd.odometry import IsvdOdometry
from mapper.odometry.isvd.registration import (
    IsvdObservation,
    PairRegistration,
    RegisterPair,
    matched_pairs,
)
from mapper.pipeline.solve import solve
from mapper.pipeline.tracking_result import TrackingResult, refuse_a_fragment
from mapper.registration.base import Alignment
from mapper.sources.base import Log


@dataclass(frozen=True, slots=True, eq=False)
class VariantResult:
    """Result of one variant.

    Attributes:
        estimate: Poses of the frames that were placed; None if too few were.
        frames: Number of frames that could be read.
        failure: Why there is no estimate, or empty.
    """

    estimate: Trajectory | None
    frames: int
    failure: str = ""

    @property
    def lost(self) -> int:
        """Number of frames that were read, but not placed."""
        return self.frames - (0 if self.estimate is None else len(self.estimate))


def follow(source: Log, variants: Mapping[str, BuildConfig]) -> dict[str, VariantResult]:
    """Return the result of every variant on a log.

    Each frame is read once, its features are detected once by each detector, and frames are matched and
    registered once for all variants that do so alike.

    Raises:
        ConfigError: An odometry is not ISVD.
    """
    detectors: dict[DetectorConfig, _SharedDetector] = {}
    runs: dict[BuildConfig, _VariantRun] = {}
    for name, config in variants.items():
        if not isinstance(config.odometry, IsvdOdometryConfig):
            raise ConfigError(f"{name}: odometry.kind is {config.odometry.kind}, want isvd")
        if config not in runs:
            detector = config.odometry.detector
            shared = detectors.setdefault(detector, _SharedDetector(detector))
            runs[config] = _VariantRun(config, config.odometry, shared)
    for entry in source.entries():
        try:
            frame = entry.load(colour=False)
        except FrameError:
            continue  # as a build does
        for run in runs.values():
            run.add(frame)
    results = {config: run.result() for config, run in runs.items()}
    return {name: results[config] for name, config in variants.items()}


class _SharedDetector:
    """Detector of several odometries: keeps the newest frame's features, their matches and their fits."""

    def __init__(self, config: DetectorConfig) -> None:
        self._detector = build_detector(config)
        self._gray: Image | None = None
        self._pairs: dict[tuple[int, MatchConfig], Pairs] = {}
        self._compared: dict[tuple[int, MatchConfig, Hashable], tuple[Alignment, float, int]] = {}

    @property
    def scale_factor(self) -> float:
        """The detector's."""
        return self._detector.scale_factor

    def detect(self, gray: Image) -> Features:
        """Return the features of the newest image."""
        if gray is not self._gray:
            self._gray, self._features = gray, self._detector.detect(gray)
            self._pairs.clear()
            self._compared.clear()
        return self._features

    def comparing(self, config: IsvdOdometryConfig) -> RegisterPair:
        """Return the comparison of an earlier frame with the newest by an odometry's settings."""
        register = PairRegistration(config.registration, by_pixels=config.residual == "pixels")
        how = (
            config.registration,
            config.residual,
            config.depth_noise,
            config.depth_filter,
            config.undistort,
            config.whole_pixels,
            config.max_depth_m,
        )

        def compare(
            target: IsvdObservation, source: IsvdObservation, match: MatchConfig
        ) -> tuple[Alignment, float, int]:
            key = (target.stamp_ns, match, how)
            if key not in self._compared:
                pairs = self._match(target, source, match)
                self._compared[key] = (*register.fit(target, source, pairs), len(pairs))
            return self._compared[key]

        return compare

    def _match(self, target: IsvdObservation, source: IsvdObservation, match: MatchConfig) -> Pairs:
        key = (target.stamp_ns, match)
        if key not in self._pairs:
            self._pairs[key] = matched_pairs(target, source, match)
        return self._pairs[key]


class _VariantRun:
    """One variant, frame by frame."""

    def __init__(self, config: BuildConfig, odometry: IsvdOdometryConfig, shared: _SharedDetector) -> None:
        self._config = config
        self._odometry = IsvdOdometry(odometry, detector=shared, register=shared.comparing(odometry))
        self._loop_detector = build_loop_detector(config.loops, config.graph.solve)
        self._graph = PoseGraph()
        self._tracks: list[FrameResult] = []

    def add(self, frame: Frame) -> None:
        """Track the next frame, and search loops from it."""
        observation = self._odometry.observe(frame)
        track = self._odometry.track(observation)
        self._tracks.append(track)
        if track.node is None:
            return
        self._graph.add_node(track.node, track.stamp_ns, track.T_world_body)
        self._graph.add_factors(track.factors)
        self._loop_detector.add(track.node, track, partial(self._odometry.view, observation))

    def result(self) -> VariantResult:
        """Return the poses with the loops' correction."""
        loops = tuple(self._loop_detector.closures())
        self._graph.add_factors(loop.factor for loop in accepted_loops(loops))
        tracking = TrackingResult(tuple(self._tracks), (), self._graph, loops, {})
        try:
            refuse_a_fragment(tracking, self._config, sensor="rgbd")
            solved = solve(self._graph, loops, self._config.graph)
        except MapperError as error:
            return VariantResult(None, len(self._tracks), str(error))
        return VariantResult(replace(tracking, graph=solved.graph).trajectory(), len(self._tracks))
