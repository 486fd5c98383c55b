"""Figures: the colours that pictures, pages and viewer files share; pages with panels, scale bars, bands.

Lines and marks are distinct for people who cannot tell red from green: Okabe & Ito (2008). Matplotlib is
driven through its objects: pyplot would keep global state and pick a GUI backend.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.graph.model import Origin
from mapper.runtime.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rgb = tuple[int, int, int]

_OKABE_ITO: dict[str, Rgb] = {
    "vermillion": (213, 94, 0),
    "blue": (0, 114, 178),
    "sky": (86, 180, 233),
    "green": (0, 158, 115),
    "orange": (230, 159, 0),
    "purple": (204, 121, 167),
    "yellow": (240, 228, 66),
}

INK: Rgb = (30, 33, 41)
PAPER: Rgb = (255, 255, 255)
GREY: Rgb = (140, 146, 158)
BACKDROP: Rgb = INK
"""Behind clouds."""

ESTIMATE: Rgb = _OKABE_ITO["vermillion"]
DOUBTFUL: Rgb = _OKABE_ITO["yellow"]
TRUTH: Rgb = _OKABE_ITO["blue"]
START: Rgb = _OKABE_ITO["green"]
END: Rgb = INK
END_ON_DARK: Rgb = PAPER
PLAN: Rgb = (124, 58, 196)
ACCEPTED: Rgb = _OKABE_ITO["purple"]
REJECTED: Rgb = GREY
FACTORS: dict[Origin, Rgb] = {
    "odometry": GREY,
    "loop": ACCEPTED,
    "wheel": _OKABE_ITO["orange"],
}
APPEARED: Rgb = _OKABE_ITO["blue"]
VANISHED: Rgb = _OKABE_ITO["vermillion"]
NOT_SEEN_AGAIN: Rgb = REJECTED
UNKNOWN_CELL: Rgb = (214, 218, 224)
FREE_CELL: Rgb = PAPER
OCCUPIED_CELL: Rgb = INK

RUNS: tuple[Rgb, ...] = (
    ESTIMATE,
    _OKABE_ITO["sky"],
    START,
    (150, 120, 220),
    FACTORS["wheel"],
    (140, 110, 70),
)
"""Colours of runs that are shown together."""


def hex_of(color: Rgb) -> str:
    """Return a colour as matplotlib and HTML name it."""
    return f"#{bytes(color).hex()}"


TEXT = hex_of(INK)
FAINT = "#6c7280"
LINE = "#c3c8d0"

_DPI = 130
PANEL_IN = 3.0
WIDE_IN = 5.0
"""Width of panels of which a page has one or two."""
HEAD_IN = 0.5
COLUMNS = 4
IMAGE_PX = 1000
"""Longer side of an image that is drawn pixel by pixel."""
MOST_CELLS = 4000
"""Longer side of a grid whose cells are drawn, and not some of them as one."""
CELL_PX = 4
"""Edge of a cell in which more than its state is drawn."""
MARGIN_M = 0.3
"""Around a path or a map; above the highest pose, what lies higher would hide the rooms from above."""
STRAY_PERCENT = 1.0
"""Points that may lie outside of a picture at each side: a few far returns must not shrink the rest."""
BAND_ALPHA = 60


def new_figure(width_in: float, height_in: float, *, background: Rgb = PAPER) -> "Figure":
    """Return an empty page."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # takes half a second
    from matplotlib.figure import Figure

    figure = Figure((width_in, height_in), dpi=_DPI, facecolor=hex_of(background))
    FigureCanvasAgg(figure)
    return figure


def save(figure: "Figure", path: Path) -> None:
    """Write a page as PNG, atomically."""
    with atomic_file(path) as part:
        part.write_bytes(png_of(figure))


