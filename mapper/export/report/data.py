"""Data of the report's curves and plans."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import ConfigError, DataError
from mapper.core.timebase import MAX_TRUTH_GAP_NS, NS_PER_S, nearest
from mapper.export.figures import SIGMAS
from mapper.export.grid import grid_image
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure
from mapper.mapping.thumbnails import encode_jpeg
from mapper.octree.grid import OccupancyGrid
from mapper.octree.map import read_octree
from mapper.octree.octomap_file import bt_bytes
from mapper.run import files
from mapper.run.folder import Run
from mapper.run.results import RunResults

_SIZED_LEVELS = 4
_VIEW_PX = 1600


Question = Literal["Is it right?", "Is it complete?", "How fast was it?", ""]


@dataclass(frozen=True, slots=True)
class Figure:
    """One number about a run, as it is to be shown.

    Attributes:
        name: Name of the quantity.
        value: Value with its unit.
        question: What it answers first of all; empty if it is only one of all numbers.
    """

    name: str
    value: str
    question: Question = ""


@dataclass(frozen=True, slots=True, eq=False)
class Chapter:
    """One run's part of a report.

    Attributes:
        name: Distinct among the report's runs.
        run: The run.
        results: Its trajectory, graph, records and truth.
        figures: What it amounts to, e.g. how far it is from the truth.
    """

    name: str
    run: Run
    results: RunResults
    figures: Sequence[Figure]


def chapter_of(run: Run, name: str, figures: Sequence[Figure]) -> Chapter:
    """Return a run's part of a report.

    Raises:
        MapperError: A file of the run cannot be read.
    """
    return Chapter(name, run, run.results, tuple(figures))


def refuse_same_names(chapters: Sequence[Chapter]) -> None:
    """Refuse a page about no run, or about two of one name.

    Raises:
        ConfigError: That is so.
    """
    names = [chapter.name for chapter in chapters]
    if not names or len(set(names)) < len(names):
        raise ConfigError(f"page: runs {', '.join(names) or 'none'}; want one or more, each of its own name")


def drawn(chapter: Chapter) -> dict[str, Any]:
    """Return the numbers behind a run's curves and plans, ready for JSON; what is not known is None."""
    results = chapter.results
    begin_ns = int(results.trajectory.stamps_ns[0])
    seconds = Seconds(begin_ns)
    records = results.records
    return {
        "name": chapter.name,
        "world": chapter.run.manifest.input.fingerprint,
        "frames": {
            "t": seconds([record.stamp_ns for record in records]),
            "outcome": [record.outcome for record in records],
            "features": [record.diagnostics.features for record in records],
            "matches": [record.diagnostics.matches for record in records],
            "inliers": [record.diagnostics.inliers for record in records],
            "residual": _rounded([record.diagnostics.residual for record in records]),
            "ms": _rounded([results.frame_ms.get(record.stamp_ns, math.nan) for record in records]),
        },
        "residual_unit": residual_unit(results),
        "path": drawn_path(results.trajectory.stamps_ns, results.trajectory.positions_world, seconds)
        | _uncertainty(results),
        "truth": None
        if results.truth is None
        else drawn_path(results.truth.stamps_ns, results.truth.positions_world, seconds),
        "error": _errors(results, seconds),
        "loops": [drawn_loop(loop, results.graph, seconds) for loop in results.loops],
        "slice": _plan(chapter.run.slice),
    }


def map_sizes(chapter: Chapter) -> dict[str, str]:
    """Return the sizes of the cloud and of the octree at a few levels (Zhao et al. 2020, Table 5)."""
    run = chapter.run
    octree = read_octree(run.file(files.OCTREE_MAP))  # not kept: a report is of many runs
    cloud_bytes = run.file(files.CLOUD).stat().st_size
    points = run.manifest.counts.cloud_points
    sizes = {"coloured cloud": f"{_size(cloud_bytes)}, {points:,} points"}
    for level in range(_SIZED_LEVELS):
        coarse = octree.coarser(level, parent="max")
        octree_bytes = bt_bytes(coarse)
        sizes[f"octree, {coarse.resolution_m:g} m"] = (
            f"{_size(octree_bytes)}, {100.0 * octree_bytes / max(cloud_bytes, 1):.3g} % of the cloud"
        )
    return sizes


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.3g} MB" if size_bytes >= 1e6 else f"{size_bytes / 1e3:.3g} kB"


def residual_unit(results: RunResults) -> str:
    """Return what a run's residuals are measured in; empty if nothing was tracked."""
    return next((r.diagnostics.residual_unit for r in results.records if r.outcome == "tracked"), "")


