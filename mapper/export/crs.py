"""Coordinate reference system of a map on Earth, as text that GIS and programs for point clouds read."""

from mapper.core.geodesy import FLATTENING, SEMI_MAJOR_M
from mapper.run.folder import Run
from mapper.run.georeference_record import Georeference
from mapper.run.map_folder import MapFolder

_MEAN_RADIUS_M = 6_371_008.8  # of the ellipsoid (IUGG)


def place_of(run: MapFolder) -> Georeference | None:
    """Return where a map is on Earth; None of a merged map, and where no fixes placed it."""
    return run.manifest.georeference if isinstance(run, Run) else None


def scale_of(place: Georeference) -> float:
    """Return the scale of the projection at the map's height."""
    return 1.0 + place.height_m / _MEAN_RADIUS_M


def wkt_of(place: Georeference) -> str:
    """Return a transverse Mercator projection about the map's origin as WKT 1 (OGC 01-009).

    Its coordinates are the map's x and y, so nothing is moved into the large numbers of a UTM zone: with the
    scale of the map's height the two differ by less than 1 mm at 3 km from the origin, and by 8 mm at 10 km.
    Heights are the map's own, which is flat: the ellipsoid falls away from it by 8 cm at 1 km.
    """
    parameters = {
        "latitude_of_origin": place.latitude_deg,
        "central_meridian": place.longitude_deg,
        "scale_factor": scale_of(place),
        "false_easting": 0.0,
        "false_northing": 0.0,
    }
    listed = ",".join(f'PARAMETER["{name}",{value!r}]' for name, value in parameters.items())
    return (
        'PROJCS["local transverse Mercator of a map",GEOGCS["WGS 84",DATUM["WGS_1984",'
        f'SPHEROID["WGS 84",{SEMI_MAJOR_M!r},{1.0 / FLATTENING!r},AUTHORITY["EPSG","7030"]],'
        'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0.0],UNIT["degree",0.0174532925199433],'
        f'AUTHORITY["EPSG","4326"]],PROJECTION["Transverse_Mercator"],{listed},UNIT["metre",1.0],'
        'AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    )
