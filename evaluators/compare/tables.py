"""The two tables of a comparison: odometry over the whole log, and registration of pairs."""

import math

from mapper.evaluators.compare.comparison import Comparison
from mapper.evaluators.compare.pairwise import registration_records
from mapper.evaluators.tables.table import Column, Table, decimals

_DEGREES = decimals(2, times=math.degrees(1.0))
_CENTIMETRES = decimals(2, times=100.0)


def tables_of(comparison: Comparison) -> list[Table]:
    """Return the table of odometry, and that of registration if there are any trials."""
    return [_odometry(comparison), *([_registration(comparison)] if comparison.trials else [])]


def _odometry(comparison: Comparison) -> Table:
    """Return one record for each method's run over the whole log."""
    step = comparison.step.text
    broken = [f"{run.method} {run.broke}" for run in comparison.runs if run.broke]
    frames = max(run.frames for run in comparison.runs)
    unread = f" ({len(comparison.skipped)} more cannot be read)" if comparison.skipped else ""
    return Table(
        columns=[
            Column("method", "method"),
            Column("ate_rmse_m", "ATE RMSE m", decimals(4)),
            Column("rpe_rmse_m", f"RPE {step} m", decimals(4)),
            Column("rpe_rmse_rad", f"RPE {step} °", _DEGREES),
            Column("drift_ratio", "drift %", decimals(1, times=100.0)),
            Column("failures", "failures"),
            Column("coverage_ratio", "coverage %", decimals(0, times=100.0)),
            Column("frames_per_s", "frames/s", decimals(1)),
        ],
        records=[
            {
                "method": run.method,
                "frames": run.frames,
                "failures": run.failures,
                "coverage_ratio": run.coverage,
                "ate_rmse_m": run.errors.ate_m,
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
    """Return one record for each method and kind of guess."""
    config = comparison.trials_config
    apart = ", ".join(map(str, config.frames_apart))
    pairs = {(trial["target_ns"], trial["source_ns"]) for trial in comparison.trials}
    return Table(
        columns=[
            Column("method", "method"),
            Column("guess_off_by", "guess off by"),
            Column("right_ratio", "right %", decimals(0, times=100.0)),
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
