"""The tables of Somlyai's PhD thesis measured again: the error with and without each part of ISVD."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mapper.config.build import BuildConfig
from mapper.core.errors import DataError
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory import align, associate, ate
from mapper.evaluators.papers.ablation import VariantResult, follow
from mapper.evaluators.papers.measurements import (
    Place,
    Results,
    cells_of,
    failed,
    filled,
    measured,
    open_with_truth,
)
from mapper.evaluators.papers.model import PaperPath, PaperTable
from mapper.evaluators.papers.paper import Cut, Paper
from mapper.evaluators.papers.sequences import slug
from mapper.evaluators.papers.thesis_tables import Setting, tables
from mapper.evaluators.study.seeds import seeded
from mapper.evaluators.tables.table import Record
from mapper.sources.trajectory_files import read_tum, write_tum


@dataclass(frozen=True, slots=True)
class ThesisJob:
    """Measurement of all settings of some tables on one sequence with one seed.

    Attributes:
        tables: Tables from ``thesis_tables.tables()``; they use the same frames of the sequence.
        sequence: Name of the sequence in the thesis.
        log: Its folder or file.
        seed: Seed of RANSAC.
        cut: Frames that are used.
        paths: Folder for the trajectories.
    """

    tables: tuple[str, ...]
    sequence: str
    log: Path
    seed: int
    cut: Cut
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
        """Return the settings by table and what they are called there."""
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
        """Write both trajectories, the estimate aligned with the truth."""
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
    return [ThesisJob(tuple(group), sequence, log, seed, cut, paths) for group in alike.values()]


PAPER = Paper(
    title="Somlyai, PhD thesis, Óbuda University",
    sequences={name: [*ablation.sequences] for name, ablation in tables().items()},
    measurements=_measurements,
    table_of=table_of,
    drawn=lambda jobs: [path for job in jobs for path in job.drawn()],
)
