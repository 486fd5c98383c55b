"""How the pose graph is solved."""

from typing import Literal

from pydantic import PositiveFloat, PositiveInt

from mapper.config.base import Config

KernelKind = Literal["cauchy", "huber", "dcs"]


class GraphConfig(Config):
    """The back end."""

    solve: Literal["batch", "proportional", "none"] = "batch"
    """"batch": least squares over all factors, by GTSAM; "proportional": each loop is spread along the path
    in turn (A9); "none": keep the odometry's own estimate (A7)."""
    robust: Literal["gnc", "none"] | KernelKind = "gnc"
    """What keeps false loops from bending the map: "gnc" decides about each (Yang et al. 2020), the kernels
    "cauchy", "huber" and "dcs" (Agarwal et al. 2013) weigh each by its residual, "none" believes all.
    Odometry and wheels are always believed."""
    robust_width: PositiveFloat = 4.1
    """Residual, in sigmas of all six directions together, from which a loop counts less. 99 % of honest
    measurements lie within 4.1. "gnc" lets none count beyond, but widens it for all by as much as the
    median loop shows information to be over-confident."""
    initial: Literal["auto", "given", "chordal"] = "auto"
    """Where the batch solve begins: at the "given" estimates, at a "chordal" relaxation that needs none, or
    "auto": at the relaxation where the estimates fit badly, nothing is in doubt, and it serves better."""
    max_iterations: PositiveInt = 100
    """Of each connected component's last descent."""
    relative_error: PositiveFloat = 1e-8
    """Stop when an iteration improves the error by less than this share."""