def views_uri(run: Run) -> str | None:
    """Return the run's picture of its cloud from two sides as a data URI; None if it has none."""
    if not (run.path / files.CLOUD_VIEWS).is_file():
        return None
    path = run.file(files.CLOUD_VIEWS)
    image = cv2.imread(str(path))
    if image is None:
        raise DataError(f"{path}: cannot be read as an image; make it again with mapper fuse")
    rgb = np.ascontiguousarray(image[:, :, ::-1])
    return data_uri("jpeg", encode_jpeg(rgb, width_px=_VIEW_PX))


class Seconds:
    """Turns stamps into seconds since a first one, to the millisecond."""

    def __init__(self, begin_ns: int) -> None:
        self._begin_ns = begin_ns

    def __call__(self, stamps_ns: Sequence[int] | NDArray[np.int64]) -> list[float]:
        """Return the seconds of some stamps."""
        since_ns = np.asarray(stamps_ns, np.int64) - self._begin_ns
        return [round(float(s), 3) for s in since_ns / NS_PER_S]


def drawn_path(
    stamps_ns: NDArray[np.int64], positions: NDArray[np.float64], seconds: Seconds
) -> dict[str, Any]:
    """Return the times and the (N, 3) positions of a path, to the millimetre."""
    x, y, z = ([round(float(value), 3) for value in column] for column in positions.T)
    return {"t": seconds(stamps_ns), "x": x, "y": y, "z": z}


def _uncertainty(results: RunResults) -> dict[str, Any]:
    """Return the half width of the band around the path from above, and in space, and what is doubtful."""
    doubtful_ns = {record.stamp_ns for record in results.records if record.outcome == "doubtful"}
    stamps_ns = results.trajectory.stamps_ns.tolist()
    poses = results.poses
    return {
        "doubtful": [stamp_ns in doubtful_ns for stamp_ns in stamps_ns],
        "band_m": _rounded((SIGMAS * poses.horizontal_sigmas_m).tolist()),
        "band_3d_m": _rounded((SIGMAS * poses.position_sigmas_m).tolist()),
    }


def _errors(results: RunResults, seconds: Seconds) -> dict[str, Any] | None:
    """Return the errors of the estimate against the aligned truth: the terms of the ATE, SE(3)-aligned."""
    if results.truth is None:
        return None
    index, gap_ns = nearest(results.truth.stamps_ns, results.trajectory.stamps_ns)
    near = gap_ns <= MAX_TRUTH_GAP_NS
    miss = results.trajectory.positions_world[near] - results.truth.positions_world[index[near]]
    return {
        "t": seconds(results.trajectory.stamps_ns[near]),
        "m": _rounded(np.linalg.norm(miss, axis=1).tolist()),
    }


def drawn_loop(loop: LoopClosure, graph: PoseGraph, seconds: Seconds) -> dict[str, Any]:
    """Return a loop's numbers, and its ends where the solved graph has both."""
    T_world_node = graph.T_world_node
    ends = None
    if loop.i in T_world_node and loop.j in T_world_node:
        ends = [[round(float(v), 3) for v in T_world_node[node][:3, 3]] for node in (loop.i, loop.j)]
    return {
        "i": loop.i,
        "j": loop.j,
        "t": seconds([loop.stamp_i_ns, loop.stamp_j_ns]),
        "by": loop.proposed_by,
        "matches": loop.matches,
        "inliers": loop.inliers,
        "rmse_m": four_digits(loop.rmse_m),
        "before_m": four_digits(None if loop.before is None else loop.before.translation_m),
        "after_m": four_digits(None if loop.after is None else loop.after.translation_m),
        "weight": four_digits(loop.weight),
        "verdict": loop.verdict,
        "reason": loop.reason,
        "ends": ends,
    }


def _plan(grid: OccupancyGrid) -> dict[str, Any]:
    image = np.ascontiguousarray(grid_image(grid)[::-1, :, ::-1])
    done, data = cv2.imencode(".png", image)
    if not done:
        raise DataError(f"a slice of {grid.cells.shape} cells cannot be encoded as PNG")
    height, width = grid.cells.shape
    return {
        "uri": data_uri("png", data.tobytes()),
        "x": float(grid.origin_world_m[0]),
        "y": float(grid.origin_world_m[1]),
        "width_m": width * grid.resolution_m,
        "height_m": height * grid.resolution_m,
    }


def data_uri(kind: str, data: bytes) -> str:
    """Return an image file of a kind, "png" or "jpeg", as the address that a page shows it by."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _rounded(values: Sequence[float]) -> list[float | None]:
    return [four_digits(value) for value in values]


def four_digits(value: float | None) -> float | None:
    """Return a number to four digits; None if it is not known."""
    return None if value is None or not math.isfinite(value) else float(f"{value:.4g}")
