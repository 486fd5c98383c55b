"""The tables of Somlyai's PhD thesis (Óbuda University): the settings they compare, and the sequences."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from mapper.config.build import BuildConfig
from mapper.config.loading import load_config
from mapper.core.geometry import inverse, rotation_log
from mapper.core.trajectory import Trajectory
from mapper.core.units import MM_PER_M
from mapper.evaluators.metrics.trajectory_errors import associate, ate_rmse_m, rpe
from mapper.evaluators.papers.model import PaperCell, PaperTable
from mapper.evaluators.papers.paper import CONFIGS, Figures, figures, published

POZNAN = "Poznań/trajectory1"
_OWN_LOG = "the thesis's own log"
_AUTO_MIN_ERROR_MM = 5.0  # in all four logs of Table 5.1 "auto" is as good as 7 to 9 iterations: 7.6 to 4 mm


class Setting(NamedTuple):
    """A file of ``configs/thesis`` with overrides on top."""

    file: str
    overrides: tuple[str, ...] = ()

    def config(self, *more: str) -> BuildConfig:
        """Return the configuration."""
        return load_config(CONFIGS / "thesis" / f"{self.file}.toml", [*self.overrides, *more])


Places = Callable[[str, str], Sequence[tuple[str, str]]]
"""Row and column of each figure that a sequence and a setting give."""
Figure = Callable[[Trajectory, Trajectory], Sequence[float]]
"""These figures, of an estimate and the truth."""


@dataclass(frozen=True, slots=True)
class Ablation:
    """A table: some sequences, each with settings that differ in one thing.

    Attributes:
        table: Without what we measure; the thesis's figures of its own logs are in it.
        printed: The thesis's figures of logs that may be at hand.
        sequences: And how many of their first frames are used; None is all.
        settings: Settings by their names in the table.
        places: Places of the figures.
        measure: Function that works them out.
        alone: It shares too little work with the others to be measured with them.
    """

    table: PaperTable
    printed: Figures
    sequences: Mapping[str, int | None]
    settings: Mapping[str, Setting]
    places: Places = lambda row, setting: [(row, setting)]
    measure: Figure = lambda estimate, truth: [ate_rmse_m(estimate, truth)]
    alone: bool = False

    def row(self, sequence: str) -> str:
        """Return what a sequence is called in the table."""
        frames = self.sequences[sequence]
        return sequence if frames is None else f"{sequence} first {frames} frames"


@cache
def tables() -> Mapping[str, Ablation]:
    """Return the tables that can be measured again, by what they are called on the command line."""
    iterations = figures("isvd_iterations", rows="the columns")
    previous = figures("isvd_previous_frames")
    return {
        "4.1": _icp_or_svd(iterations),
        "4.2": _errors(
            "Table 4.2",
            "Loop closure on a long log",
            "loop_2100_frames",
            {"ISVD+DIF": Setting("ISVD+DIF"), "ISVD+DIF+LC": Setting("ISVD+LC+DIF")},
            sequences={"fr3/long_office": 2100},
        ),
        "5.1": _errors(
            "Table 5.1",
            "ISVD by the number of its iterations",
            "isvd_iterations",
            {count: _iterations(count) for count in next(iter(iterations.values()))},
            printed=iterations,
            axis="iterations",
        ),
        "5.2": _errors(
            "Table 5.2",
            "ISVD by the number of previous frames (MP) that each frame is registered against",
            "isvd_previous_frames",
            {mp: Setting(mp) for mp in next(iter(previous.values()))},
            axis="MP",
        ),
        "5.5": _errors(
            "Table 5.5",
            "ISVD alone, with loop closure (LC) and with the depth image filter (DIF)",
            "isvd_loop_dif",
            {
                "ISVD": Setting("ISVD"),
                "ISVD+LC": Setting("ISVD+LC"),
                "ISVD+LC+DIF": Setting("ISVD+LC+DIF"),
                "ISVD+LC, graph": Setting("ISVD+LC", ("graph.solve=batch",)),
                "ISVD+LC+DIF, graph": Setting("ISVD+LC+DIF", ("graph.solve=batch",)),
            },
            notes=("“graph” is ours: the same loops as constraints of a pose graph.",),
        ),
        "detectors": _detectors(iterations),
    }


def _errors(
    name: str,
    title: str,
    key: str,
    settings: Mapping[str, Setting],
    *,
    printed: Figures | None = None,
    sequences: Mapping[str, int | None] | None = None,
    axis: str = "",
    notes: tuple[str, ...] = (),
) -> Ablation:
    """Return a table of ATE RMSE whose rows are sequences, usually those of the printed figures."""
    printed = printed or figures(key)
    return Ablation(
        table=PaperTable(name, title, published()[key]["source"], "ATE RMSE", "m", (), axis, notes),
        printed=printed,
        sequences=sequences or dict.fromkeys(printed),
        settings=settings,
    )


def _iterations(count: str) -> Setting:
    """Return ISVD with a number of iterations: even the first plain fit is accepted.

    Too few pairs end the iterations in every row, as alg. 7, line 19 has it; without that the error rises
    after the 9th, which none of the thesis's logs shows. "Auto" ends by the smallest threshold as well.
    """
    if count == "auto":
        return Setting("ISVD", (f"odometry.registration.min_error_mm={_AUTO_MIN_ERROR_MM}",))
    fixed = {"max_iterations": count, "agreement_mm": 5000, "min_agreement_ratio": 0}
    return Setting("ISVD", tuple(f"odometry.registration.{key}={value}" for key, value in fixed.items()))


def _icp_or_svd(test_logs: Figures) -> Ablation:
    """Return algorithms 5 and 6, which differ in one line, by how far off the path's end is."""
    table = published()["icp_vs_svd"]
    columns = [f"{name} [{unit}]" for name, unit in (column.rsplit("_", 1) for column in table["columns"])]
    own = [
        PaperCell(f"{step}, {_OWN_LOG}", column, figure, ())
        for step, row in table["rows"].items()
        for column, figure in zip(columns, row, strict=True)
    ]
    halving = "odometry.registration.threshold=halving"
    return Ablation(
        table=PaperTable(
            name="Table 4.1",
            title="ICP or SVD in each iteration",
            source=table["source"],
            metric="error at the end of the path",
            unit="",
            cells=tuple(own),
            notes=(
                "The thesis's own log is not at hand: its rows are of another path, so there is no ratio.",
                "Axes are the camera's at the start (x right, y down, z forward); roll turns about z, pitch "
                "about x, yaw about y. “total” is the mean of the three amounts, as the printed totals are.",
            ),
        ),
        printed={},
        sequences=dict.fromkeys(test_logs),
        settings={
            step: Setting("MP1", (halving, f"odometry.registration.step={step.lower()}"))
            for step in table["rows"]
        },
        places=lambda row, step: [(f"{step}, {row}", column) for column in columns],
        measure=_end_error,
    )


