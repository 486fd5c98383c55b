"""The coloured cloud in files of viewers (PLY), surveys (LAS, LAZ, E57), PCL (PCD) and Autoware (tiles)."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.timebase import NS_PER_S
from mapper.export.crs import place_of, scale_of, wkt_of
from mapper.export.export_folders import export_folder
from mapper.export.mesh_files import write_cloud
from mapper.export.part_of_run import in_map
from mapper.octree.attributes import NEVER_SEEN
from mapper.run.folder import Run
from mapper.run.georeference_record import Georeference
from mapper.runtime.atomic import write_text
from mapper.runtime.progress import Progress
from mapper.sources.cloud_files.las import write_las
from mapper.sources.cloud_files.pcd import write_pcd
from mapper.sources.scan_folders.e57 import write_e57

_AUTOWARE_FILES = ("pointcloud_map.pcd", "pointcloud_map_metadata.yaml", "map_projector_info.yaml")
_TILE_M = 20  # as Autoware's map loader recommends; its corners are whole metres


def ply(run: Run, path: Path, _progress: Progress) -> None:
    """Write PLY."""
    write_cloud(path, run.cloud)


def las(run: Run, path: Path, _progress: Progress) -> None:
    """Write LAS, or LAZ if the name ends so, with the reference system of a map whose place is known."""
    place = place_of(run)
    write_las(path, columns_of(run), wkt=None if place is None else wkt_of(place))


def pcd(run: Run, path: Path, _progress: Progress) -> None:
    """Write PCD with PCL's packed colours."""
    write_pcd(path, columns_of(run))


def e57(run: Run, path: Path, _progress: Progress) -> None:
    """Write E57 as one scan, with colours and intensities; its GUIDs are new each time.

    Raises:
        DependencyError: The extra is not installed.
    """
    write_e57(path, run.cloud, name=run.path.name)


def autoware(run: Run, path: Path, _progress: Progress) -> None:
    """Write the folder that Autoware takes as ``map_path``, without a Lanelet2 map.

    Raises:
        RunError: PATH holds something else; an earlier folder is replaced.
    """
    columns, place = columns_of(run), place_of(run)
    corners = np.floor(np.column_stack([columns["x"], columns["y"]]) / _TILE_M).astype(int) * _TILE_M
    tiles, tile_of = np.unique(corners, axis=0, return_inverse=True)
    metadata = [f"{axis}_resolution: {_TILE_M:.1f}" for axis in "xy"]
    with export_folder(run, path, "autoware", files=_AUTOWARE_FILES) as folder:
        for number, (x, y) in enumerate(tiles.tolist()):
            inside = tile_of.ravel() == number
            tile = {name: values[inside] for name, values in columns.items()}
            write_pcd(folder / _AUTOWARE_FILES[0] / f"{x}_{y}.pcd", tile)
            metadata.append(f"{x}_{y}.pcd: [{x}, {y}]")
        write_text(folder / _AUTOWARE_FILES[1], "\n".join(metadata) + "\n")
        write_text(folder / _AUTOWARE_FILES[2], _projector(place))


def _projector(place: Georeference | None) -> str:
    """Return Autoware's ``map_projector_info.yaml``."""
    if place is None:
        return "projector_type: Local\n"
    return (
        f"projector_type: TransverseMercator\nvertical_datum: WGS84\nscale_factor: {scale_of(place)!r}\n"
        f"map_origin:\n  latitude: {place.latitude_deg!r}\n  longitude: {place.longitude_deg!r}\n"
    )


def columns_of(run: Run) -> dict[str, NDArray[Any]]:
    """Return coordinates, colours, intensities and times; of a map with attributes hits and the last time."""
    cloud = run.cloud
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), cloud.colors.T, strict=True))
    scalars = {"intensity": cloud.intensities, "time_s": cloud.times_s}
    columns |= {name: values for name, values in scalars.items() if values is not None}
    attributes = Run(run.path, run.config, run.manifest).octree.attributes  # also of voxels that a crop cuts
    if attributes is not None:
        found = attributes.at(in_map(run).cloud.points.astype(np.float64))
        seen_s = (found.last_seen_ns - run.trajectory.stamps_ns[0]) / NS_PER_S
        columns["last_seen_s"] = np.where(found.last_seen_ns == NEVER_SEEN, np.nan, seen_s)
        columns["hits"] = found.hits
    return columns
