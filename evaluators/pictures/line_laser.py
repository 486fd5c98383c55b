"""Pictures of a line-laser sensor: what each method keeps of an image, and the laws fitted to shots."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapper.core.frames import Image
from mapper.core.geometry import Array
from mapper.export.figures import (
    ESTIMATE,
    FAINT,
    LINE,
    TEXT,
    TRUTH,
    caption,
    hex_of,
    image_panels,
    new_figure,
    quiet_frame,
    save,
)
from mapper.line_laser.calibration import CalibrationShot, Fit, ahead_m, row_px, up_px
from mapper.line_laser.config import StripeConfig
from mapper.line_laser.detection import Method, responses, stripe_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TITLES: Mapping[Method, str] = {
    "hue": "hue (figure 2.2)",
    "intensity": "intensity (2.39)",
    "weight": "2R − G − B (2.41)",
    "union": "maximum of both (2.42)",
    "edges": "Laplacian of Gaussian",
    "combined": "maximum AND edges (2.43)",
}


def write_detections(
    path: Path, image: Image, config: StripeConfig, *, title: str, true_rows: Array | None = None
) -> None:
    """Draw an image, what every method keeps of it, and where each takes the stripe to be.

    Args:
        path: PNG file to write.
        image: (H, W, 3) RGB.
        config: Settings of the stripe detection.
        title: Headline.
        true_rows: (W,) where the stripe is, NaN where there is none, if that is known.
    """
    kept = responses(image, config)
    rows = {method: stripe_rows(response, join_px=config.join_px) for method, response in kept.items()}
    colors = "orange: the row found" + ("" if true_rows is None else "; blue: the true one")
    figure, panes = image_panels(f"{title} – {colors}", 1 + len(kept), image.shape)
    nothing = np.full(image.shape[1], np.nan)
    shown = [("image", image, nothing)]
    shown += [
        (f"{_TITLES[method]}: {np.isfinite(rows[method]).mean():.0%} of columns", response, rows[method])
        for method, response in kept.items()
    ]
    for axes, (name, pixels, found) in zip(panes, shown, strict=True):
        # What is kept must be seen, however dark it is.
        visible = pixels if pixels.ndim == 3 else np.where(pixels > 0, 110 + pixels * (145.0 / 255.0), 0.0)
        axes.imshow(visible, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
        if true_rows is not None and found is not nothing:
            axes.plot(true_rows, color=hex_of(TRUTH), linewidth=3.0, alpha=0.55)
        axes.plot(found, ".", color=hex_of(ESTIMATE), markersize=1.6)
        axes.set_xlim(0, image.shape[1] - 1)
        axes.set_ylim(image.shape[0] - 1, 0)
        axes.set_axis_off()
        caption(axes, title=name)
    save(figure, path)


def write_calibration_picture(path: Path, fit: Fit, shots: Sequence[CalibrationShot]) -> None:
    """Draw both laws through the shots they were fitted to, and how far these are off.

    Args:
        path: PNG file to write.
        fit: The laws and their errors.
        shots: Shots that they were fitted to, in the same order.
    """
    calibration = fit.calibration
    figure = new_figure(11.0, 4.6)
    figure.text(0.065, 0.925, "Calibration of a line laser", fontsize=14, fontweight="bold", color=TEXT)
    law, lateral = calibration.range, calibration.lateral
    far_px = row_px(calibration, calibration.reach_m)
    rows = np.linspace(min(shot.board.row_px for shot in shots), far_px, 200)
    axes = figure.add_axes((0.065, 0.13, 0.4, 0.68))
    above_px, percent = up_px(calibration.height_px, rows), 100.0 / calibration.height_px
    _law(axes, percent * above_px, ahead_m(calibration, rows))
    for shot, shot_px, error_m in zip(shots, _above_px(fit, shots), fit.range_errors_m, strict=True):
        _shot(axes, percent * shot_px, shot.range_m, f"{1e3 * error_m:+.1f} mm")
    axes.set_xlabel("height of the stripe in the image, p (0 bottom … 100 top)", fontsize=9, color=FAINT)
    axes.set_title(
        f"range: {law.scale_mm:.0f} · p$^{{{law.exponent:.4f}}}$ mm", fontsize=10.5, color=TEXT, loc="left"
    )
    axes.set_ylabel("range (m)", fontsize=9, color=FAINT)
    wide = [shot for shot in shots if shot.width_m is not None and shot.board.width_px is not None]
    axes = figure.add_axes((0.56, 0.13, 0.4, 0.68))
    _law(axes, above_px, lateral.slope * above_px + lateral.offset)
    for shot, shot_px, error_m in zip(wide, _above_px(fit, wide), fit.width_errors_m, strict=True):
        px_per_cm = (shot.board.width_px or 0) / (100.0 * (shot.width_m or 1.0))
        _shot(axes, shot_px, px_per_cm, f"{1e3 * error_m:+.1f} mm")
    axes.set_xlabel("height of the stripe in the image, y (px)", fontsize=9, color=FAINT)
    axes.set_ylabel("px per cm", fontsize=9, color=FAINT)
    axes.set_title(
        f"lateral: x / ({lateral.slope:.4f} y {lateral.offset:+.4f}) cm",
        fontsize=10.5,
        color=TEXT,
        loc="left",
    )
    save(figure, path)


def _above_px(fit: Fit, shots: Sequence[CalibrationShot]) -> list[float]:
    rows_px = np.array([shot.board.row_px for shot in shots])
    above_px: list[float] = up_px(fit.calibration.height_px, rows_px).tolist()
    return above_px


def _law(axes: "Axes", x: Array, y: Array) -> None:
    axes.plot(x, y, color=hex_of(ESTIMATE), linewidth=1.6)
    axes.margins(x=0.14)
    axes.grid(color=LINE, linewidth=0.5, alpha=0.6)
    quiet_frame(axes, label_size=8)


def _shot(axes: "Axes", x: float, y: float, label: str) -> None:
    axes.plot(x, y, "o", color=hex_of(TRUTH), markersize=5)
    axes.annotate(label, (x, y), (7, -3), textcoords="offset points", fontsize=7.5, color=FAINT)
