"""Study of a depth camera: its accuracy at every distance that its logs show, and a model of its noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array
from mapper.evaluators.depth_camera.accuracy import DepthLevel, Patch, ResidualMap, check_rgbd
from mapper.evaluators.depth_camera.noise_fit import NoiseFit, fit_noise
from mapper.evaluators.depth_camera.still import depth_at
from mapper.evaluators.depth_camera.tiles import depth_of_planes
from mapper.evaluators.tables.table import Column, Record, text_table
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

_MM = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class DepthStudy:
    """Accuracy and noise of a depth camera by its logs.

    Attributes:
        logs: Logs that were measured.
        is_known: Whether the planes' distances were given, rather than fitted.
        levels: Distances from near to far.
        fit: The noise before DIF.
        maps: Errors by position in the image.
    """

    logs: Sequence[str]
    is_known: bool
    levels: Sequence[DepthLevel]
    fit: NoiseFit
    maps: Sequence[ResidualMap]


def study_depth(
    sources: Sequence[Log],
    distances_m: Sequence[float] | None,
    *,
    patch: Patch | None = None,
    keep_tilt: bool = False,
    most_frames: int | None = None,
    progress: Progress = SILENT,
) -> DepthStudy:
    """Measure a depth camera by its logs, and fit its noise.

    Args:
        sources: RGB-D logs of one camera.
        distances_m: Distance of the plane before which the camera stands in each log; None searches for
            planes.
        patch: Part of the image that is used; None is the usual one.
        keep_tilt: Whether tilt counts as error, as of :func:`mapper.evaluators.depth_camera.still.depth_at`.
        most_frames: Limit of frames, as of :func:`mapper.evaluators.depth_camera.tiles.depth_of_planes`.
        progress: Receives stages, counts and notes.

    Raises:
        DataError: A log does not show what it should, or depths that do not scatter.
        SourceError: A log has no depth images that can be read.
    """
    for source in sources:
        check_rgbd(source)
    levels: list[DepthLevel] = []
    maps: list[tuple[float, ResidualMap]] = []
    if distances_m is None:
        for source in sources:
            found, picture = depth_of_planes(source, patch=patch, most_frames=most_frames, progress=progress)
            levels += found
            maps.append((0.0, picture))
    else:
        for source, distance_m in zip(sources, distances_m, strict=True):
            level, picture = depth_at(source, distance_m, patch=patch, keep_tilt=keep_tilt, progress=progress)
            levels.append(level)
            maps.append((distance_m, picture))
    levels.sort(key=lambda level: level.typical.distance_m)
    return DepthStudy(
        logs=[source.name for source in sources],
        is_known=distances_m is not None,
        levels=levels,
        fit=fit_noise(
            np.array([level.typical.distance_m for level in levels]),
            np.array([level.typical.raw.std_m for level in levels]),
        ),
        maps=[picture for _, picture in sorted(maps, key=lambda pair: pair[0])],
    )


def records_of(study: DepthStudy) -> list[Record]:
    """Return a record for every distance."""
    return [
        {
            "log": level.name,
            "distance_m": seen.distance_m,
            "frames": level.frames,
            "planes": level.planes,
            "measured_ratio": seen.measured_ratio,
            "tilt_rad": seen.tilt_rad,
            "max_error_m": seen.raw.max_error_m,
            "max_error_99_m": seen.raw.max_error_99_m,
            "std_m": seen.raw.std_m,
            "dif_max_error_m": seen.filtered.max_error_m,
            "dif_max_error_99_m": seen.filtered.max_error_99_m,
            "dif_std_m": seen.filtered.std_m,
            "mean_error_m": seen.raw.mean_error_m if study.is_known else None,
            "temporal_m": level.temporal_m,
            "fixed_m": level.fixed_m,
            "step_m": seen.step_m,
        }
        for level in study.levels
        for seen in [level.typical]
    ]


def depth_text(study: DepthStudy) -> str:
    """Return the table and the noise model, for a terminal."""
    columns = [
        Column("distance_m", "d, m", "{:.3g}".format),
        Column("frames", "frames"),
        Column("planes", "planes"),
        Column("tilt_rad", "tilt °", lambda rad: f"{math.degrees(rad):.1f}"),
        Column("max_error_m", "Δd mm", _mm),
        Column("max_error_99_m", "99 %", _mm),
        Column("dif_max_error_m", "DIF Δd", _mm),
        Column("dif_max_error_99_m", "99 %", _mm),
        Column("mean_error_m", "bias", _mm),
        Column("std_m", "s mm", _mm),
        Column("dif_std_m", "DIF s", _mm),
        Column("temporal_m", "in time", _mm),
        Column("fixed_m", "fixed", _mm),
        Column("step_m", "step", _mm),
    ]
    fit = study.fit
    return "\n".join(
        [
            text_table(columns, records_of(study)),
            "",
            f"noise  σ_z = {fit.noise.text} m at {fit.low_m:.2g} … {fit.high_m:.2g} m",
            f"       ± {_uncertainty_text(fit.uncertainty)}; the distances lie {fit.misfit_ratio:.1%} off it",
        ]
    )


def _mm(metres: float) -> str:
    digits = 2 if abs(metres) < 0.01 else 1
    return f"{round(_MM * metres, digits) + 0.0:.{digits}f}"  # no -0.00


def _uncertainty_text(uncertainty: Array) -> str:
    if any(math.isnan(error) for error in uncertainty):
        return "unknown: as many coefficients as distances"
    return ", ".join(f"{error:.2g}" for error in uncertainty if error) or "0"
