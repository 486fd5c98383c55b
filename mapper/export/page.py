"""Page of every picture: an empty figure, and its file.

Matplotlib is driven through its objects: pyplot would keep global state and pick a GUI backend.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from mapper.export.palette import Rgb
from mapper.runtime.atomic import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK = "#1e2129"
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