def _end_error(estimate: Trajectory, truth: Trajectory) -> list[float]:
    """Return how far off the last pose is from the first: along and about three axes, and their means."""
    matched = associate(estimate, truth)
    T_start_end, T_true_start_end = (
        inverse(T[0]) @ T[-1] for T in (matched.T_map_body, matched.T_truth_body)
    )
    offset_mm = (T_start_end - T_true_start_end)[:3, 3] * MM_PER_M
    pitch, yaw, roll = rotation_log(T_start_end[:3, :3] @ T_true_start_end[:3, :3].T)
    turned_rad = np.array([roll, pitch, yaw])
    return [*offset_mm, *turned_rad, np.abs(offset_mm).mean(), np.abs(turned_rad).mean()]


def _detectors(test_logs: Figures) -> Ablation:
    """Return the settings of figure 5.6 with SIFT, which §4.1.2 names too."""
    mean = "odometry.average=mean"
    detectors = {
        **{
            f"{kind}2": (
                f"odometry.detector.kind={kind}",
                "odometry.detector.max_features=1000",  # their strongest; SURF's are limited by a threshold
                "odometry.previous_frames=2",
            )
            for kind in ("orb", "sift")
        },
        **{f"surf{mp}": (f"odometry.previous_frames={mp}",) for mp in (1, 2, 4, 8)},
        **{f"surf{mp}-avg": (f"odometry.previous_frames={mp}", mean) for mp in (4, 8)},
    }
    return Ablation(
        table=PaperTable(
            name="Figure 5.6",
            title="Detectors by the error from frame to frame; the number is MP, “avg” the plain mean of MP",
            source="Somlyai thesis Figure 5.6, a drawing without figures",
            metric="RPE RMSE, consecutive",
            unit="m",
            cells=(),
            notes=(
                "The thesis draws Poznań's trajectory1: ORB is the worst, SURF with MP 4 and 8 the best.",
            ),
        ),
        printed={},
        sequences={POZNAN: 300, **dict.fromkeys(test_logs)},
        settings={name: Setting("ISVD", overrides) for name, overrides in detectors.items()},
        measure=lambda estimate, truth: [rpe(associate(estimate, truth)).translation_m.rmse],
        alone=True,
    )
