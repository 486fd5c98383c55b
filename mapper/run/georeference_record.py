"""Record of where on Earth a map is, for the manifest."""

import numpy as np

from mapper.core.config import Config
from mapper.core.geodesy import GeodeticOrigin


class Georeference(Config):
    """Place of the map on Earth: x east, y north and z up of a point on WGS 84."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    """Height of the map's z = 0 above the ellipsoid."""
    is_corrected: bool
    """Whether fixes are factors of the graph; else the path has its own shape."""
    fixes: int
    """Number of fixes along the path, at most one a node."""
    outliers: int
    """Number of these that the graph rejected."""
    residual_before_m: float
    """Median distance of the fixes from the path as it was without them."""
    residual_m: float
    """The same of those that hold, from the path as it is."""
    heading_sigma_rad: float
    has_antenna: bool
    """Whether the log states where the antenna is; else it is at the body's origin."""

    @property
    def sentence(self) -> str:
        """A sentence for the user."""
        done = "the path was corrected by them" if self.is_corrected else "the path agrees with them"
        antenna = "" if self.has_antenna else "; the antenna's place is not stated, and taken as the sensor's"
        return (
            f"the map is in east, north, up of {self.latitude_deg:.7f}°, {self.longitude_deg:.7f}°, "
            f"{self.height_m:.2f} m; {done}: {self.fixes} fixes, {self.outliers} outliers, median residual "
            f"{self.residual_before_m:.2f} → {self.residual_m:.2f} m, heading to "
            f"{np.degrees(self.heading_sigma_rad):.1f}°{antenna}"
        )

    @property
    def origin(self) -> GeodeticOrigin:
        """The point."""
        return GeodeticOrigin(self.latitude_deg, self.longitude_deg, self.height_m)
