"""Page of every picture: an empty figure, and its file.

Matplotlib is driven through its objects: pyplot would keep global state and pick a GUI backend.
"""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.geometry import Array
from mapper.export import palette
from mapper.export.palette import Rgb
from mapper.runtime.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def hex_of(color: Rgb) -> str:
    """Return a colour as matplotlib and HTML name it."""
    return f"#{bytes(color).hex()}"


INK = hex_of(palette.INK)
FAINT = "#6c7280"
LINE = "#c3c8d0"

_DPI = 130


def new_figure(width_in: float, height_in: float, *, background: Rgb = (255, 255, 255)) -> "Figure":
    """Return an empty page."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # takes half a second
    from matplotlib.figure import Figure

    figure = Figure((width_in, height_in), dpi=_DPI, facecolor=hex_of(background))
    FigureCanvasAgg(figure)
    return figure


def save(figure: "Figure", path: Path) -> None:
    """Write a page as PNG, atomically."""
    with atomic_file(path) as part, warnings.catch_warnings():
        # A log's name may have characters that the font has not: they are drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph", category=UserWarning)
        # Matplotlib would sign with its version: the same run must give the same bytes.
        figure.savefig(part, format="png", metadata={"Software": None})


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


def round_length(length_m: float) -> float:
    """Return the largest of 1, 2 or 5 times a power of ten that is not longer."""
    decade = 10.0 ** np.floor(np.log10(length_m))
    return float(max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= length_m))
