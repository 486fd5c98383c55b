"""The two tables of a comparison: odometry over the whole log, and registration of pairs."""

import math
from collections.abc import Callable, Sequence
from textwrap import fill

from evaluators.compare.comparison import Comparison
from evaluators.compare.pairwise import registration_records
from evaluators.tables.table import Column, Record, text_table

_LINE_WIDTH = 110


def _decimals(count: int, *, times: float = 1.0) -> Callable[[float], str]:
    return lambda value: f"{times * value:.{count}f}"


_DEGREES = _decimals(2, times=math.degrees(1.0))
_PERCENT = _decimals(1, times=100.0)
_WHOLE_PERCENT = _decimals(0, times=100.0)
_METRES = _decimals(4)
_CENTIMETRES = _decimals(2, times=100.0)
_ONE_DECIMAL = _decimals(1)


def odometry_records(comparison: Comparison) -> list[Record]:
    """Return one record for each method's run over the whole log."""
    records: list[Record] = []
    for run in comparison.runs:
        errors = run.errors
        records.append(
            {
                "method": run.method,
                "frames": run.frames,
                "failures": run.failures,
                "coverage_ratio": run.coverage,
                "ate_rmse_m": errors.ate_m if errors else None,
                "rpe_rmse_m": errors.rpe_m if errors else None,
                "rpe_rmse_rad": errors.rpe_rad if errors else None,
                "drift_ratio": errors.drift_ratio if errors else None,
                "frames_per_s": run.frames_per_s,
                "broke": run.broke,
            }
        )
    return records


def odometry_columns(comparison: Comparison) -> list[Column]:
    """Return what is shown of each method's run over the whole log."""
    step = comparison.step.text
    return [
        Column("method", "method"),
        Column("ate_rmse_m", "ATE RMSE m", _METRES),
        Column("rpe_rmse_m", f"RPE {step} m", _METRES),
        Column("rpe_rmse_rad", f"RPE {step} °", _DEGREES),
        Column("drift_ratio", "drift %", _PERCENT),
        Column("failures", "failures"),
        Column("coverage_ratio", "coverage %", _WHOLE_PERCENT),
        Column("frames_per_s", "frames/s", _ONE_DECIMAL),
    ]


REGISTRATION_COLUMNS = (
    Column("method", "method"),
    Column("guess_off_by", "guess off by"),
    Column("right_ratio", "right %", _WHOLE_PERCENT),
    Column("wrong", "wrong"),
    Column("no_answer", "no answer"),
    Column("median_m", "median cm", _CENTIMETRES),
    Column("p95_m", "95 % cm", _CENTIMETRES),
    Column("median_rad", "median °", _DEGREES),
    Column("p95_rad", "95 % °", _DEGREES),
    Column("prepare_ms", "prepare ms", _ONE_DECIMAL),
    Column("align_ms", "align ms", _ONE_DECIMAL),
)


def odometry_notes(comparison: Comparison) -> list[str]:
    """Return what must be known to read the first table, a sentence each."""
    broken = [f"{run.method} {run.broke}" for run in comparison.runs if run.broke]
    frames = max(run.frames for run in comparison.runs)
    unread = f" ({len(comparison.skipped)} more cannot be read)" if comparison.skipped else ""
    return [
        f"{frames} frames of {comparison.log}{unread}; paths SE(3)-aligned; drift: error of the translation "
        "over stretches of a tenth to a half of the path",
        "no loops and no solve; registrations go from frame to frame, from the motion before, which also "
        "carries on where one fails",
        f"frames/s: of the method alone, by CPU time, so on one core; reading a frame takes "
        f"{comparison.read_ms:.1f} ms more, making its scan {comparison.scan_ms:.1f} ms",
        *broken,
        *comparison.notes,
    ]


def registration_notes(comparison: Comparison) -> list[str]:
    """Return what must be known to read the second table, a sentence each."""
    config = comparison.trials_config
    apart = ", ".join(map(str, config.frames_apart))
    pairs = {(trial["target_ns"], trial["source_ns"]) for trial in comparison.trials}
    return [
        f"{len(pairs)} pairs, {apart} frames apart; guesses are off by up to as much, "
        f"seed {comparison.config.seed}",
        f"right: within {config.max_error_m:g} m and {math.degrees(config.max_error_rad):.3g}° of the truth; "
        "wrong: farther off, but trusted; median and 95 % are of the right ones only",
        "prepare: CPU time that the target alone takes; align: the rest",
    ]


def tables_text(comparison: Comparison) -> str:
    """Return both tables for a terminal, with what must be known to read them indented below."""
    parts = [text_table(odometry_columns(comparison), odometry_records(comparison))]
    parts += _indented(odometry_notes(comparison))
    if comparison.trials:
        parts.append(text_table(REGISTRATION_COLUMNS, registration_records(comparison.trials)))
        parts += _indented(registration_notes(comparison))
    return "\n".join(parts)


def _indented(notes: Sequence[str]) -> list[str]:
    return [fill(note, _LINE_WIDTH, initial_indent="  ", subsequent_indent="    ") for note in notes]
