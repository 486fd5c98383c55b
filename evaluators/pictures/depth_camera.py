"""Files of a depth camera's study: numbers, pictures of its errors, and a configuration for builds."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.config import toml_text
from mapper.core.units import MM_PER_M
from mapper.evaluators.sensors.depth_accuracy import Accuracy, DepthLevel, ResidualMap
from mapper.evaluators.sensors.depth_study import DepthStudy, NoiseFit, records_of
from mapper.evaluators.study.table import csv_text
from mapper.export.figures import (
    ESTIMATE,
    FAINT,
    LINE,
    PANEL_IN,
    START,
    STRAY_PERCENT,
    TEXT,
    WIDE_IN,
    Rgb,
    caption,
    hex_of,
    image_panels,
    panels,
    save,
)
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, write_json, write_text
from mapper.sensing.depth import depth_sigma_m

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SENSOR, NUMBERS, ACCURACY, RESIDUALS = "sensor.toml", "depth.csv", "accuracy.png", "residuals.png"
FOLDER = FolderKind(
    "a depth camera's study",
    manifest_keys=frozenset({"noise", "levels"}),
    files=frozenset({SENSOR, NUMBERS, ACCURACY, RESIDUALS}),
    kind="depth accuracy",
)

_RAW, _FILTERED = START, ESTIMATE
"""Green before DIF and red after, as in Somlyai (PhD thesis), figure 2.16."""

_BAR_IN = 0.65


def write_depth_study(folder: Path, study: DepthStudy) -> None:
    """Fill an existing folder with numbers, pictures and the configuration."""
    title = f"{study.logs[0]}{' and more' if len(study.logs) > 1 else ''}: depth"
    write_text(folder / SENSOR, _sensor_toml(study))
    write_text(folder / NUMBERS, csv_text(records_of(study)))
    write_accuracy(folder / ACCURACY, study.levels, study.fit, title=f"{title} accuracy")
    write_residuals(folder / RESIDUALS, study.maps, title=f"{title} less that of the plane")
    fit = study.fit
    record = {
        "kind": "depth accuracy",
        "logs": list(study.logs),
        "distances": "given" if study.is_known else "fitted",
        "noise": fit.noise.model_dump(),
        "form": fit.form,
        "uncertainty": [None if math.isnan(error) else float(error) for error in fit.uncertainty],
        "misfit_ratio": fit.misfit_ratio,
        "between_m": [fit.low_m, fit.high_m],
        "levels": [asdict(level) for level in study.levels],
    }
    write_json(folder / MANIFEST_NAME, record)


def _sensor_toml(study: DepthStudy) -> str:
    fit = study.fit
    settings = toml_text({"odometry": {"depth_noise": fit.noise.model_dump()}})
    return (
        f"# mapper sensor depth: σ_z = {fit.noise.text} m,\n"
        f"# measured at {fit.low_m:.2f} … {fit.high_m:.2f} m in {', '.join(study.logs)}\n\n{settings}\n"
    )


def write_accuracy(path: Path, levels: Sequence[DepthLevel], fit: NoiseFit, *, title: str) -> None:
    """Draw the largest error and the standard deviation over the distance, before and after DIF.

    Args:
        path: PNG file to write.
        levels: Distances from near to far.
        fit: The noise before DIF as a curve.
        title: Headline.
    """
    figure, (axes, spreads) = panels(title, 2, width_in=WIDE_IN)
    distance_m = [level.typical.distance_m for level in levels]
    for label, color, accuracies in _kinds(levels):
        largest = [MM_PER_M * one.max_error_m for one in accuracies]
        most = [MM_PER_M * one.max_error_99_m for one in accuracies]
        axes.plot(distance_m, largest, "o-", color=hex_of(color), markersize=4, label=f"{label}, all pixels")
        axes.plot(
            distance_m,
            most,
            "o--",
            color=hex_of(color),
            markersize=4,
            label=f"{label}, without the worst 1 %",
        )
    _finish(axes, "largest error Δd, mm")
    z = np.linspace(fit.low_m, fit.high_m, 200)
    spreads.plot(
        z, MM_PER_M * depth_sigma_m(fit.noise, z), color=TEXT, linewidth=1.0, label=f"σ = {fit.noise.text} m"
    )
    for label, color, accuracies in _kinds(levels):
        spread = [MM_PER_M * one.std_m for one in accuracies]
        spreads.plot(distance_m, spread, "o", color=hex_of(color), markersize=5, label=label)
    for marker, label, known_m in (
        ("^", "of a pixel over time", [level.temporal_m for level in levels]),
        ("v", "that stays over time", [level.fixed_m for level in levels]),
        ("_", "a step of quantisation", [level.typical.step_m for level in levels]),
    ):
        _draw_known(spreads, distance_m, known_m, marker=marker, label=label)
    _finish(spreads, "standard deviation s, mm")
    save(figure, path)


def _kinds(levels: Sequence[DepthLevel]) -> tuple[tuple[str, Rgb, list[Accuracy]], ...]:
    return (
        ("before DIF", _RAW, [level.typical.raw for level in levels]),
        ("after DIF", _FILTERED, [level.typical.filtered for level in levels]),
    )


def _draw_known(
    axes: "Axes", distance_m: Sequence[float], values_m: Sequence[float | None], *, marker: str, label: str
) -> None:
    known = [
        (x, MM_PER_M * value) for x, value in zip(distance_m, values_m, strict=True) if value is not None
    ]
    if known:
        axes.plot(*np.array(known).T, marker, color=FAINT, markersize=5, label=label, fillstyle="none")


def _finish(axes: "Axes", quantity: str) -> None:
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    caption(axes, x="distance, m", y=quantity)
    axes.grid(color=LINE, linewidth=0.4)
    axes.legend(loc="upper left", fontsize=8, framealpha=0.92, edgecolor=LINE)


def write_residuals(path: Path, maps: Sequence[ResidualMap], *, title: str) -> None:
    """Draw by how much each pixel's depth is off, over the grey images.

    Every panel has its own scale, up to the 99th percentile of its errors.

    Args:
        path: PNG file to write.
        maps: One or more.
        title: Headline.
    """
    width_in = PANEL_IN if len(maps) > 1 else 2.0 * PANEL_IN
    shape = maps[0].image.shape
    figure, panes = image_panels(title, len(maps), shape, width_in=width_in, right_in=_BAR_IN)
    for axes, one in zip(panes, maps, strict=True):
        known = np.abs(one.error_m[~np.isnan(one.error_m)])
        most_mm = MM_PER_M * max(float(np.percentile(known, 100.0 - STRAY_PERCENT)), 1e-6)
        axes.imshow(one.image, cmap="gray", vmin=0, vmax=255)
        shown = axes.imshow(MM_PER_M * one.error_m, cmap="RdBu_r", vmin=-most_mm, vmax=most_mm)
        bar = figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)))
        bar.ax.tick_params(labelsize=7, colors=FAINT)
        caption(axes, title=f"{one.caption}; mm")
        axes.set_axis_off()
    save(figure, path)
