"""Information of measured relative poses: the model error that features share, and inflation."""

import numpy as np

from mapper.core.geometry import Array, Transform, rotation_log

_SHARE = 0.02
"""Model error as a share of distance and angle: calibration and depth distortion, common to all pixels."""
_LEAST_M, _LEAST_RAD = 1e-3, 1e-3


def with_model_error(information: Array, T_i_j: Transform, *, scale: float = 1.0) -> Array:
    """Return the (6, 6) information of a relative pose with the errors that its features share.

    Hundreds of features with independent errors give a sigma of fractions of a millimetre. Calibration and
    depth distortion move them all alike, the more the farther apart the views: loops closed on a real Kinect
    are 1 to 2 cm off where independent errors would give 1 mm.

    Args:
        information: (6, 6) of j's tangent (rotation, translation) from the features alone.
        T_i_j: (4, 4) the measurement.
        scale: Factor on the standard deviations of that error: less than 1 where residuals show less of it.
    """
    angle_rad = float(np.linalg.norm(rotation_log(T_i_j[:3, :3])))
    distance_m = float(np.linalg.norm(T_i_j[:3, 3]))
    return inflated(
        information,
        sigma_rad=scale * (_LEAST_RAD + _SHARE * angle_rad),
        sigma_m=scale * (_LEAST_M + _SHARE * distance_m),
    )


def inflated(information: Array, *, sigma_rad: float, sigma_m: float) -> Array:
    """Return the (6, 6) information of a relative pose with an isotropic error added."""
    variances = np.square([sigma_rad] * 3 + [sigma_m] * 3)
    known = np.linalg.inv(np.linalg.inv(information) + np.diag(variances))
    return 0.5 * (known + known.T)
