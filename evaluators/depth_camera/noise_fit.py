"""Fit of a depth camera's noise as a function of the distance."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.sensing.config import DepthNoiseConfig

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
