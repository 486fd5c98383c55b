"""A run drawn on a caller's axes, and its summary for a notebook."""

import base64
from html import escape
from typing import TYPE_CHECKING

from mapper.core.trajectory import plan_axes
from mapper.export.html import table
from mapper.export.picture import draw_summary
from mapper.run import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mapper.run.folder import Run


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
    picture = ""
    if (run.path / files.SUMMARY).is_file():
        data = base64.b64encode(run.file(files.SUMMARY).read_bytes()).decode("ascii")
        picture = f'<img alt="path over the slice" style="max-width:100%" src="data:image/png;base64,{data}">'
    return f"<b>{escape(str(run.path))}</b>{table(('', ''), rows)}{picture}"
