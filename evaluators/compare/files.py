"""Files of `mapper compare`: tables, every trial, every path, pictures and one MCAP log."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mapper
from mapper.core.geometry import Array
from mapper.evaluators.compare.comparison import Comparison, compare
from mapper.evaluators.compare.config import CompareConfig
from mapper.evaluators.compare.pairwise import NO_GUESS
from mapper.evaluators.compare.tables import tables_of
from mapper.evaluators.metrics.odometry import OdometryRun
from mapper.evaluators.pictures.comparison import write_path_errors, write_paths, write_registration_errors
from mapper.evaluators.pictures.comparison_mcap import write_comparison_log
from mapper.evaluators.study.engine import CELLS
from mapper.evaluators.tables.table import column, csv_text
from mapper.run.manifest import library_versions
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_folder, write_json, write_text
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log
from mapper.sources.trajectory_files import write_tum

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


def compare_into(
    out: Path,
    source: Log,
    config: CompareConfig,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Comparison:
    """Compare methods on a log and leave a folder; a comparison that was stopped is resumed.

    Args:
        out: Folder to create; until it is whole it is called ``OUT.partial``.
        source: The log.
        config: Methods, and how they are compared.
        overwrite: Replace a folder that is there, once the new one is whole.
        progress: As for ``compare``.

    Raises:
        RunError: OUT is there already, or another process is filling it.
        ConfigError: As for ``compare``.
        DataError: As for ``compare``.
    """
    plan = json.dumps(_manifest(source.path, config), indent=2, ensure_ascii=False) + "\n"
    with atomic_folder(
        out, _FOLDER, overwrite=overwrite, keeps=lambda partial: _kept_of(partial, plan)
    ) as folder:
        write_text(folder / MANIFEST_NAME, plan)
        comparison = compare(source, config, folder / CELLS, progress=progress)
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
