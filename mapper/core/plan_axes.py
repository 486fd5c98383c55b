"""Matplotlib's axes for what is seen from above."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plan_axes(axes: "Axes | None") -> "Axes":
    """Return axes of x and y in metres, of equal scale: those given, or of a new figure of pyplot's."""
    if axes is None:
        import matplotlib.pyplot as plt  # keeps global state, which only a caller without axes needs

        axes = plt.subplots(layout="constrained")[1]
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    return axes
