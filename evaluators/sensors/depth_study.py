"""Study of a depth camera: its accuracy at every distance that its logs show, and a model of its noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.core.units import MM_PER_M
from mapper.evaluators.sensors.depth_accuracy import DepthLevel, Patch, ResidualMap, check_rgbd
from mapper.evaluators.sensors.depth_planes import depth_at, depth_of_planes
from mapper.evaluators.study.table import Column, Record, text_table
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.config import DepthNoiseConfig
from mapper.sources.base import Log

_ROUNDS = 5
_SIGNIFICANCE = 0.05

Form = Literal["disparity", "parabola"]
"""σ_z = c·z², as of a constant noise of the disparity, or a + b·z + c·z²."""

_POWERS: dict[Form, tuple[int, ...]] = {"disparity": (2,), "parabola": (0, 1, 2)}


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFit:
    """σ_z over z.

    Attributes:
        form: Terms that the polynomial has.
        noise: The coefficients a, b, c.
        uncertainty: (3,) standard errors of these from the residuals of the fit; NaN where
            there are no more measurements than coefficients.
        misfit_ratio: RMS of the measurements about the curve, as a share of it.
        low_m: Least distance that was measured.
        high_m: The largest.
    """

    form: Form
    noise: DepthNoiseConfig
    uncertainty: Array
    misfit_ratio: float
    low_m: float
    high_m: float


def fit_noise(depth_m: Array, sigma_m: Array) -> NoiseFit:
    """Fit σ_z(z) to standard deviations measured at distances, all equally sure relative to their size.

    The disparity form (Khoshelham & Elberink 2012, eq. 10) is taken unless a parabola (Nguyen et al. 2012,
    eq. 3, multiplied out) explains more than chance would give it: two more coefficients leave
    a share RSS' / RSS of the squares, and without need of them a share as small comes up with
    the probability (RSS' / RSS)^((n − 3) / 2), which is the F-test for two. A parabola that
    falls to zero at some distance is not taken either: the odometry would divide by it.

    Args:
        depth_m: (N,) distances.
        sigma_m: (N,) standard deviations.

    Raises:
        DataError: Nothing is given, or no noise is seen.
    """
    if not len(depth_m) or not (sigma_m > 0.0).all():
        raise DataError("noise: want at least one distance, with depths that scatter")
    simple, simple_squares = _fit("disparity", depth_m, sigma_m)
    free = len(np.unique(depth_m)) - len(_POWERS["parabola"])
    if free < 1:
        return simple
    try:
        full, full_squares = _fit("parabola", depth_m, sigma_m)
    except ValueError:  # from the model's own check
        return simple
    chance = (full_squares / simple_squares) ** (free / 2.0) if simple_squares > 0.0 else 1.0
    return full if chance < _SIGNIFICANCE else simple


def _fit(form: Form, depth_m: Array, sigma_m: Array) -> tuple[NoiseFit, float]:
    """Return a fit and its sum of squared relative residuals.

    Raises:
        ValueError: It is not positive at every distance.
    """
    powers = _POWERS[form]
    terms = depth_m[:, None] ** np.array(powers)
    fitted_m = sigma_m
    for _ in range(_ROUNDS):  # relative to the curve: relative to the measurements would favour small ones
        rows = terms / fitted_m[:, None]
        found, *_ = np.linalg.lstsq(rows, sigma_m / fitted_m, rcond=None)
        fitted_m = np.maximum(terms @ found, 1e-3 * sigma_m)
    squares = float((((sigma_m - terms @ found) / fitted_m) ** 2).sum())
    free = len(depth_m) - len(powers)
    errors = np.full(len(powers), np.nan)
    if free > 0:
        errors = np.sqrt(np.diag(np.linalg.pinv(rows.T @ rows)) * squares / free)
    coefficients, uncertainty = np.zeros(3), np.zeros(3)
    coefficients[list(powers)], uncertainty[list(powers)] = found, errors
    a, b, c = (float(value) for value in coefficients)
    fit = NoiseFit(
        form=form,
        noise=DepthNoiseConfig(constant_m=a, linear=b, quadratic_per_m=c),
        uncertainty=uncertainty,
        misfit_ratio=float(np.sqrt(squares / len(depth_m))),
        low_m=float(depth_m.min()),
        high_m=float(depth_m.max()),
    )
    return fit, squares


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
        keep_tilt: Whether tilt counts as error, as of :func:`~.depth_planes.depth_at`.
        most_frames: Limit of frames, as of :func:`~.depth_planes.depth_of_planes`.
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
    return f"{round(MM_PER_M * metres, digits) + 0.0:.{digits}f}"  # no -0.00


def _uncertainty_text(uncertainty: Array) -> str:
    if any(math.isnan(error) for error in uncertainty):
        return "unknown: as many coefficients as distances"
    return ", ".join(f"{error:.2g}" for error in uncertainty if error) or "0"
