"""Figures of several panels: the page, its panels, their colours, and shared drawing functions."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.geometry import Array
from mapper.export.page import FAINT, INK, LINE, hex_of, new_figure, quiet_frame
from mapper.export.palette import Rgb

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
_PANEL_IN = 3.0
_HEAD_IN = 0.5
_LEFT_IN = 0.85
_MARGIN_RATIO = 0.15
_WIDE = 1e3  # from here on ticks at 1, 2, 5 would be written over one another


def color_of(number: int) -> Rgb:
    """Return the colour of the n-th method."""
    return _COLORS[number % len(_COLORS)]


def page(
    title: str,
    *,
    columns: int,
    rows: int,
    width_in: float = _PANEL_IN,
    height_in: float = _PANEL_IN,
    legend_in: float = 0.0,
) -> "Figure":
    """Return an empty page for panels of one size, with room for a headline and, at the right, a legend."""
    figure = new_figure(width_in * columns + legend_in, height_in * rows + _HEAD_IN)
    _, page_in = figure.get_size_inches()
    figure.text(0.02, 1.0 - 0.2 / page_in, title, fontsize=12, fontweight="bold", color=INK, va="top")
    return figure


def panel(
    figure: "Figure",
    number: int,
    *,
    columns: int,
    rows: int,
    legend_in: float = 0.0,
    left_in: float = _LEFT_IN,
) -> "Axes":
    """Return the axes of a panel; panels are numbered from the upper left.

    Args:
        figure: Page of as many columns and rows, from ``page``.
        number: Number of the panel.
        columns: Number of columns of panels.
        rows: Number of rows of panels.
        legend_in: The page's room for a legend.
        left_in: Each panel's room for what stands at its left.
    """
    width_in, height_in = figure.get_size_inches()
    row, column = divmod(number, columns)
    cell_width_in, cell_height_in = (width_in - legend_in) / columns, (height_in - _HEAD_IN) / rows
    below_in, above_in, right_in = 0.45, 0.3, 0.15
    axes = figure.add_axes(
        (
            (column * cell_width_in + left_in) / width_in,
            ((rows - 1 - row) * cell_height_in + below_in) / height_in,
            (cell_width_in - left_in - right_in) / width_in,
            (cell_height_in - below_in - above_in) / height_in,
        )
    )
    quiet_frame(axes, label_size=7)
    return axes


def caption(axes: "Axes", *, title: str = "", x: str = "", y: str = "") -> None:
    """Write a panel's title and the names of its axes, those that are given."""
    if title:
        axes.set_title(title, fontsize=9, color=INK)
    if x:
        axes.set_xlabel(x, color=FAINT, fontsize=8)
    if y:
        axes.set_ylabel(y, color=FAINT, fontsize=8)


def draw_boxes(axes: "Axes", values: Mapping[str, Array]) -> None:
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
    by_logarithm(axes)
    axes.grid(color=LINE, linewidth=0.4, axis="x")


def by_logarithm(axes: "Axes") -> None:
    """Give an axis of x a logarithmic scale, with ticks at 1, 2, 5 where powers of ten are too few."""
    from matplotlib.ticker import LogLocator

    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _WIDE * low else (1.0,)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()


def widest_axes(positions: Array) -> Array:
    """Return (2, 3) unit vectors along which positions are spread most."""
    if len(positions) < 3:
        return np.eye(3)[:2]
    *_, axes = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)
    signs = np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])  # the same whichever LAPACK chose
    widest: Array = (axes * signs[:, None])[:2]
    return widest


def extent(seen: Array) -> tuple[Array, Array]:
    """Return the corners of a square around (N, 2) points."""
    if not len(seen):
        return np.full(2, -1.0), np.full(2, 1.0)
    low, high = seen.min(axis=0), seen.max(axis=0)
    half = max((0.5 + _MARGIN_RATIO) * float((high - low).max()), 1e-3)
    middle = 0.5 * (low + high)
    return middle - half, middle + half
