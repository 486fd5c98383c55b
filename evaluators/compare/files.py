"""Files of `mapper compare`: tables, every trial, every path, pictures and one MCAP log."""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mapper
from mapper.api.progress import AnyProgress, receiver_of
from mapper.config.loading import Settings, overridden
from mapper.core.geometry import Array
from mapper.evaluators.compare.comparison import Comparison
from mapper.evaluators.compare.comparison import compare as compare_methods
from mapper.evaluators.compare.config import CompareConfig
from mapper.evaluators.compare.pairwise import NO_GUESS, registration_records
from mapper.evaluators.metrics.odometry import OdometryRun
from mapper.evaluators.pictures.comparison import (
    write_comparison_log,
    write_path_errors,
    write_paths,
    write_registration_errors,
)
from mapper.evaluators.study.engine import CELLS
from mapper.evaluators.study.table import Column, Table, column, csv_text, decimals, degrees, percent
from mapper.run.manifest import library_versions
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_folder, write_json, write_text
from mapper.runtime.regular_files import AnyPath
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.trajectory_files import write_tum
from mapper.sources.vehicle import clear_vehicle

TABLES, REPORT = "tables.md", "comparison.json"
ODOMETRY, REGISTRATION, TRIALS = "odometry.csv", "registration.csv", "trials.csv"
PATHS_VIEW, PATH_ERRORS_VIEW, REGISTRATION_VIEW = "paths.png", "path_errors.png", "registration_errors.png"
MCAP = "compare.mcap"
TRAJECTORIES = "trajectories"
_FOLDER = FolderKind(
    "a comparison",
    manifest_keys=frozenset({"log", "mapper_version", "config"}),
    files=frozenset(
        {TABLES, REPORT, ODOMETRY, REGISTRATION, TRIALS, PATHS_VIEW, PATH_ERRORS_VIEW, REGISTRATION_VIEW}
        | {MCAP, TRAJECTORIES, CELLS}
    ),
    kind="comparison",
)


def compare(
    log: Log | AnyPath,
    *,
    methods: Sequence[str] = (),
    out: AnyPath = "compare",
    settings: Settings | None = None,
    progress: AnyProgress = None,
    overwrite: bool = False,
) -> Comparison:
    """Run every method over the same frames, as ``mapper compare`` does.

    Args:
        log: Recorded log, or its path.
        methods: Methods to compare; none are all that fit the log.
        out: Folder to create, called ``OUT.partial`` until it is whole; a comparison that was stopped is
            resumed.
        settings: Values by dotted name, such as ``{"pairs": 10}``.
        progress: As for ``mapper.build``.
        overwrite: Replace OUT, once the new one is whole.

    Raises:
        ConfigError: There is no such method or setting, or none of the methods can use the log.
        RunError: OUT exists already, or another process is filling it.
        MapperError: The log cannot be opened, or no frame of it can be read.
    """
    config = overridden(CompareConfig(methods=tuple(methods)), settings=settings)
    source = log if isinstance(log, Log) else open_source(Path(log), config.source)
    source, _ = clear_vehicle(source, config.source, progress=receiver_of(progress))
    plan = json.dumps(_manifest(source.path, config), indent=2, ensure_ascii=False) + "\n"
    with atomic_folder(
        Path(out), _FOLDER, overwrite=overwrite, keeps=lambda partial: _kept_of(partial, plan)
    ) as folder:
        write_text(folder / MANIFEST_NAME, plan)
        comparison = compare_methods(source, config, folder / CELLS, progress=receiver_of(progress))
        write_comparison(folder, comparison)
        shutil.rmtree(folder / CELLS)
    return comparison


def _kept_of(partial: Path, plan: str) -> list[str]:
    """Return the files of a folder that was left behind, if it is the beginning of this very comparison."""
    mark = partial / MANIFEST_NAME
    is_same = mark.is_file() and mark.read_text(encoding="utf-8") == plan
    return [child.name for child in partial.iterdir()] if is_same else []


def write_comparison(folder: Path, comparison: Comparison) -> None:
    """Fill a folder. Apart from times, the same comparison gives the same bytes."""
    tables = tables_of(comparison)
    records = {"odometry": tables[0].records, "registration": tables[1].records if tables[1:] else []}
    write_text(folder / ODOMETRY, csv_text(records["odometry"]))
    if comparison.trials:
        write_text(folder / REGISTRATION, csv_text(records["registration"]))
        write_text(folder / TRIALS, csv_text(comparison.trials))
    write_json(folder / REPORT, records)
    markdown = "\n\n".join([f"# {comparison.log}", *(table.markdown() for table in tables)])
    write_text(folder / TABLES, markdown + "\n")
    for run in comparison.runs:
        if len(run.trajectory):
            write_tum(folder / TRAJECTORIES / f"{run.method}.tum", run.trajectory)
    _write_pictures(folder, comparison)
    write_comparison_log(folder / MCAP, comparison.runs, truth=comparison.truth, trials=comparison.trials)
    write_json(
        folder / MANIFEST_NAME,
        {
            **_manifest(comparison.path, comparison.config),
            "skipped": [asdict(skip) for skip in comparison.skipped],
            "notes": comparison.notes,
        },
    )


def _manifest(log: Path, config: CompareConfig) -> dict[str, Any]:
    return {
        "kind": "comparison",
        "log": str(log.resolve()),
        "mapper_version": mapper.__version__,
        "libraries": library_versions(),
        "config": config.model_dump(mode="json"),
    }


