"""One registration, step by step (`mapper register`): its motion, distances and time, and its files."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mapper.config.register import RegisterConfig
from mapper.core.frames import Frame, Scan, Sensor
from mapper.core.geometry import Transform
from mapper.evaluators.metrics.map_quality import CloudDistance, DistanceTo
from mapper.evaluators.pictures.registration import write_before_and_after, write_registration_log
from mapper.export.figures import ESTIMATE
from mapper.export.mesh_files import write_ply
from mapper.odometry.config import IsvdOdometryConfig
from mapper.registration.base import Alignment
from mapper.registration.config import AnyRegistration
from mapper.registration.factory import aligner_to
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, write_json

_WARM_UP_STRIDE = 10


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """The clouds after one step.

    Attributes:
        name: "before", "Hough" or "refined".
        T_target_source: (4, 4) the motion by then.
        distance: Distance of the source from the target under it.
    """

    name: str
    T_target_source: Transform
    distance: CloudDistance


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """A registration, step by step.

    Attributes:
        method: Its name in the configuration.
        alignment: The answer.
        stages: Stages from the beginning on; without "refined" where there was no answer at all.
        seconds: Wall time of each step, in order.
        cpu_s: CPU time of all steps, which other programs do not change.
    """

    method: str
    alignment: Alignment
    stages: tuple[Stage, ...]
    seconds: Mapping[str, float]
    cpu_s: float


def register(
    target: Frame,
    source: Frame,
    config: AnyRegistration | IsvdOdometryConfig,
    T_target_source: Transform,
) -> Registered:
    """Register two frames, and return the course of it.

    Args:
        target: Frame that stays.
        source: Frame that is aligned to it.
        config: The method.
        T_target_source: (4, 4) guess, for methods that refine one.

    Raises:
        ConfigError: A method of images was given scans.
        DataError: A frame without points.
    """
    scans = target.scan(), source.scan()
    hough = None
    if isinstance(config, IsvdOdometryConfig):
        began = time.process_time()
        from mapper.odometry.isvd.odometry import align_images

        alignment, seconds = align_images(target, source, config)
    else:
        # Loads libraries and compiled code, which is no step's time.
        _by_scans(_thinned(scans[0]), _thinned(scans[1]), config, T_target_source)
        began = time.process_time()
        alignment, hough, seconds = _by_scans(*scans, config, T_target_source)
    cpu_s = time.process_time() - began
    motions = {"before": T_target_source}
    if hough is not None:
        motions["Hough"] = hough
    if alignment.converged or alignment.information is not None:
        motions["refined"] = alignment.T_target_source
    distance = distance_to(scans[0])
    stages = (Stage(name, T, distance.of(scans[1].points_body, T)) for name, T in motions.items())
    return Registered(config.kind, alignment, tuple(stages), seconds, cpu_s)


@lru_cache(maxsize=1)
def distance_to(target: Scan) -> DistanceTo:
    """Return what measures distances from a scan's points; that of the last scan is kept."""
    return DistanceTo(target.points_body)


def _by_scans(
    target: Scan, source: Scan, config: AnyRegistration, T_target_source: Transform
) -> tuple[Alignment, Transform | None, dict[str, float]]:
    """Return the answer, Hough's own where the method has that stage, and the time of every step."""
    began = time.perf_counter()
    if isinstance(config, HoughGicpConfig | HoughNdtConfig):
        from mapper.registration.hough.aligner import Hough

        voter = Hough(target, config)
        prepared = time.perf_counter()
        course = voter.stages(source)
        hough = None if course.hough is None else course.hough.T_target_source
        return course.alignment, hough, {"prepare": prepared - began, **course.seconds}
    aligner = aligner_to(target, config)
    prepared = time.perf_counter()
    alignment = aligner.align(source, T_target_source)
    return alignment, None, {"prepare": prepared - began, "align": time.perf_counter() - prepared}


def _thinned(scan: Scan) -> Scan:
    """Return every tenth point of a scan, for a first run that loads and compiles what the method needs."""
    # A view with gaps would have kernels compiled for itself and none for whole scans.
    return Scan(scan.stamp_ns, np.ascontiguousarray(scan.points_body[::_WARM_UP_STRIDE]))


def xyz_rpy(T_a_b: Transform) -> tuple[list[float], list[float]]:
    """Return a pose as metres and as roll, pitch, yaw in degrees, for a screen or a file."""
    from mapper.core.rotations import euler_from_rotation

    return T_a_b[:3, 3].tolist(), np.degrees(euler_from_rotation(T_a_b[:3, :3])).tolist()


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
    points_target = source.moved(last.T_target_source).points_body
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
