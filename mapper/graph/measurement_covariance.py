"""Uncertainty of relative poses: the chi-square gate of two, and errors that all features of one share."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Transform, inverse, length_and_angle, log

MEDIAN_CHI2 = 5.348
"""Median of χ² with six degrees of freedom."""
LIMIT_CHI2 = 22.458
"""99.9 % of χ² with six degrees of freedom (Bar-Shalom, Li & Kirubarajan 2001, §1.5.4)."""
MODEL_SHARE = 0.02
"""Model error as a share of distance and angle: calibration and depth distortion, common to all pixels."""
_LEAST = 1e-3  # metres and radians


@dataclass(frozen=True, slots=True)
class Comparison:
    """Disagreement of two relative poses, and how much of it their uncertainty explains.

    Attributes:
        translation_m: Distance between the two positions.
        rotation_rad: Angle between the two orientations.
        allowed_m: Largest distance that is likely, in the least certain direction.
        allowed_rad: Largest angle that is likely, about the least certain axis.
        sigmas: Mahalanobis distance.
    """

    translation_m: float
    rotation_rad: float
    allowed_m: float
    allowed_rad: float
    sigmas: float

    @property
    def is_possible(self) -> bool:
        """Whether both can be right."""
        return self.sigmas**2 <= LIMIT_CHI2

    def __str__(self) -> str:
        return (
            f"{self.translation_m:.2f} m and {self.rotation_rad:.2f} rad off, at most {self.allowed_m:.2f} m "
            f"and {self.allowed_rad:.2f} rad ({self.sigmas:.1f} sigma, at most {LIMIT_CHI2**0.5:.1f})"
        )


def information_of(covariance: Array) -> Array:
    """Return the symmetric inverse of a (6, 6) covariance."""
    information = np.linalg.inv(covariance)
    return np.asarray(0.5 * (information + information.T), np.float64)


def compare(
    T_i_j: Transform, T_i_j_predicted: Transform, covariance: Array, *, slack_m: float, slack_rad: float
) -> Comparison:
    """Return how far a relative pose is from its prediction.

    Args:
        T_i_j: (4, 4) measured.
        T_i_j_predicted: (4, 4) predicted.
        covariance: (6, 6) of both together, in j's tangent (rotation, translation), rad² and m².
        slack_m: Distance that is possible without any uncertainty: errors that no covariance describes.
        slack_rad: Angle that is possible without any uncertainty.
    """
    miss = inverse(T_i_j) @ T_i_j_predicted
    twist = np.concatenate(log(miss))
    slack = np.square([slack_rad] * 3 + [slack_m] * 3) / LIMIT_CHI2
    total = covariance + np.diag(slack)
    allowed_rad, allowed_m = (
        float(np.sqrt(LIMIT_CHI2 * np.linalg.eigvalsh(block)[-1])) for block in (total[:3, :3], total[3:, 3:])
    )
    return Comparison(
        float(np.linalg.norm(miss[:3, 3])),
        float(np.linalg.norm(twist[:3])),
        allowed_m,
        allowed_rad,
        float(np.sqrt(twist @ np.linalg.solve(total, twist))),
    )


def with_model_error(information: Array, T_i_j: Transform) -> Array:
    """Return the (6, 6) information of a relative pose with the errors that its features share.

    Hundreds of features with independent errors give a sigma of fractions of a millimetre. Calibration and
    depth distortion move them all alike, the more the farther apart the views: loops closed on a real Kinect
    are 1 to 2 cm off where independent errors would give 1 mm.

    Args:
        information: (6, 6) of j's tangent (rotation, translation) from the features alone.
        T_i_j: (4, 4) the measurement.
    """
    distance_m, angle_rad = length_and_angle(T_i_j)
    return inflated(
        information,
        sigma_rad=_LEAST + MODEL_SHARE * angle_rad,
        sigma_m=_LEAST + MODEL_SHARE * distance_m,
    )


def inflated(information: Array, *, sigma_rad: float, sigma_m: float) -> Array:
    """Return the (6, 6) information of a relative pose with an isotropic error added."""
    variances = np.square([sigma_rad] * 3 + [sigma_m] * 3)
    known = np.linalg.inv(np.linalg.inv(information) + np.diag(variances))
    return 0.5 * (known + known.T)