def _write_pictures(folder: Path, comparison: Comparison) -> None:
    write_paths(
        folder / PATHS_VIEW,
        {run.method: run.trajectory for run in comparison.runs},
        truth=comparison.truth,
        captions={run.method: _caption(run) for run in comparison.runs},
        title=f"Paths on {comparison.log}" + (", over the truth" if comparison.truth is not None else ""),
    )
    known = {run.method: run.matched for run in comparison.runs if run.matched is not None}
    if known:
        write_path_errors(
            folder / PATH_ERRORS_VIEW,
            {method: matched.position_errors_m for method, matched in known.items()},
            {run.method: run.steps_m for run in comparison.runs if len(run.steps_m)},
            step=comparison.step.text,
            title=f"Odometry on {comparison.log}",
        )
    if comparison.trials:
        write_registration_errors(
            folder / REGISTRATION_VIEW,
            _by_guess(comparison),
            max_error_m=comparison.trials_config.max_error_m,
            title=f"Registration on {comparison.log}",
        )


def _caption(run: OdometryRun) -> str:
    if run.broke:
        return "broke down"
    return "no truth" if run.errors.ate_m is None else f"ATE {run.errors.ate_m:.3f} m"


def _by_guess(comparison: Comparison) -> dict[str, dict[str, Array]]:
    """Return the errors of all registrations; methods that use no guess are listed with every kind."""
    methods = dict.fromkeys(str(trial["method"]) for trial in comparison.trials)
    return {
        f"guess off by up to {guess.text}": {
            method: column(
                [
                    trial
                    for trial in comparison.trials
                    if trial["method"] == method and trial["guess"] in (guess.text, NO_GUESS)
                ],
                "translation_m",
            )
            for method in methods
        }
        for guess in comparison.trials_config.guesses
    }


_DEGREES = degrees(2)
_CENTIMETRES = decimals(2, times=100.0)


def tables_of(comparison: Comparison) -> list[Table]:
    """Return the table of odometry, and that of registration if there are any trials."""
    return [_odometry(comparison), *([_registration(comparison)] if comparison.trials else [])]


def _odometry(comparison: Comparison) -> Table:
    step = comparison.step.text
    broken = [f"{run.method} {run.broke}" for run in comparison.runs if run.broke]
    frames = max(run.frames for run in comparison.runs)
    unread = f" ({len(comparison.skipped)} more cannot be read)" if comparison.skipped else ""
    without_truth = [Column("disagreement_m", "views disagree m", decimals(4))]
    if comparison.truth is not None:
        without_truth = []
    return Table(
        columns=[
            Column("method", "method"),
            Column("ate_rmse_m", "ATE RMSE m", decimals(4)),
            *without_truth,
            Column("rpe_rmse_m", f"RPE {step} m", decimals(4)),
            Column("rpe_rmse_rad", f"RPE {step} °", _DEGREES),
            Column("drift_ratio", "drift %", percent(1)),
            Column("failures", "failures"),
            Column("coverage_ratio", "coverage %", percent(0)),
            Column("frames_per_s", "frames/s", decimals(1)),
        ],
        records=[
            {
                "method": run.method,
                "frames": run.frames,
                "failures": run.failures,
                "coverage_ratio": run.coverage,
                "ate_rmse_m": run.errors.ate_m,
                "disagreement_m": run.disagreement_m,
                "rpe_rmse_m": run.errors.rpe_m,
                "rpe_rmse_rad": run.errors.rpe_rad,
                "drift_ratio": run.errors.drift_ratio,
                "frames_per_s": run.frames_per_s,
                "broke": run.broke,
            }
            for run in comparison.runs
        ],
        title="Odometry",
        notes=[
            f"{frames} frames of {comparison.log}{unread}; paths SE(3)-aligned; drift: error of the "
            "translation over stretches of a tenth to a half of the path",
            "no loops and no solve; registrations go from frame to frame, from the motion before, which also "
            "carries on where one fails",
            f"frames/s: of the method alone, by CPU time, so on one core; reading a frame takes "
            f"{comparison.read_ms:.1f} ms more, making its scan {comparison.scan_ms:.1f} ms",
            *broken,
            *comparison.notes,
        ],
    )


def _registration(comparison: Comparison) -> Table:
    config = comparison.trials_config
    apart = ", ".join(map(str, config.frames_apart))
    pairs = {(trial["target_ns"], trial["source_ns"]) for trial in comparison.trials}
    return Table(
        columns=[
            Column("method", "method"),
            Column("guess_off_by", "guess off by"),
            Column("right_ratio", "right %", percent(0)),
            Column("wrong", "wrong"),
            Column("no_answer", "no answer"),
            Column("median_m", "median cm", _CENTIMETRES),
            Column("p95_m", "95 % cm", _CENTIMETRES),
            Column("median_rad", "median °", _DEGREES),
            Column("p95_rad", "95 % °", _DEGREES),
            Column("prepare_ms", "prepare ms", decimals(1)),
            Column("align_ms", "align ms", decimals(1)),
        ],
        records=registration_records(comparison.trials),
        title="Registration",
        notes=[
            f"{len(pairs)} pairs, {apart} frames apart; guesses are off by up to as much, "
            f"seed {comparison.config.seed}",
            f"right: within {config.max_error_m:g} m and {math.degrees(config.max_error_rad):.3g}° of the "
            "truth; wrong: farther off, but trusted; median and 95 % are of the right ones only",
            "prepare: CPU time that the target alone takes; align: the rest",
        ],
    )


def tables_text(comparison: Comparison) -> str:
    """Return both tables for a terminal."""
    return "\n".join(table.text() for table in tables_of(comparison))
