"""Tables 3 to 5 of Zhao, Liu and Yang (Journal of Computer Applications, 2020) measured again."""

import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from evaluators.papers.book import Book, Cut
from evaluators.papers.measured import CONFIGS, Place, ate_rmse_m, cells_of, measured, notes_of
from evaluators.papers.model import PaperCell, PaperTable
from evaluators.papers.published import figures, published
from evaluators.papers.sequences import slug
from evaluators.study.cells import CellResult
from evaluators.study.seeds import seeded
from evaluators.tables.table import Record
from mapper.config.build import BuildConfig
from mapper.config.loading import load_config
from mapper.core.errors import DataError
from mapper.pipeline.build import build
from mapper.run.files import CLOUD, OCTREE_BT
from mapper.sources import open_source

_OURS, _CLOUD, _OCTREE = "Zhao", "dense cloud", "octree 0.05 m"
_RESOLUTION_M = 0.05
_MB = 1e6


@dataclass(frozen=True, slots=True)
class Printed:
    """A table of the paper.

    Attributes:
        name: As printed.
        title: What it tells.
        key: In ``published.json``.
        metric: What its figures are.
        unit: Of its figures.
        columns: Those that our method fills; the others are other systems.
        notes: What a reader has to know.
    """

    name: str
    title: str
    key: str
    metric: str
    unit: str
    columns: tuple[str, ...] = (_OURS,)
    notes: tuple[str, ...] = ()


TABLES: Mapping[str, Printed] = {
    "3": Printed(
        "Table 3",
        "Run time over the whole sequence, dense map included",
        "zhao_runtime",
        "run time",
        "s",
        notes=(
            "Another machine: printed are seconds of an i5-4258U at 2.4 GHz, ours are the wall seconds of "
            "mapper build, maps and files included; compare the CPU time if the machine was busy.",
        ),
    ),
    "4": Printed("Table 4", "Absolute pose error", "zhao_ape", "APE RMSE", "m"),
    "5": Printed(
        "Table 5",
        "Size of the map's files",
        "zhao_map_size",
        "file size",
        "MB",
        columns=(_CLOUD, _OCTREE),
        notes=("The paper does not say how dense its cloud is, nor which file format its octree has.",),
    ),
}


@dataclass(frozen=True, slots=True)
class ZhaoJob:
    """The method as published on one sequence with one seed.

    Attributes:
        sequence: As the paper calls it.
        log: Where it lies.
        seed: Of RANSAC.
        cut: Which frames are used.
    """

    sequence: str
    log: Path
    seed: int
    cut: Cut

    @property
    def name(self) -> str:
        """What is measured."""
        return f"zhao-{slug(self.sequence)}"

    @property
    def places(self) -> list[Place]:
        """Which figures it gives."""
        return [
            Place(table, self.sequence, column)
            for table, printed in TABLES.items()
            for column in printed.columns
        ]

    def configs(self) -> dict[str, BuildConfig]:
        """Return the paper's settings with the seed and the frames in use."""
        octree = f"octree.resolution_m={_RESOLUTION_M}"
        return {_OURS: seeded(load_config(CONFIGS / "zhao.toml", [octree, *self.cut.overrides()]), self.seed)}

    def __call__(self) -> list[Record]:
        """Build a run and look at what it took, where it went and what it left."""
        config = self.configs()[_OURS]
        source = open_source(self.log, config.source)
        if source.truth is None:
            raise DataError(f"{self.log}: has no ground truth, so there is no error to tell")
        with TemporaryDirectory(prefix="mapper-zhao-") as folder:
            began = time.process_time()
            run = build(source, config, Path(folder) / "run")
            cpu_s = time.process_time() - began
            counts = run.manifest.counts
            values = {
                ("3", _OURS): run.manifest.timing.total_s,
                ("4", _OURS): ate_rmse_m(run.trajectory(), source.truth),
                ("5", _CLOUD): (run.path / CLOUD).stat().st_size / _MB,
                ("5", _OCTREE): (run.path / OCTREE_BT).stat().st_size / _MB,
            }
        lost = f"{self.sequence}, seed {self.seed}: {counts.lost} of {counts.read} frames were not placed."
        notes = {
            "3": f"{self.sequence}, seed {self.seed}: {cpu_s:.1f} s of CPU time on {_processor()}.",
            "4": lost if counts.lost else "",
            "5": f"Ours: {CLOUD} with a point per cube of {config.cloud.voxel_m} m, and {OCTREE_BT}.",
        }
        return [
            measured(place, values[place.table, place.column], notes[place.table]) for place in self.places
        ]


def table_of(name: str, jobs: Sequence[ZhaoJob], results: Sequence[CellResult]) -> PaperTable:
    """Return a table with what the jobs came to, and the other systems' printed figures beside it."""
    table = TABLES[name]
    printed = figures(table.key)
    ours = cells_of(name, jobs, results, printed)
    cells = []
    for row in dict.fromkeys(cell.row for cell in ours):
        cells += [cell for cell in ours if cell.row == row]
        others = (column for column in printed[row] if column not in table.columns)
        cells += [PaperCell(row, column, printed[row][column], ()) for column in others]
    return PaperTable(
        name=table.name,
        title=table.title,
        source=published()[table.key]["source"],
        metric=table.metric,
        unit=table.unit,
        cells=tuple(cells),
        notes=(*table.notes, *notes_of(name, results)),
    )


def _jobs(
    _tables: Sequence[str], sequence: str, log: Path, seed: int, cut: Cut, _paths: Path
) -> Sequence[ZhaoJob]:
    return [ZhaoJob(sequence, log, seed, cut)]  # one run fills all tables


BOOK = Book(
    title="Zhao, Liu and Yang, Journal of Computer Applications, 2020",
    sequences={name: [*figures(table.key)] for name, table in TABLES.items()},
    jobs=_jobs,
    table_of=table_of,
)


def _processor() -> str:
    """Return what the processor calls itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()
