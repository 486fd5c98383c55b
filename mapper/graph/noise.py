"""How much a measured relative pose may be trusted."""

import numpy as np

from mapper.core.geometry import Array, Transform, rotation_log

_SHARE = 0.02
"""Of distance and angle: what calibration and depth distortion leave wrong, however many pixels agree."""
_LEAST_M, _LEAST_RAD = 1e-3, 1e-3


def with_model_error(information: Array, T_i_j: Transform) -> Array:
    """Return the (6, 6) information of a relative pose with the errors that its pixels share.

    Features vote as if their errors were independent, so hundreds of them claim fractions of a millimetre.
    Calibration and depth distortion move them all alike, the more the farther apart the views: loops
    closed on a real Kinect lie 1 to 2 cm off where their features claim 1 mm.

    Args:
        information: (6, 6) of j's tangent (rotation, translation) from the features alone.
        T_i_j: (4, 4) the measurement.
    """
    angle_rad = float(np.linalg.norm(rotation_log(T_i_j[:3, :3])))
    distance_m = float(np.linalg.norm(T_i_j[:3, 3]))
    return inflated(
        information,
        sigma_rad=_LEAST_RAD + _SHARE * angle_rad,
        sigma_m=_LEAST_M + _SHARE * distance_m,
    )


def inflated(information: Array, *, sigma_rad: float, sigma_m: float) -> Array:
    """Return the (6, 6) information of a relative pose with another error on top, the same each way."""
    variances = np.square([sigma_rad] * 3 + [sigma_m] * 3)
    known = np.linalg.inv(np.linalg.inv(information) + np.diag(variances))
    symmetric: Array = 0.5 * (known + known.T)
    return symmetric
