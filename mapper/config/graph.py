"""How the pose graph is solved."""

from typing import Literal

from pydantic import PositiveFloat, PositiveInt

from mapper.config.base import Config

Robust = Literal["gnc", "cauchy", "huber", "dcs", "none"]


class GraphConfig(Config):
    """The back end."""

    solve: Literal["batch", "none"] = "batch"
    """"batch": Levenberg–Marquardt on every factor; "none": keep the odometry's own estimate (A7)."""
    robust: Robust = "gnc"
    """What keeps false loops from bending the map: "gnc" decides about each (Yang et al. 2020), the kernels
    "cauchy", "huber" and "dcs" (Agarwal et al. 2013) weigh each by its residual, "none" believes all.
    Odometry and wheels are always believed."""
    robust_width: PositiveFloat = 4.1
    """Residual, in sigmas of all six directions together, from which a loop counts less ("gnc": not at
    all). 99 % of honest measurements lie within 4.1."""
    max_iterations: PositiveInt = 100
    relative_error: PositiveFloat = 1e-8
    """Stop when an iteration improves the error by less than this share."""
