"""What `mapper compare` leaves: tables, every trial, every path, pictures and one MCAP log."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

import mapper
from evaluators.compare.comparison import Comparison
from evaluators.compare.pairwise import NO_GUESS, Trial
from evaluators.compare.tables import (
    REGISTRATION_COLUMNS,
    guess_text,
    odometry_columns,
    odometry_notes,
    odometry_records,
    registration_notes,
    registration_records,
    trial_records,
)
from evaluators.metrics.odometry import OdometryRun, position_errors_m, rotation_errors_rad
from evaluators.metrics.trajectory import Matched
from evaluators.pictures.comparison import write_path_errors, write_paths, write_registration_errors
from evaluators.pictures.comparison_mcap import PathErrors, write_comparison_log
from evaluators.tables.table import Record, csv_text, markdown_table
from mapper.core.geometry import Array
from mapper.export.ros_messages import Value
from mapper.run.manifest import library_versions
from mapper.runtime.atomic import MANIFEST_NAME, write_text
from mapper.sources.trajectory_files import write_tum

TABLES, REPORT = "tables.md", "comparison.json"
ODOMETRY, REGISTRATION, TRIALS = "odometry.csv", "registration.csv", "trials.csv"
PATHS_VIEW, PATH_ERRORS_VIEW, REGISTRATION_VIEW = "paths.png", "path_errors.png", "registration_errors.png"
MCAP = "compare.mcap"
TRAJECTORIES = "trajectories"


def write_comparison(folder: Path, comparison: Comparison) -> None:
    """Fill a folder; :func:`mapper.runtime.atomic.staged` makes it appear as a whole.

    Apart from times, the same comparison gives the same bytes.
    """
    odometry, registration = odometry_records(comparison), registration_records(comparison)
    write_text(folder / ODOMETRY, csv_text(odometry))
    write_text(folder / TABLES, _markdown(comparison, odometry, registration))
    if registration:
        write_text(folder / REGISTRATION, csv_text(registration))
        write_text(folder / TRIALS, csv_text(trial_records(comparison)))
    write_text(folder / REPORT, _json({"odometry": odometry, "registration": registration}))
    paths = {run.method: run.trajectory for run in comparison.runs}
    for name, trajectory in paths.items():
        if len(trajectory):
            write_tum(folder / TRAJECTORIES / f"{name}.tum", trajectory)
    _write_pictures(folder, comparison)
    write_comparison_log(
        folder / MCAP,
        paths,
        truth=comparison.truth,
        errors={run.method: _errors(run.matched) for run in comparison.runs if run.matched is not None},
        trials=[_logged(comparison, trial) for trial in comparison.trials],
    )
    write_text(folder / MANIFEST_NAME, _json(_manifest(comparison)))


def _markdown(comparison: Comparison, odometry: Sequence[Record], registration: Sequence[Record]) -> str:
    parts = [f"# {comparison.log}", "## Odometry", markdown_table(odometry_columns(comparison), odometry)]
    parts.append("\n".join(f"- {note}" for note in odometry_notes(comparison)))
    if registration:
        parts += ["## Registration", markdown_table(REGISTRATION_COLUMNS, registration)]
        parts.append("\n".join(f"- {note}" for note in registration_notes(comparison)))
    return "\n\n".join(parts) + "\n"


def _manifest(comparison: Comparison) -> dict[str, object]:
    return {
        "kind": "comparison",
        "log": str(comparison.path.resolve()),
        "mapper_version": mapper.__version__,
        "libraries": library_versions(),
        "config": comparison.config.model_dump(mode="json"),
        "skipped": [asdict(skip) for skip in comparison.skipped],
        "notes": comparison.notes,
    }


def _write_pictures(folder: Path, comparison: Comparison) -> None:
    judged = {run.method: run.matched for run in comparison.runs if run.matched is not None}
    captions = {run.method: _caption(run) for run in comparison.runs}
    write_paths(
        folder / PATHS_VIEW,
        {run.method: run.trajectory for run in comparison.runs},
        truth=comparison.truth,
        captions=captions,
        title=f"Paths on {comparison.log}" + (", over the truth" if comparison.truth is not None else ""),
    )
    if judged:
        write_path_errors(
            folder / PATH_ERRORS_VIEW,
            {name: position_errors_m(matched) for name, matched in judged.items()},
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
    return "no truth" if run.errors is None else f"ATE {run.errors.ate_m:.3f} m"


def _by_guess(comparison: Comparison) -> dict[str, dict[str, Array]]:
    """Return the errors of all registrations; methods without use for a guess stand beside every kind."""
    methods = list(dict.fromkeys(trial.method for trial in comparison.trials))
    return {
        f"guess off by up to {guess.text}": {
            method: np.array(
                [
                    t.translation_m
                    for t in comparison.trials
                    if t.method == method and t.guess in (kind, NO_GUESS)
                ]
            )
            for method in methods
        }
        for kind, guess in enumerate(comparison.trials_config.guesses)
    }


def _errors(matched: Matched) -> PathErrors:
    return PathErrors(matched.stamps_ns, position_errors_m(matched), rotation_errors_rad(matched))


def _logged(comparison: Comparison, trial: Trial) -> tuple[int, str, dict[str, Value]]:
    """Return a trial without its times: two logs of the same comparison have the same bytes."""
    return (
        trial.target_ns,
        trial.method,
        {
            "source_ns": trial.source_ns,
            "frames_apart": trial.frames_apart,
            "guess_off_by": guess_text(comparison, trial.guess),
            "outcome": trial.outcome,
            "translation_m": trial.translation_m,
            "rotation_rad": trial.rotation_rad,
            "reason": trial.reason,
        },
    )


def _json(tree: object) -> str:
    return json.dumps(tree, indent=2, ensure_ascii=False) + "\n"
