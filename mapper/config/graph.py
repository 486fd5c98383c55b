"""How the pose graph is solved."""

from typing import Literal

from pydantic import PositiveFloat, PositiveInt

from mapper.config.base import Config


class GraphConfig(Config):
    """The back end."""

    solve: Literal["batch", "none"] = "batch"
    """"batch": Levenberg–Marquardt on every factor; "none": keep the odometry's own estimate (A7)."""
    max_iterations: PositiveInt = 100
    relative_error: PositiveFloat = 1e-8
    """Stop when an iteration improves the error by less than this share."""
