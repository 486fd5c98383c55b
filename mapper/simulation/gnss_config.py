"""Settings of a simulated GNSS receiver."""

from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapper.core.config import Config


class SynthGnssConfig(Config):
    """GNSS receiver on the vehicle; by default a single-frequency one under open sky."""

    rate_hz: PositiveFloat = 5.0
    noise_m: NonNegativeFloat = 0.5
    """Standard deviation of each fix along east and north; twice as much along up, as in all that follows."""
    bias_m: NonNegativeFloat = 1.0
    """Standard deviation of an error that many fixes have in common (a Gauss-Markov process)."""
    bias_s: PositiveFloat = 100.0
    """Time in which that error changes."""
    multipath_start_s: NonNegativeFloat = 0.0
    multipath_duration_s: NonNegativeFloat = 0.0
    """Duration for which reflections move all fixes; the receiver does not notice."""
    multipath_m: NonNegativeFloat = 15.0
    outage_start_s: NonNegativeFloat = 0.0
    outage_duration_s: NonNegativeFloat = 0.0
    """Duration for which there are no fixes."""
    antenna_body: tuple[float, float, float] = (-0.3, 0.1, 0.4)
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] = 47.4979
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = 19.0402
    height_m: float = 150.0
    """Place of the scene's origin above the ellipsoid."""
    heading_rad: float = 0.7
    """Angle of the scene's x from east towards north."""
