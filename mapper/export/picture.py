"""Pictures over a grid, seen from above: trajectories, planned paths, runs of a merged map, voxels."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, distances_along
from mapper.core.timebase import stretches
from mapper.core.trajectory import Trajectory, plan_axes
from mapper.export.figures import (
    BAND_ALPHA,
    CELL_PX,
    DOUBTFUL,
    ESTIMATE,
    FACTORS,
    FAINT,
    LINE,
    MARGIN_M,
    MOST_CELLS,
    PLAN,
    SIGMAS,
    TEXT,
    TRUTH,
    UNKNOWN_CELL,
    Rgb,
    band_image,
    color_of,
    fit_to_window,
    hex_of,
    mark_ends,
    new_figure,
    quiet_frame,
    save,
    scale_bar,
)
from mapper.export.grid import grid_image
from mapper.export.html import image, table
from mapper.octree.grid import FREE, OCCUPIED, OccupancyGrid, shrunk
from mapper.run import files
from mapper.run.pose_covariances import UncertainPoses

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mapper.run.folder import Run

_NAMED = 12  # of many runs only the first are in the legend
_ARROWS = 6  # along a path


def write_summary(
    path: Path,
    *,
    grid: OccupancyGrid,
    trajectory: Trajectory,
    truth: Trajectory | None,
    loops_world: Array,
    title: str,
    lines: Sequence[str] = (),
    poses: UncertainPoses | None = None,
) -> None:
    """Draw the trajectory over the slice, with its loops, its uncertainty and its doubtful stretches.

    Args:
        path: PNG file to write.
        grid: The slice, world frame.
        trajectory: The estimate, world frame.
        truth: True path of the body, already aligned to the world frame, or None.
        loops_world: (L, 2, 3) ends of the loop closures, metres, world frame.
        title: Headline.
        lines: Figures worth knowing, shown below the headline.
        poses: The trajectory with its covariances, if known.
    """
    with _map_page(path, grid, _positions(trajectory, truth), title, lines) as axes:
        draw_summary(
            axes, grid=grid, trajectory=trajectory, truth=truth, loops_world=loops_world, poses=poses
        )


def draw_summary(
    axes: "Axes",
    *,
    grid: OccupancyGrid,
    trajectory: Trajectory,
    truth: Trajectory | None,
    loops_world: Array,
    poses: UncertainPoses | None,
) -> None:
    """Draw what ``write_summary`` writes on axes in metres, whose limits follow."""
    positions = trajectory.positions_world
    with _over_grid(axes, grid, _positions(trajectory, truth)) as (low, high):
        if poses is not None:
            _draw_band(axes, poses, low, high)
        if truth is not None:
            reference = truth.positions_world
            axes.plot(*reference[:, :2].T, color=hex_of(TRUTH), linewidth=2.6, alpha=0.65, label="truth")
        axes.plot(*positions[:, :2].T, color=hex_of(ESTIMATE), linewidth=1.3, label="estimate")
        if poses is not None:
            _draw_doubtful(axes, poses)
        _draw_loops(axes, loops_world)
        _draw_direction(axes, positions)
        mark_ends(axes, positions)


def _positions(*paths: Trajectory | None) -> list[Array]:
    return [path.positions_world for path in paths if path is not None]


def _draw_band(axes: "Axes", poses: UncertainPoses, low: Array, high: Array) -> None:
    """Draw how far off the path may be, seen from above, the first node being right."""
    half_widths_m = SIGMAS * poses.horizontal_sigmas_m
    if not np.isfinite(half_widths_m).any():
        return
    image = band_image(poses.trajectory.positions_world, half_widths_m, low=low, high=high)
    axes.imshow(image, origin="lower", extent=(low[0], high[0], low[1], high[1]))
    label = f"{SIGMAS:g} σ, at most {np.nanmax(half_widths_m):.2g} m"
    axes.fill([], [], facecolor=hex_of(ESTIMATE), alpha=0.25, label=label)


def _draw_doubtful(axes: "Axes", poses: UncertainPoses) -> None:
    count = int(poses.is_doubtful.sum())
    label = f"{count} doubtful frame{'' if count == 1 else 's'}"
    for first, last in stretches(poses.is_doubtful, margin=1):
        ends = poses.trajectory.positions_world[first : last + 1, :2].T
        axes.plot(*ends, ".-", color=hex_of(DOUBTFUL), linewidth=2.6, markersize=4.0, label=label)
        label = ""


def _draw_direction(axes: "Axes", positions: Array) -> None:
    reached_m = distances_along(positions[:, :2])
    style = {
        "arrowstyle": "-|>",
        "color": hex_of(ESTIMATE),
        "mutation_scale": 13.0,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    for share in (np.arange(_ARROWS) + 0.5) / _ARROWS:
        ahead = int(np.searchsorted(reached_m, share * reached_m[-1]))
        if ahead and reached_m[ahead] > reached_m[ahead - 1]:
            tip, tail = (tuple(positions[k, :2].tolist()) for k in (ahead, ahead - 1))
            axes.annotate("", tip, tail, arrowprops=style)


def _draw_loops(axes: "Axes", loops_world: Array) -> None:
    """Draw loops as lines between dots: most are so short that a line alone would not be seen."""
    label = f"{len(loops_world)} loops"
    for ends in loops_world[:, :, :2]:
        axes.plot(*ends.T, ".-", color=hex_of(FACTORS["loop"]), linewidth=0.6, markersize=2.0, label=label)
        label = ""


def write_localised(
    path: Path,
    *,
    grid: OccupancyGrid,
    poses: UncertainPoses,
    begins_ns: Sequence[int],
    recognised_world: Array,
    title: str,
    lines: Sequence[str],
) -> None:
    """Draw where a log lies in a map, over the map's slice.

    Args:
        path: PNG file to write.
        grid: The map's slice.
        poses: Poses of the frames that were placed, in the map's frame; at least one.
        begins_ns: Stamps from which the path is drawn anew: what lies before each is not connected to it.
        recognised_world: (K, 3) where the map was recognised, metres.
        title: Headline.
        lines: Figures worth knowing, shown below the headline.
    """
    positions = poses.trajectory.positions_world
    parts = np.split(positions, np.searchsorted(poses.trajectory.stamps_ns, sorted(begins_ns)))
    with _grid_page(path, grid, [positions], title, lines) as axes:
        for number, part in enumerate(part for part in parts if len(part)):
            label = "" if number else "estimate"
            axes.plot(*part[:, :2].T, color=hex_of(ESTIMATE), linewidth=1.3, label=label)
        _draw_doubtful(axes, poses)
        label = f"recognised in {len(recognised_world)} keyframes"
        axes.plot(*recognised_world[:, :2].T, ".", color=hex_of(FACTORS["loop"]), markersize=3.0, label=label)
        mark_ends(axes, positions)


def write_path(
    path: Path,
    *,
    grid: OccupancyGrid,
    waypoints_world: Array,
    radius_m: float,
    title: str,
    lines: Sequence[str],
) -> None:
    """Draw a planned path over a grid, as wide as the robot that takes it.

    Args:
        path: PNG file to write.
        grid: Background of the path, world frame.
        waypoints_world: (N, 2) or (N, 3) metres, seen from above.
        radius_m: Radius of the robot.
        title: Headline.
        lines: Figures worth knowing, shown below the headline.
    """
    ends = waypoints_world[:, :2]
    with _grid_page(path, grid, [ends], title, lines) as axes:
        _draw_over(axes, _swept(grid, ends, radius_m), grid)
        axes.plot(*ends.T, color=hex_of(PLAN), linewidth=1.6, label=f"path, {2 * radius_m:g} m wide")
        axes.plot(*ends[1:-1].T, ".", color=hex_of(PLAN), markersize=5)
        mark_ends(axes, ends, end="goal")


def write_merged(
    path: Path,
    *,
    grid: OccupancyGrid,
    paths_world: Mapping[str, Array],
    tile_m: float,
    title: str,
    lines: Sequence[str],
) -> None:
    """Draw the paths of several runs over the slice of the map that they make together.

    Args:
        path: PNG file to write.
        grid: The slice, the map's frame.
        paths_world: (N, 3) positions of each run, metres, the map's frame.
        tile_m: Edge of the tiles that the map is cut into, drawn as lines.
        title: Headline.
        lines: Figures worth knowing, shown below the headline.
    """
    grid, paths = shrunk(grid, MOST_CELLS), list(paths_world.values())
    low, high = _extent(grid, paths)
    with _grid_page(path, grid, paths, title, lines) as axes:
        for draw, (start, end) in zip((axes.axvline, axes.axhline), zip(low, high, strict=True), strict=True):
            for border_m in np.arange(np.ceil(start / tile_m), np.floor(end / tile_m) + 1) * tile_m:
                draw(border_m, color=hex_of(PLAN), linewidth=0.5, alpha=0.35)
        for index, (name, positions) in enumerate(paths_world.items()):
            label = name if index < _NAMED else None
            axes.plot(*positions[:, :2].T, color=hex_of(color_of(index)), linewidth=1.4, label=label)


def write_layers(
    path: Path,
    *,
    grid: OccupancyGrid,
    layers: Mapping[str, tuple[Points, Rgb]],
    title: str,
    lines: Sequence[str],
) -> None:
    """Draw voxels over the slice, seen from above, one colour for each layer; later ones cover earlier ones.

    Args:
        path: PNG file to write.
        grid: The slice, world frame.
        layers: (N, 3) centres of voxels, metres, world frame, and their colour, by their name in the legend.
        title: Headline.
        lines: Figures worth knowing, shown below the headline.
    """
    grid, paths_world = shrunk(grid, MOST_CELLS), [centres for centres, _ in layers.values()]
    with _grid_page(path, grid, paths_world, title, lines) as axes:
        for name, (centres, color) in layers.items():
            cells = np.unique(np.floor(centres[:, :2] / grid.resolution_m).astype(np.int64), axis=0)
            corners = (cells - cells.min(axis=0, initial=0))[:, ::-1] if len(cells) else cells
            image = np.zeros((*(corners.max(axis=0, initial=0) + 1), 4), np.uint8)
            image[tuple(corners.T)] = (*color, 255)
            lower = cells.min(axis=0, initial=0) * grid.resolution_m
            upper = lower + np.array(image.shape[1::-1]) * grid.resolution_m
            extent = lower[0], upper[0], lower[1], upper[1]
            axes.imshow(image, origin="lower", interpolation="nearest", extent=extent)
            axes.fill([], [], facecolor=hex_of(color), label=name)


def _swept(grid: OccupancyGrid, ends: Array, radius_m: float) -> NDArray[np.uint8]:
    """Return an RGBA image over the grid that shows where a disc passes along a path."""
    pixel_m = grid.resolution_m / CELL_PX
    mask = np.zeros([n * CELL_PX for n in grid.cells.shape], np.uint8)
    corners = np.rint((ends - grid.origin_world_m) / pixel_m - 0.5).astype(np.int32)
    width_px = max(1, round(2.0 * radius_m / pixel_m))
    cv2.polylines(mask, [corners], isClosed=False, color=BAND_ALPHA, thickness=width_px)
    return np.dstack([np.broadcast_to(np.array(PLAN, np.uint8), (*mask.shape, 3)), mask])


def _draw_over(axes: "Axes", image: NDArray[np.uint8], grid: OccupancyGrid) -> None:
    x, y = grid.origin_world_m
    height_m, width_m = (n * grid.resolution_m for n in grid.cells.shape)
    axes.imshow(image, origin="lower", interpolation="nearest", extent=(x, x + width_m, y, y + height_m))


@contextmanager
def _over_grid(
    axes: "Axes", grid: OccupancyGrid, paths_world: Sequence[Array]
) -> Iterator[tuple[Array, Array]]:
    """Draw a grid on axes in metres, what the caller draws over it, a scale and a legend.

    Yields:
        The lower and upper corner of grid and paths, metres, to which the axes' limits are fitted.
    """
    low, high = _extent(grid, paths_world)
    _draw_over(axes, grid_image(grid), grid)
    yield low, high
    box = axes.get_window_extent()
    # Limits of the shape of the page: left to fit them itself, matplotlib warns of a map that is higher.
    reach = 0.5 * np.array([box.width, box.height]) * float(np.max((high - low) / [box.width, box.height]))
    lowest, highest = 0.5 * (low + high) - reach, 0.5 * (low + high) + reach
    fit_to_window(axes, lowest, highest)
    scale_bar(axes, low, high, color=TEXT)
    axes.legend(loc="best", fontsize=8, framealpha=0.92, edgecolor=LINE)


def _extent(grid: OccupancyGrid, paths_world: Sequence[Array]) -> tuple[Array, Array]:
    rows, columns = np.nonzero((grid.cells == FREE) | (grid.cells == OCCUPIED))
    cells = grid.origin_world_m + (np.column_stack([columns, rows]) + 0.5) * grid.resolution_m
    seen = np.concatenate([cells, *(path[:, :2] for path in paths_world)])
    return seen.min(axis=0) - MARGIN_M, seen.max(axis=0) + MARGIN_M


@contextmanager
def _map_page(
    path: Path, grid: OccupancyGrid, paths_world: Sequence[Array], title: str, lines: Sequence[str]
) -> Iterator["Axes"]:
    """Write a page with a headline and what the caller draws on axes in metres, of a shape that suits."""
    low, high = _extent(grid, paths_world)
    aspect = float(np.divide(*(high - low)[::-1]))
    width_in, left_in, right_in, bottom_in = 8.0, 0.65, 0.25, 0.6
    map_width_in = width_in - left_in - right_in
    map_height_in = map_width_in * min(max(aspect, 0.4), 1.3)
    top_in = 0.65 + 0.19 * len(lines)
    height_in = bottom_in + map_height_in + top_in
    figure = new_figure(width_in, height_in)
    left, bottom = left_in / width_in, bottom_in / height_in
    figure.text(left, 1 - 0.2 / height_in, title, fontsize=14, fontweight="bold", color=TEXT, va="top")
    figure.text(left, 1 - 0.52 / height_in, "\n".join(lines), fontsize=9, color=FAINT, va="top")
    axes = figure.add_axes((left, bottom, map_width_in / width_in, map_height_in / height_in))
    axes.set_facecolor(hex_of(UNKNOWN_CELL))
    axes.set_xlabel("x (m)", color=FAINT, fontsize=9)
    axes.set_ylabel("y (m)", color=FAINT, fontsize=9)
    quiet_frame(axes, label_size=8)
    yield axes
    save(figure, path)


@contextmanager
def _grid_page(
    path: Path, grid: OccupancyGrid, paths_world: Sequence[Array], title: str, lines: Sequence[str]
) -> Iterator["Axes"]:
    """Write a page with a headline, a grid and what the caller draws over it, on axes in metres."""
    with _map_page(path, grid, paths_world, title, lines) as axes, _over_grid(axes, grid, paths_world):
        yield axes


def plot_run(run: "Run", axes: "Axes | None") -> "Axes":
    """Draw a run's path over its slice, seen from above; axes are in metres.

    Args:
        run: A finished run.
        axes: Axes to draw on; None makes a figure of pyplot's.

    Returns:
        The axes.
    """
    axes = plan_axes(axes)
    results = run.results
    draw_summary(
        axes,
        grid=run.slice,
        trajectory=results.trajectory,
        truth=results.truth,
        loops_world=results.graph.loops_world,
        poses=results.poses,
    )
    axes.set_title(run.manifest.input.title)
    return axes


def run_html(run: "Run") -> str:
    """Return the HTML of a run's verdict, its sizes and its picture, which loads nothing from elsewhere."""
    counts = run.manifest.counts
    rows = [
        ("verdict", ". ".join([run.verdict.state, *run.verdict.sentences])),
        ("frames", counts.frames_text),
        ("keyframes", f"{counts.nodes}, {counts.loops} loops"),
        ("path", f"{run.trajectory.path_length_m:.2f} m"),
        ("octree", f"{counts.voxels_text} of {run.config.octree.resolution_m:g} m"),
    ]
    path = run.path / files.SUMMARY
    picture = image(run.file(files.SUMMARY).read_bytes(), "path over the slice") if path.is_file() else ""
    return f"<b>{escape(str(run.path))}</b>{table(('', ''), rows)}{picture}"
