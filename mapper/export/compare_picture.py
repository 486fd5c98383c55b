"""Pictures of a comparison: every method's path over the truth, and how its errors are distributed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapper.export.page import FAINT, INK, LINE, hex_of, new_figure, save
from mapper.export.palette import END, START, TRUTH, Rgb
from mapper.geometry import Array
from mapper.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLORS: tuple[Rgb, ...] = (
    (214, 69, 37),
    (222, 111, 161),
    (38, 145, 87),
    (124, 58, 196),
    (224, 160, 32),
    (23, 165, 184),
    (196, 40, 140),
    (120, 94, 60),
    (92, 70, 150),
    (140, 179, 36),
    (30, 33, 41),
    (140, 146, 158),
)
_COLUMNS = 4
_PANEL_IN = 3.0
_HEAD_IN = 0.5
_LEGEND_IN = 1.3
_MARGIN_RATIO = 0.15
_WIDE = 1e3  # from here on ticks at 1, 2, 5 would be written over one another


def color_of(number: int) -> Rgb:
    """Return the colour of the n-th method."""
    return _COLORS[number % len(_COLORS)]


def write_paths(
    path: Path,
    paths: Mapping[str, Trajectory],
    *,
    truth: Trajectory | None,
    captions: Mapping[str, str],
    title: str,
) -> None:
    """Draw every method's path in a panel of its own, over the truth, from the side on which that is widest.

    All panels have the scale of the truth: a path that leaves it leaves the panel.

    Args:
        path: PNG file to write.
        paths: Name to path, laid over the truth; an empty path leaves its panel to the truth.
        truth: Where the body really was, or None: then each panel is as wide as its path.
        captions: A few words for each name.
        title: Headline.
    """
    rows = -(-len(paths) // _COLUMNS)
    figure = _page(title, columns=min(len(paths), _COLUMNS), rows=rows)
    reference = _reference(paths, truth)
    axes_world = _widest_axes(reference)
    low, high = _extent(reference @ axes_world.T)
    for number, (name, trajectory) in enumerate(paths.items()):
        axes = _panel(figure, number, columns=min(len(paths), _COLUMNS), rows=rows)
        if truth is not None:
            axes.plot(
                *(truth.positions_world @ axes_world.T).T, color=hex_of(TRUTH), linewidth=2.2, alpha=0.5
            )
        if len(trajectory):
            seen = trajectory.positions_world @ axes_world.T
            axes.plot(*seen.T, color=hex_of(color_of(number)), linewidth=1.0)
            axes.plot(*seen[0], "o", color=hex_of(START), markersize=4)
            axes.plot(*seen[-1], "s", color=hex_of(END), markersize=4)
        axes.set_title(f"{name}: {captions[name]}", fontsize=9, color=INK)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
    save(figure, path)


def write_path_errors(
    path: Path, positions_m: Mapping[str, Array], steps_m: Mapping[str, Array], *, step: str, title: str
) -> None:
    """Draw what share of the poses lies within which distance of the truth, and boxes of the steps' errors.

    Args:
        path: PNG file to write.
        positions_m: Name to the (N,) distances of a path's poses.
        steps_m: Name to the (S,) errors of its motion over steps of one length.
        step: That length, in words.
        title: Headline.
    """
    figure = _page(title, columns=2, rows=1, width_in=5.6, height_in=4.4)
    axes = _panel(figure, 0, columns=2, rows=1)
    _draw_shares(axes, positions_m, list(positions_m))
    axes.set_xlabel("distance from the truth, m", color=FAINT, fontsize=8)
    axes.set_ylabel("share of the poses", color=FAINT, fontsize=8)
    axes = _panel(figure, 1, columns=2, rows=1)
    _draw_boxes(axes, steps_m)
    axes.set_xlabel(f"error of the motion over {step}, m", color=FAINT, fontsize=8)
    save(figure, path)


def write_registration_errors(
    path: Path, errors_m: Mapping[str, Mapping[str, Array]], *, max_error_m: float, title: str
) -> None:
    """Draw, for each kind of guess, what share of the registrations lies within which distance of the truth.

    Registrations without an answer count as infinitely far, so a curve ends at the share of answers.

    Args:
        path: PNG file to write.
        errors_m: Kind of guess to name to the (N,) distances.
        max_error_m: What counts as right.
        title: Headline.
    """
    names = list(dict.fromkeys(name for kind in errors_m.values() for name in kind))
    figure = _page(title, columns=len(errors_m), rows=1, width_in=4.2, height_in=3.9, beside_in=_LEGEND_IN)
    for number, (kind, of_name) in enumerate(errors_m.items()):
        axes = _panel(figure, number, columns=len(errors_m), rows=1, beside_in=_LEGEND_IN)
        axes.axvline(max_error_m, color=FAINT, linewidth=0.8, linestyle="dashed")
        _draw_shares(axes, of_name, names)
        axes.set_title(kind, fontsize=9, color=INK)
        axes.set_xlabel("distance from the truth, m", color=FAINT, fontsize=8)
        if number == 0:
            axes.set_ylabel("share of the pairs", color=FAINT, fontsize=8)
    lines, labels = axes.get_legend_handles_labels()
    figure.legend(lines, labels, loc="center right", fontsize=8, frameon=False)
    save(figure, path)


def _draw_shares(axes: "Axes", errors: Mapping[str, Array], names: Sequence[str]) -> None:
    """Draw the cumulative share of each name's errors over their size."""
    everything = np.concatenate([np.empty(0), *errors.values()])
    finite = everything[np.isfinite(everything) & (everything > 0.0)]
    farthest = 1.3 * float(finite.max()) if len(finite) else 1.0
    for name, all_of_it in errors.items():
        known = np.sort(all_of_it[np.isfinite(all_of_it)])
        share = np.arange(1, len(known) + 1) / max(len(all_of_it), 1)
        color = hex_of(color_of(names.index(name)))
        # Each curve goes on to the edge, so that shares can be read off there.
        x, y = np.append(known, farthest), np.append(share, share[-1] if len(share) else 0.0)
        axes.step(x, y, where="post", color=color, linewidth=1.3, label=name)
    _scale(axes)
    axes.set_ylim(0.0, 1.02)
    axes.grid(color=LINE, linewidth=0.4)


