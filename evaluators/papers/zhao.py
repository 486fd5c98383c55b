"""Tables 3 to 5 of Zhao, Liu and Yang (Journal of Computer Applications, 2020) measured again."""

import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mapper.config.build import BuildConfig
from mapper.config.loading import load_config
from mapper.core.units import MB
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.evaluators.papers.model import PaperCell, PaperTable
from mapper.evaluators.papers.paper import (
    CONFIGS,
    Cut,
    Measurement,
    Paper,
    Place,
    Results,
    cells_of,
    figures,
    filled,
    measured,
    open_with_truth,
    published,
    slug,
)
from mapper.evaluators.study.engine import seeded
from mapper.evaluators.study.table import Record
from mapper.pipeline.build import build
from mapper.run.files import CLOUD, OCTREE_BT

_OURS, _CLOUD, _OCTREE = "Zhao", "dense cloud", "octree 0.05 m"
_RESOLUTION_M = 0.05


@dataclass(frozen=True, slots=True)
class Printed:
    """A table of the paper.

    Attributes:
        key: Key in ``published.json``.
        table: Without its cells.
        columns: Columns that our method fills; the others are other systems.
    """

    key: str
    table: PaperTable
    columns: tuple[str, ...] = (_OURS,)


def _printed(
    number: str,
    title: str,
    key: str,
    metric: str,
    unit: str,
    *,
    columns: tuple[str, ...] = (_OURS,),
    notes: tuple[str, ...] = (),
) -> Printed:
    source = published()[key]["source"]
    return Printed(key, PaperTable(f"Table {number}", title, source, metric, unit, (), notes=notes), columns)


TABLES: Mapping[str, Printed] = {
    "3": _printed(
        "3",
        "Run time over the whole sequence, dense map included",
        "zhao_runtime",
        "run time",
        "s",
        notes=(
            "Another machine: printed are seconds of an i5-4258U at 2.4 GHz, ours are the wall seconds of "
            "mapper build, maps and files included; compare the CPU time if the machine was busy.",
        ),
    ),
    "4": _printed("4", "Absolute pose error", "zhao_ape", "APE RMSE", "m"),
    "5": _printed(
        "5",
        "Size of the map's files",
        "zhao_map_size",
        "file size",
        "MB",
        columns=(_CLOUD, _OCTREE),
        notes=("The paper does not say how dense its cloud is, nor which file format its octree has.",),
    ),
}


@dataclass(frozen=True, slots=True)
class ZhaoJob(Measurement):
    """Measurement of the method as published on one sequence with one seed."""

    @property
    def name(self) -> str:
        """Name of the measurement."""
        return f"zhao-{slug(self.sequence)}"

    @property
    def places(self) -> list[Place]:
        """Places of the figures that it gives."""
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
        """Build a run, and return its time, its error and the sizes of its files."""
        config = self.configs()[_OURS]
        source, truth = open_with_truth(self.log, config)
        with TemporaryDirectory(prefix="mapper-zhao-") as folder:
            began = time.process_time()
            run = build(source, config, Path(folder) / "run", checkpoint_s=None)
            cpu_s = time.process_time() - began
            counts = run.manifest.counts
            values = {
                ("3", _OURS): run.manifest.timing.total_s,
                ("4", _OURS): ate_rmse_m(run.trajectory, truth),
                ("5", _CLOUD): (run.path / CLOUD).stat().st_size / MB,
                ("5", _OCTREE): (run.path / OCTREE_BT).stat().st_size / MB,
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


def table_of(name: str, results: Results) -> PaperTable:
    """Return a table with our figures, and the other systems' printed ones beside them."""
    printed = TABLES[name]
    rows = figures(printed.key)
    ours = cells_of(name, results, rows)
    cells = []
    for row in dict.fromkeys(cell.row for cell in ours):
        cells += [cell for cell in ours if cell.row == row]
        others = (column for column in rows[row] if column not in printed.columns)
        cells += [PaperCell(row, column, rows[row][column], ()) for column in others]
    return filled(name, printed.table, cells, results)


def _measurements(
    _tables: Sequence[str], sequence: str, log: Path, seed: int, cut: Cut, _paths: Path
) -> Sequence[ZhaoJob]:
    return [ZhaoJob(sequence, log, seed, cut)]  # one run fills all tables


PAPER = Paper(
    title="Zhao, Liu and Yang, Journal of Computer Applications, 2020",
    sequences={name: [*figures(printed.key)] for name, printed in TABLES.items()},
    measurements=_measurements,
    table_of=table_of,
)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()
