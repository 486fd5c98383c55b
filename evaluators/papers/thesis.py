"""The tables of Somlyai's PhD thesis measured again: the error with and without each part of ISVD."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, DataError, FrameError, MapperError
from mapper.core.frames import Frame, Image
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory_errors import align, associate, ate
from mapper.evaluators.papers.model import PaperPath, PaperTable
from mapper.evaluators.papers.paper import (
    Cut,
    Measurement,
    Paper,
    Place,
    Results,
    cells_of,
    failed,
    filled,
    measured,
    open_with_truth,
    slug,
)
from mapper.evaluators.papers.thesis_tables import Setting, tables
from mapper.evaluators.study.engine import seeded
from mapper.evaluators.study.table import Record
from mapper.features.base import Features
from mapper.features.config import DetectorConfig
from mapper.features.factory import build_detector
from mapper.features.matching import Pairs
from mapper.graph.model import PoseGraph
from mapper.loops.closure import accepted_loops
from mapper.loops.factory import build_loop_detector
from mapper.odometry.base import FrameResult
from mapper.odometry.config import IsvdOdometryConfig, MatchConfig
from mapper.odometry.isvd.frame_pairs import (
    IsvdObservation,
    PairRegistration,
    RegisterPair,
    matched_pairs,
)
from mapper.odometry.isvd.odometry import IsvdOdometry
from mapper.pipeline.solve import solve
from mapper.pipeline.tracking_result import TrackingResult, refuse_a_fragment
from mapper.registration.base import Alignment
from mapper.sources.base import Log
from mapper.sources.trajectory_files import read_tum, write_tum


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


@dataclass(frozen=True, slots=True)
class ThesisJob(Measurement):
    """Measurement of all settings of some tables on one sequence with one seed.

    Attributes:
        tables: Tables from ``thesis_tables.tables()``; they use the same frames of the sequence.
        paths: Folder for the trajectories.
    """

    tables: tuple[str, ...]
    paths: Path

    @property
    def name(self) -> str:
        """Name of the measurement."""
        return f"thesis-{slug(self.sequence)}-{'-'.join(self.tables)}"

    @property
    def places(self) -> list[Place]:
        """Places of the figures that it gives."""
        return [place for variant in self._variants() for place in self._places(*variant)]

    def configs(self) -> dict[str, BuildConfig]:
        """Return the settings with the seed and the frames in use."""
        return {
            f"{table} {name}": seeded(
                setting.config(*self.cut.overrides(tables()[table].sequences[self.sequence])), self.seed
            )
            for (table, name), setting in self._variants().items()
        }

    def __call__(self) -> list[Record]:
        """Track the log with every setting, and return the figures."""
        configs = self.configs()
        source, truth = open_with_truth(self.log, next(iter(configs.values())))
        results = follow(source, configs)
        records: list[Record] = []
        for table, name in self._variants():
            records += self._records(table, name, results[f"{table} {name}"], truth)
        return records

    def _variants(self) -> dict[tuple[str, str], Setting]:
        return {
            (table, name): setting
            for table in self.tables
            for name, setting in tables()[table].settings.items()
        }

    def _places(self, table: str, setting: str) -> list[Place]:
        ablation = tables()[table]
        rows = ablation.places(ablation.row(self.sequence), setting)
        return [Place(table, row, column) for row, column in rows]

    def _records(self, table: str, setting: str, result: VariantResult, truth: Trajectory) -> list[Record]:
        places = self._places(table, setting)
        if result.estimate is None:
            return [failed(place, result.failure) for place in places]
        try:
            values = tables()[table].measure(result.estimate, truth)
        except DataError as error:
            return [failed(place, str(error)) for place in places]
        if self._is_drawn(table):
            self._keep(setting, result.estimate, truth)
        note = (
            f"{self.sequence}, {setting}, seed {self.seed}: "
            f"{result.lost} of {result.frames} frames were not placed."
            if result.lost
            else ""
        )
        return [measured(place, float(value), note) for place, value in zip(places, values, strict=True)]

    def _is_drawn(self, table: str) -> bool:
        return table == "5.5" and self.seed == 0

    def _keep(self, setting: str, estimate: Trajectory, truth: Trajectory) -> None:
        T_truth_map = align(associate(estimate, truth), "se3").T_truth_map
        write_tum(self._path(setting), estimate.moved(T_truth_map))
        write_tum(self._path("truth"), truth.during(estimate.stamps_ns[0], estimate.stamps_ns[-1]))

    def _path(self, name: str) -> Path:
        cut = "" if self.cut.is_whole else f".{self.cut.first}-{self.cut.last}"
        return self.paths / f"{slug(self.sequence)}{cut}.{name}.tum"

    def drawn(self) -> list[PaperPath]:
        """Return the trajectories that were kept."""
        kept = [name for table, name in self._variants() if self._is_drawn(table)]
        truth = self._path("truth")
        return [
            PaperPath(
                self.sequence,
                name,
                ate(associate(read_tum(self._path(name)), read_tum(truth))).rmse,
                self._path(name),
                truth,
            )
            for name in kept
            if self._path(name).is_file()
        ]


def table_of(name: str, results: Results) -> PaperTable:
    """Return a table with the figures of its measurements."""
    ablation = tables()[name]
    return filled(name, ablation.table, cells_of(name, results, ablation.printed), results)


def _measurements(
    names: Sequence[str], sequence: str, log: Path, seed: int, cut: Cut, paths: Path
) -> Sequence[ThesisJob]:
    """Return one job for all tables that use the same frames and share most of the work."""
    alike: dict[tuple[int | None, bool], list[str]] = {}
    for name in names:
        ablation = tables()[name]
        if sequence in ablation.sequences:
            alike.setdefault((ablation.sequences[sequence], ablation.alone), []).append(name)
    return [ThesisJob(sequence, log, seed, cut, tuple(group), paths) for group in alike.values()]


PAPER = Paper(
    title="Somlyai, PhD thesis, Óbuda University",
    sequences={name: [*ablation.sequences] for name, ablation in tables().items()},
    measurements=_measurements,
    table_of=table_of,
    drawn=lambda jobs: [path for job in jobs for path in job.drawn()],
)


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