def _draw_boxes(axes: "Axes", values: Mapping[str, Array]) -> None:
    """Draw boxes from quartile to quartile, whiskers from the 5th to the 95th percentile."""
    boxes = axes.boxplot(
        list(values.values()),
        orientation="horizontal",
        whis=(5, 95),
        showfliers=False,
        patch_artist=True,
        widths=0.6,
    )
    for number, (box, median) in enumerate(zip(boxes["boxes"], boxes["medians"], strict=True)):
        box.set(facecolor=hex_of(color_of(number)), alpha=0.55, edgecolor=INK, linewidth=0.6)
        median.set(color=INK, linewidth=1.2)
    axes.set_yticks(range(1, len(values) + 1), list(values))
    axes.invert_yaxis()
    _scale(axes)
    axes.grid(color=LINE, linewidth=0.4, axis="x")


def _scale(axes: "Axes") -> None:
    """Lay what was drawn out by its logarithm, with ticks at 1, 2, 5 where powers of ten are too few."""
    from matplotlib.ticker import LogLocator

    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _WIDE * low else (1.0,)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()


def _reference(paths: Mapping[str, Trajectory], truth: Trajectory | None) -> Array:
    """Return the positions that decide what is shown."""
    shown = [truth] if truth is not None else [path for path in paths.values() if len(path)]
    return np.concatenate([np.zeros((0, 3)), *(path.positions_world for path in shown)])


def _widest_axes(positions: Array) -> Array:
    """Return (2, 3) unit vectors along which positions are spread most."""
    if len(positions) < 3:
        return np.eye(3)[:2]
    *_, axes = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)
    signs = np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])  # the same whichever LAPACK chose
    widest: Array = (axes * signs[:, None])[:2]
    return widest


def _extent(seen: Array) -> tuple[Array, Array]:
    """Return the corners of a square around (N, 2) points."""
    if not len(seen):
        return np.full(2, -1.0), np.full(2, 1.0)
    low, high = seen.min(axis=0), seen.max(axis=0)
    half = max((0.5 + _MARGIN_RATIO) * float((high - low).max()), 1e-3)
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _page(
    title: str,
    *,
    columns: int,
    rows: int,
    width_in: float = _PANEL_IN,
    height_in: float = _PANEL_IN,
    beside_in: float = 0.0,
) -> "Figure":
    figure = new_figure(width_in * columns + beside_in, height_in * rows + _HEAD_IN)
    _, page_in = figure.get_size_inches()
    figure.text(0.02, 1.0 - 0.2 / page_in, title, fontsize=12, fontweight="bold", color=INK, va="top")
    return figure


def _panel(figure: "Figure", number: int, *, columns: int, rows: int, beside_in: float = 0.0) -> "Axes":
    """Return the axes of a panel; panels are numbered from the upper left."""
    width_in, height_in = figure.get_size_inches()
    row, column = divmod(number, columns)
    cell_width_in, cell_height_in = (width_in - beside_in) / columns, (height_in - _HEAD_IN) / rows
    left_in, below_in, above_in, right_in = 0.85, 0.45, 0.3, 0.15
    axes = figure.add_axes(
        (
            (column * cell_width_in + left_in) / width_in,
            ((rows - 1 - row) * cell_height_in + below_in) / height_in,
            (cell_width_in - left_in - right_in) / width_in,
            (cell_height_in - below_in - above_in) / height_in,
        )
    )
    axes.tick_params(colors=FAINT, labelsize=7)
    for spine in axes.spines.values():
        spine.set_color(LINE)
    return axes
