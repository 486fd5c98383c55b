"""A registration as text for a terminal, and as files: aligned cloud, picture, JSON and a recording."""

from pathlib import Path
from typing import Any

import numpy as np

from mapper.config.register import RegisterConfig
from mapper.core.frames import Scan, Sensor
from mapper.core.geometry import apply
from mapper.evaluators.pictures.registration import write_before_and_after
from mapper.evaluators.pictures.registration_mcap import write_registration_log
from mapper.evaluators.register.registration import Registered, xyz_rpy
from mapper.export.figures import ESTIMATE
from mapper.export.mesh_files import write_ply
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, write_json

ALIGNED, PICTURE, RECORDING = "aligned.ply", "registration.png", "registration.mcap"
FOLDER = FolderKind(
    "a registration",
    manifest_keys=frozenset({"method", "trusted", "T_target_source"}),
    files=frozenset({ALIGNED, PICTURE, RECORDING}),
)


def registration_text(registered: Registered) -> str:
    """Return the motion, whether it is trusted, the distances and the times, for a terminal."""
    alignment = registered.alignment
    lines = [f"method   {registered.method}"]
    if registered.stages[-1].name == "refined":
        xyz, rpy = xyz_rpy(alignment.T_target_source)
        lines += [
            "xyz      {:.4f} {:.4f} {:.4f} m".format(*xyz),
            "rpy      {:.3f} {:.3f} {:.3f} °".format(*rpy),
            *("         " + " ".join(f"{value:10.6f}" for value in row) for row in alignment.T_target_source),
            f"agree    {alignment.pairs} pairs, {alignment.inlier_ratio:.0%}, "
            f"RMS {alignment.inlier_rmse_m:.3f} m",
        ]
    lines.append("trusted  yes" if alignment.converged else f"trusted  no: {alignment.reason}")
    lines += ["", f"{'':9}{'MHD':>9} {'MPD':>9}"]
    for stage in registered.stages:
        lines.append(f"{stage.name:<9}{stage.distance.mhd_m:7.3f} m {stage.distance.mpd_m:7.3f} m")
    times = ", ".join(f"{name} {1e3 * spent:.0f}" for name, spent in registered.seconds.items())
    return "\n".join([*lines, "", f"ms       {times}"])


def write_registration(
    folder: Path,
    registered: Registered,
    *,
    target: Scan,
    source: Scan,
    names: tuple[str, str],
    sensor: Sensor,
    config: RegisterConfig,
) -> None:
    """Write a registration's files, whether it is trusted or not.

    Args:
        folder: Existing folder.
        registered: The registration.
        target: Scan that stayed.
        source: Scan that was aligned to it.
        names: The user's names of target and source.
        sensor: Sensor that took them, which determines the direction up.
        config: Its settings.
    """
    last = registered.stages[-1]
    points_target = apply(last.T_target_source, source.points_body.astype(np.float64)).astype(np.float32)
    colors = source.colors
    if colors is None:
        colors = np.broadcast_to(np.array(ESTIMATE, np.uint8), points_target.shape)
    write_ply(folder / ALIGNED, points_target, colors)
    write_before_and_after(
        folder / PICTURE,
        target.points_body,
        source.points_body,
        [(stage.name, stage.T_target_source) for stage in registered.stages],
        sensor=sensor,
        title=f"{Path(names[1]).name} (red) on {Path(names[0]).name} (blue), {registered.method}",
    )
    write_registration_log(
        folder / RECORDING,
        target.points_body,
        source.points_body,
        [
            (
                stage.T_target_source,
                {"stage": stage.name, "mhd_m": stage.distance.mhd_m, "mpd_m": stage.distance.mpd_m},
            )
            for stage in registered.stages
        ],
    )
    record = registration_record(registered) | {
        "target": names[0],
        "source": names[1],
        "config": config.model_dump(mode="json"),
    }
    write_json(folder / MANIFEST_NAME, record)


def registration_record(registered: Registered) -> dict[str, Any]:
    """Return the entries of ``manifest.json`` on the registration itself."""
    alignment = registered.alignment
    return {
        "method": registered.method,
        "trusted": alignment.converged,
        "reason": alignment.reason,
        "T_target_source": alignment.T_target_source.tolist(),
        "inlier_ratio": alignment.inlier_ratio,
        "inlier_rmse_m": alignment.inlier_rmse_m if np.isfinite(alignment.inlier_rmse_m) else None,
        "pairs": alignment.pairs,
        "information": None if alignment.information is None else alignment.information.tolist(),
        "stages": [
            {
                "name": stage.name,
                "T_target_source": stage.T_target_source.tolist(),
                "mhd_m": stage.distance.mhd_m,
                "mpd_m": stage.distance.mpd_m,
            }
            for stage in registered.stages
        ],
        "seconds": dict(registered.seconds),
    }
