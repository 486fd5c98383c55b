"""Page of every picture: an empty figure, and its file.

Matplotlib is driven through its objects: pyplot would keep global state and pick a GUI backend.
"""

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

INK = "#{:02x}{:02x}{:02x}".format(*palette.INK)
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
    with atomic_file(path) as part:
        # Matplotlib would sign with its version: the same run must give the same bytes.
        figure.savefig(part, format="png", metadata={"Software": None})


def hex_of(color: Rgb) -> str:
    """Return a colour as matplotlib and HTML name it."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def scale_bar(axes: "Axes", low: Array, high: Array, *, color: str) -> None:
    """Draw a bar of a round length in the lower left corner.

    Args:
        axes: In metres.
        low: (2,) lower left corner of the map, metres.
        high: (2,) upper right corner.
        color: Of the bar and its length.
    """
    length_m = round_length(0.2 * float(high[0] - low[0]))
    x, y = low + 0.035 * (high - low)
    axes.plot([x, x + length_m], [y, y], color=color, linewidth=3, solid_capstyle="butt")
    axes.annotate(f"{length_m:g} m", (x, y), (0, 5), textcoords="offset points", color=color, fontsize=9)


def round_length(length_m: float) -> float:
    """Return the largest of 1, 2 or 5 times a power of ten that is not longer."""
    decade = 10.0 ** np.floor(np.log10(length_m))
    return float(max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= length_m))
