"""Settings of a depth sensor's noise."""

import math
from typing import Self

from pydantic import NonNegativeFloat, model_validator

from mapper.core.config import Config


class DepthNoiseConfig(Config):
    """Depth noise σ_z = a + b·z + c·z², as ``mapper sensor depth`` fits it to planes.

    A sensor that triangulates has a = b = 0 and c = σ_disparity / bf (Khoshelham & Elberink 2012, eq. 10).
    """

    constant_m: NonNegativeFloat = 0.0
    """a: noise at any depth."""
    linear: float = 0.0
    """b: additional noise, in metres per metre of depth."""
    quadratic_per_m: NonNegativeFloat = 0.0
    """c: additional noise, in metres per square metre of depth."""

    @model_validator(mode="after")
    def _is_positive(self) -> Self:
        least = -2.0 * math.sqrt(self.constant_m * self.quadratic_per_m)
        some = max(self.constant_m, self.linear, self.quadratic_per_m) > 0.0
        if not some or self.linear < least or (self.linear == least and least < 0.0):
            raise ValueError(f"σ_z = {self.text} m is not > 0 at every depth; leave the noise out instead")
        return self

    @property
    def text(self) -> str:
        """The formula, in metres."""
        terms = {"": self.constant_m, "·z": self.linear, "·z²": self.quadratic_per_m}
        signed = [f"{'−' if value < 0.0 else '+'} {abs(value):.3g}{z}" for z, value in terms.items() if value]
        return " ".join(signed).removeprefix("+ ") or "0"


KINECT_NOISE = DepthNoiseConfig(constant_m=0.0015, linear=-0.0015, quadratic_per_m=0.0019)
"""σ_z = 1.2 mm + 1.9 mm/m² · (z − 0.4 m)² (Nguyen, Izadi & Lovell 2012, eq. 3)."""
