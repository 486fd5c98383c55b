"""2D maps as pictures with world files, and the path as GeoJSON, by which programs for GIS place them."""

import json
from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np

from mapper.core.geodesy import GeodeticOrigin
from mapper.core.trajectory import Trajectory
from mapper.export.crs import place_of, wkt_of
from mapper.export.export_folders import export_folder
from mapper.export.grid import encode_png, grid_image
from mapper.octree.grid import UNKNOWN, OccupancyGrid
from mapper.run.folder import Run
from mapper.run.map_folder import MapFolder
from mapper.runtime.atomic import write_bytes, write_text
from mapper.runtime.progress import Progress

_FILES = ("*.png", "*.pgw", "*.prj", "*.png.aux.xml", "trajectory.geojson")


def gis(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write a folder of PNGs with world files: a pixel a cell, transparent where unknown.

    Where GNSS placed the map each has its reference system (``.prj`` and, for GDAL, ``.png.aux.xml``), and
    the path is in ``trajectory.geojson``. The folder replaces an earlier one.

    Raises:
        RunError: PATH holds something else.
    """
    grids = {"slice": run.slice, "traversable": run.traversable, "keepout": run.keepout}
    place = place_of(run)
    with export_folder(run, path, "gis", files=_FILES) as folder:
        if place is not None and isinstance(run, Run):
            write_text(folder / "trajectory.geojson", _geojson(run.trajectory, place.origin))
        for stem, grid in grids.items():
            if grid is not None:
                alpha = np.where(grid.cells == UNKNOWN, 0, 255).astype(np.uint8)
                rgba = np.dstack([grid_image(grid), alpha])[::-1]
                picture = folder / f"{stem}.png"
                write_bytes(picture, encode_png(picture, cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA)))
                write_text(folder / f"{stem}.pgw", _world_file(grid))
                if place is not None:
                    wkt = wkt_of(place)
                    write_text(folder / f"{stem}.prj", wkt + "\n")
                    aux = f"<PAMDataset><SRS>{escape(wkt)}</SRS></PAMDataset>\n"
                    write_text(folder / f"{stem}.png.aux.xml", aux)


def _geojson(trajectory: Trajectory, origin: GeodeticOrigin) -> str:
    """Return a path as GeoJSON (RFC 7946): longitude, latitude and height of the body at every stamp."""
    places = origin.geodetic(trajectory.positions_world)[:, [1, 0, 2]]
    feature = {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": places.tolist()},
        "properties": {"stamps_ns": trajectory.stamps_ns.tolist()},
    }
    return json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n"


def _world_file(grid: OccupancyGrid) -> str:
    """Return a pixel's width, two shears, minus its height, and x and y of the upper left one's centre."""
    size_m, (x, y) = float(grid.resolution_m), grid.origin_world_m.tolist()
    top = y + (len(grid.cells) - 0.5) * size_m
    return "".join(f"{value!r}\n" for value in (size_m, 0.0, 0.0, -size_m, x + 0.5 * size_m, top))