def png_of(figure: "Figure") -> bytes:
    """Return a page as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    with warnings.catch_warnings():
        # A log's name may have characters that the font has not: they are drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph", category=UserWarning)
        canvas.draw()
    pixels = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
    # A third of the time that matplotlib's own encoder takes, and smaller.
    _, png = cv2.imencode(
        ".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    )
    return png.tobytes()


def quiet_frame(axes: "Axes", *, label_size: int) -> None:
    """Draw the frame and the ticks of axes fainter than what they hold."""
    axes.tick_params(colors=FAINT, labelsize=label_size)
    for spine in axes.spines.values():
        spine.set_color(LINE)


def fit_to_window(axes: "Axes", low: Array, high: Array) -> None:
    """Show what lies between two (2,) corners, as long one way as the other."""
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")


def scale_bar(axes: "Axes", low: Array, high: Array, *, color: str) -> None:
    """Draw a bar of a round length in the lower left corner.

    Args:
        axes: Axes in metres.
        low: (2,) lower left corner of the map, metres.
        high: (2,) upper right corner.
        color: Colour of the bar and its length.
    """
    length_m = round_length(0.2 * float(high[0] - low[0]))
    x, y = low + 0.035 * (high - low)
    axes.plot([x, x + length_m], [y, y], color=color, linewidth=3, solid_capstyle="butt")
    axes.annotate(f"{length_m:g} m", (x, y), (0, 5), textcoords="offset points", color=color, fontsize=9)


def mark_ends(axes: "Axes", positions: Array, *, end: str = "end") -> None:
    """Mark where a path begins and ends, (N, 2) or more metres."""
    ends = (positions[0], START, "o", "start"), (positions[-1], END, "s", end)
    for position, color, marker, label in ends:
        (mark,) = axes.plot(*position[:2], marker, color=hex_of(color), markersize=8, label=label)
        mark.set(markeredgecolor="white", markeredgewidth=1.4)


def round_length(length_m: float) -> float:
    """Return the largest of 1, 2 or 5 times a power of ten that is not longer."""
    decade = 10.0 ** np.floor(np.log10(length_m))
    return float(max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= length_m))


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
_LEFT_IN, _RIGHT_IN, _BELOW_IN, _ABOVE_IN = 0.85, 0.15, 0.45, 0.3
_BOX_IN, _LETTER_IN = 0.3, 0.062
_EXTENT_MARGIN = 0.15
_WIDE = 1e3  # from here on ticks at 1, 2, 5 would be written over one another


def color_of(number: int) -> Rgb:
    """Return the colour of the n-th method."""
    return _COLORS[number % len(_COLORS)]


def panels(
    title: str,
    count: int,
    *,
    columns: int = COLUMNS,
    width_in: float = PANEL_IN,
    height_in: float | None = None,
    left_in: float = _LEFT_IN,
    right_in: float = _RIGHT_IN,
    legend_in: float = 0.0,
) -> tuple["Figure", list["Axes"]]:
    """Return a page with a headline, and its panels row by row from the upper left.

    Args:
        title: Headline.
        count: Number of panels, all of one size.
        columns: Largest number of panels in a row.
        width_in: Width of a panel.
        height_in: Height of a panel; None is its width.
        left_in: Each panel's room for what stands at its left.
        right_in: Each panel's room at its right.
        legend_in: The page's room for a legend at the right.
    """
    height_in = height_in or width_in
    columns = min(count, columns)
    rows = -(-count // columns)
    page_in = np.array([width_in * columns + legend_in, height_in * rows + HEAD_IN])
    figure = new_figure(*page_in)
    figure.text(0.02, 1.0 - 0.2 / page_in[1], title, fontsize=12, fontweight="bold", color=TEXT, va="top")
    size = np.array([width_in - left_in - right_in, height_in - _BELOW_IN - _ABOVE_IN]) / page_in
    drawn = []
    for row, column in (divmod(number, columns) for number in range(count)):
        corner_in = (column * width_in + left_in, (rows - 1 - row) * height_in + _BELOW_IN)
        axes = figure.add_axes((*(corner_in / page_in), *size))
        quiet_frame(axes, label_size=7)
        drawn.append(axes)
    return figure, drawn


def image_panels(
    title: str, count: int, shape: tuple[int, ...], *, width_in: float = PANEL_IN, right_in: float = 0.1
) -> tuple["Figure", list["Axes"]]:
    """Return a page of panels for images of one size, (H, W) or (H, W, 3)."""
    height_in = (width_in - 0.1 - right_in) * shape[0] / shape[1] + _BELOW_IN + _ABOVE_IN
    return panels(title, count, width_in=width_in, height_in=height_in, left_in=0.1, right_in=right_in)


def box_panels(title: str, count: int, labels: Sequence[str]) -> tuple["Figure", list["Axes"]]:
    """Return a page of panels for boxes, all with the same labels."""
    left_in = 0.3 + _LETTER_IN * max(map(len, labels))
    height_in = 0.9 + _BOX_IN * len(labels)
    return panels(title, count, width_in=WIDE_IN, height_in=height_in, left_in=left_in)


def caption(axes: "Axes", *, title: str = "", x: str = "", y: str = "") -> None:
    """Write a panel's title and the names of its axes, those that are given."""
    if title:
        axes.set_title(title, fontsize=9, color=TEXT)
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
        box.set(facecolor=hex_of(color_of(number)), alpha=0.55, edgecolor=TEXT, linewidth=0.6)
        median.set(color=TEXT, linewidth=1.2)
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
    half = max((0.5 + _EXTENT_MARGIN) * float((high - low).max()), 1e-3)
    middle = 0.5 * (low + high)
    return middle - half, middle + half


SIGMAS = 2.0
"""Half the band's width, in standard deviations: in one direction 95 % of the errors lie within."""


def band_image(positions: Array, half_widths_m: Array, *, low: Array, high: Array) -> NDArray[np.uint8]:
    """Return an RGBA image, row 0 lowest, of a band of varying width around a path.

    Args:
        positions: (N, 2) or (N, 3) metres.
        half_widths_m: (N,); where one is NaN the band is interrupted.
        low: (2,) metres, the image's lower corner.
        high: (2,) metres, its upper corner.
    """
    pixel_m = float((high - low).max()) / IMAGE_PX
    width, height = np.ceil((high - low) / pixel_m).astype(int)
    mask = np.zeros((max(height, 1), max(width, 1)), np.uint8)
    places = np.rint((positions[:, :2] - low) / pixel_m - 0.5).astype(np.int32)
    # OpenCV refuses larger circles, which cover all.
    radii = np.clip(half_widths_m / pixel_m, 1.0, 2.0 * IMAGE_PX)
    known = np.isfinite(half_widths_m)
    for index in np.flatnonzero(known).tolist():
        radius = float(radii[index])
        cv2.circle(mask, places[index].tolist(), round(radius), BAND_ALPHA, thickness=-1)
        if index and known[index - 1]:
            thickness = max(1, round(radius + float(radii[index - 1])))
            cv2.line(mask, places[index - 1].tolist(), places[index].tolist(), BAND_ALPHA, thickness)
    return np.dstack([np.broadcast_to(np.array(ESTIMATE, np.uint8), (*mask.shape, 3)), mask])
