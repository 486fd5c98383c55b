"""Recording of a comparison as one MCAP file: every method's path, its errors over time, and every trial."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.odometry import OdometryRun
from mapper.export.figures import TRUTH, color_of
from mapper.export.mcap_log import McapLog


def write_comparison_log(
    path: Path,
    runs: Sequence[OdometryRun],
    *,
    truth: Trajectory | None,
    trials: Sequence[Mapping[str, Any]],
) -> None:
    """Write /trajectory/NAME for every method and the truth, /errors/NAME, and /trials/NAME.

    Args:
        path: MCAP file to write.
        runs: Every method's; one without poses is left out.
        truth: True poses of the body.
        trials: A record of every registration. Its times are left out, so that the same comparison gives the
            same bytes.
    """
    with McapLog(path) as log:
        starts = [int(run.trajectory.stamps_ns[0]) for run in runs if len(run.trajectory)]
        if truth is not None and starts:
            log.trajectory(min(starts), truth, name="truth", color=TRUTH)
        for number, run in enumerate(runs):
            if len(run.trajectory):
                log.trajectory(min(starts), run.trajectory, name=run.method, color=color_of(number))
        for run in runs:
            if run.matched is None:
                continue
            rows = zip(
                run.matched.stamps_ns.tolist(),
                run.matched.position_errors_m.tolist(),
                run.matched.rotation_errors_rad.tolist(),
                strict=True,
            )
            for stamp_ns, position_m, rotation_rad in rows:
                log.record(
                    f"/errors/{run.method}",
                    "mapper/msg/PathError",
                    stamp_ns,
                    {"position_m": position_m, "rotation_rad": rotation_rad},
                )
        for trial in trials:
            log.record(
                f"/trials/{trial['method']}",
                "mapper/msg/Trial",
                trial["target_ns"],
                {
                    "source_ns": trial["source_ns"],
                    "frames_apart": trial["frames_apart"],
                    "guess_off_by": trial["guess"],
                    "outcome": trial["outcome"],
                    "translation_m": _known(trial["translation_m"]),
                    "rotation_rad": _known(trial["rotation_rad"]),
                    "reason": trial["reason"],
                },
            )


def _known(error: float | None) -> float:
    return np.inf if error is None else error
