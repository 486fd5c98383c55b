"""A run on a caller's axes and in a notebook."""

import base64
import re
import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

mpl.use("Agg")


@pytest.fixture
def axes(desk_run):
    found = Figure().subplots()
    assert desk_run.plot(found) is found
    return found


def test_the_path_is_drawn_in_metres(desk_run, axes):
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    np.testing.assert_array_equal(lines["estimate"], desk_run.trajectory.positions[:, :2])
    np.testing.assert_array_equal(lines["start"][0], desk_run.trajectory.positions[0, :2])
    (low_x, high_x), (low_y, high_y) = axes.get_xlim(), axes.get_ylim()
    x, y = desk_run.slice.origin
    assert low_x <= x < x + desk_run.slice.cells.shape[1] * desk_run.slice.resolution <= high_x
    assert low_y <= y < y + desk_run.slice.cells.shape[0] * desk_run.slice.resolution <= high_y


def test_the_truth_lies_on_the_path(desk_run, axes):
    truth = next(line.get_xydata() for line in axes.lines if line.get_label() == "truth")
    gaps_m = np.linalg.norm(truth[:, None] - desk_run.trajectory.positions[None, :, :2], axis=2).min(axis=1)
    assert gaps_m.max() < 0.05


def test_without_axes_a_figure_of_pyplot_is_made(desk_run):
    import matplotlib.pyplot as plt

    axes = desk_run.plot()
    assert axes.figure.number in plt.get_fignums()
    plt.close(axes.figure)


def test_a_notebook_shows_verdict_and_picture_without_drawing(desk_run, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    html = desk_run._repr_html_()
    assert desk_run.verdict.state in html
    assert desk_run.manifest.counts.voxels_text in html
    (picture,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert base64.b64decode(picture) == (desk_run.path / "summary.png").read_bytes()
    assert not re.search(r"(?:src|href)=[\"'](?!data:)", html)
