"""Geodesy on WGS 84: latitude, longitude and height as metres east, north and up of an origin."""

from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array, Points

SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1.0 / 298.257223563
"""Ellipsoid of WGS 84 (NIMA TR8350.2)."""
_E2 = FLATTENING * (2.0 - FLATTENING)
_SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
_SECOND_E2 = _E2 / (1.0 - _E2)


def ecef_from_geodetic(geodetic: Array) -> Points:
    """Return Earth-centred, Earth-fixed coordinates.

    Args:
        geodetic: (N, 3) latitude and longitude in degrees, and metres above the ellipsoid.

    Returns:
        (N, 3) metres.
    """
    latitude, longitude = np.radians(geodetic[:, :2]).T
    height_m = geodetic[:, 2]
    normal_m = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    return np.column_stack(
        [
            (normal_m + height_m) * np.cos(latitude) * np.cos(longitude),
            (normal_m + height_m) * np.cos(latitude) * np.sin(longitude),
            (normal_m * (1.0 - _E2) + height_m) * np.sin(latitude),
        ]
    )


def geodetic_from_ecef(points_ecef: Points) -> Array:
    """Return (N, 3) latitude, longitude (degrees) and height (metres) of (N, 3) ECEF points.

    Closed form (Bowring 1976): to 10 km of height its error is below a micrometre. The height is that of
    Bowring (1985), which holds at the poles as well.
    """
    x, y, z = points_ecef.T
    from_axis_m = np.hypot(x, y)
    parametric = np.arctan2(z * SEMI_MAJOR_M, from_axis_m * _SEMI_MINOR_M)
    latitude = np.arctan2(
        z + _SECOND_E2 * _SEMI_MINOR_M * np.sin(parametric) ** 3,
        from_axis_m - _E2 * SEMI_MAJOR_M * np.cos(parametric) ** 3,
    )
    to_surface_m = SEMI_MAJOR_M * np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    height_m = from_axis_m * np.cos(latitude) + z * np.sin(latitude) - to_surface_m
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height_m])


@dataclass(frozen=True, slots=True)
class GeodeticOrigin:
    """Point on WGS 84 whose local tangent frame has x east, y north and z up (REP 103's ENU).

    Attributes:
        latitude_deg: Geodetic latitude, positive north.
        longitude_deg: Longitude, positive east.
        height_m: Height above the ellipsoid.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def enu(self, geodetic: Array) -> Points:
        """Return (N, 3) metres east, north and up of the origin, of (N, 3) latitudes, longitudes, heights."""
        return (ecef_from_geodetic(geodetic) - self._ecef) @ self._axes_ecef

    def geodetic(self, points_enu: Points) -> Array:
        """Return (N, 3) latitudes, longitudes (degrees) and heights (metres) of points around the origin."""
        return geodetic_from_ecef(points_enu @ self._axes_ecef.T + self._ecef)

    def moved(self, offset_enu: Array) -> "GeodeticOrigin":
        """Return the origin that lies (3,) metres east, north and up of this one."""
        return GeodeticOrigin(*self.geodetic(offset_enu[None])[0].tolist())

    @property
    def _ecef(self) -> Points:
        return ecef_from_geodetic(np.array([[self.latitude_deg, self.longitude_deg, self.height_m]]))

    @property
    def _axes_ecef(self) -> Array:
        """R_ecef_enu: its columns are east, north and up."""
        latitude, longitude = np.radians([self.latitude_deg, self.longitude_deg])
        sin_lat, cos_lat, sin_lon, cos_lon = (
            f(angle) for angle in (latitude, longitude) for f in (np.sin, np.cos)
        )
        return np.array(
            [
                [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
                [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
                [0.0, cos_lat, sin_lat],
            ]
        )
