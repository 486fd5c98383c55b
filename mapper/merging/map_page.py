"""Page that shows a merged map in 3D: its voxels, the runs' paths, and the loops between runs."""

from html import escape
from pathlib import Path
from typing import Any

from mapper.export.report.data import Seconds, data_uri, drawn_loop, drawn_path
from mapper.export.report.map_data import map_of_octree, no_map
from mapper.export.report.map_page import map_page
from mapper.loops.closure import read_closures
from mapper.merging.merged_map import MergedMap
from mapper.run import files
from mapper.runtime.atomic import write_text
from mapper.runtime.regular_files import AnyPath


def write_merged_map_page(path: AnyPath, merged: MergedMap, names: list[str]) -> None:
    """Write a page that shows a merged map in 3D, whole or not at all; it loads nothing.

    Args:
        path: The page.
        merged: The map.
        names: Names of its runs, in their order.

    Raises:
        MapperError: A file of the map cannot be read.
    """
    title = merged.path.resolve().name
    paths = [_path_of(merged, k, name) for k, name in enumerate(names)]
    highest_m = max((max(one["path"]["z"], default=0.0) for one in paths), default=0.0)
    maps = [map_of_octree(merged.octree, highest_m=highest_m), *(no_map() for _ in paths)]
    curves = [_of_the_map(merged, title), *paths]
    write_text(Path(path), map_page(title, curves, maps, pictures=_picture(merged, title)))


def _picture(merged: MergedMap, title: str) -> str:
    """Return the map's picture as HTML; empty if it has none, as a map without a slice."""
    path = merged.file(files.SUMMARY)
    if not path.is_file():
        return ""
    picture = data_uri("png", path.read_bytes())
    return f'<img src="{picture}" alt="{escape(title)} from above, with the paths of its runs">'


def _of_the_map(merged: MergedMap, name: str) -> dict[str, Any]:
    """Return the loops between runs; the times of their ends are since 1970."""
    graph, seconds = merged.graph, Seconds(0)
    loops = [] if graph is None else read_closures(merged.file(files.LOOPS))
    return _curves(name, {"t": [], "x": [], "y": [], "z": []}) | {
        "loops": [drawn_loop(loop, graph, seconds) for loop in loops if graph is not None]
    }


def _path_of(merged: MergedMap, run: int, name: str) -> dict[str, Any]:
    trajectory = merged.trajectory(merged.manifest.runs[run])
    seconds = Seconds(int(trajectory.stamps_ns[0]))
    return _curves(name, drawn_path(trajectory.stamps_ns, trajectory.positions_world, seconds))


def _curves(name: str, path: dict[str, Any]) -> dict[str, Any]:
    unknown = {"doubtful": [False] * len(path["t"]), "band_m": None, "band_3d_m": None}
    return {"name": name, "path": path | unknown, "truth": None, "error": None, "loops": []}
