"""The coloured cloud in the files of surveys (LAS, LAZ) and of the Point Cloud Library (PCD)."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.timebase import NS_PER_S
from mapper.export.crs import place_of, wkt_of
from mapper.octree.attributes import NEVER_SEEN
from mapper.run.folder import Run
from mapper.runtime.progress import Progress
from mapper.sources.cloud_files.las import write_las
from mapper.sources.cloud_files.pcd import write_pcd


def las(run: Run, path: Path, _progress: Progress) -> None:
    """Write LAS, or LAZ if the name ends so, with the reference system of a map whose place is known."""
    place = place_of(run)
    write_las(path, _columns(run), wkt=None if place is None else wkt_of(place))


def pcd(run: Run, path: Path, _progress: Progress) -> None:
    """Write PCD with PCL's packed colours."""
    write_pcd(path, _columns(run))


def _columns(run: Run) -> dict[str, NDArray[Any]]:
    """Return coordinates, colours and intensities; of a map with attributes hits and the time of the last."""
    cloud, octree = run.cloud, run.octree
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), cloud.colors.T, strict=True))
    if cloud.intensities is not None:
        columns["intensity"] = cloud.intensities
    if octree.attributes is not None:
        found = octree.attributes.at(cloud.points.astype(np.float64))
        seen_s = (found.last_seen_ns - run.trajectory.stamps_ns[0]) / NS_PER_S
        columns["time_s"] = np.where(found.last_seen_ns == NEVER_SEEN, np.nan, seen_s)
        columns["hits"] = found.hits
    return columns
