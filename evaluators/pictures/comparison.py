"""Pictures and recording of a comparison: every method's path over the truth, and its errors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mapper.core.geometry import Array
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.odometry import OdometryRun
from mapper.export.figures import (
    END,
    FAINT,
    LINE,
    START,
    TRUTH,
    WIDE_IN,
    by_logarithm,
    caption,
    color_of,
    draw_boxes,
    extent,
    fit_to_window,
    hex_of,
    panels,
    save,
    widest_axes,
)
from mapper.export.mcap_log import McapLog

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LEGEND_IN = 1.3


def write_paths(
    path: Path,
    paths: Mapping[str, Trajectory],
    *,
    truth: Trajectory | None,
    captions: Mapping[str, str],
    title: str,
) -> None:
    """Draw every method's path in a panel of its own, over the truth, from the side on which that is widest.

    All panels have the scale of the truth: a path that leaves it leaves the panel.

    Args:
        path: PNG file to write.
        paths: Name to path, laid over the truth; an empty path leaves its panel to the truth.
        truth: True poses of the body, or None: then each panel is as wide as its path.
        captions: A few words for each name.
        title: Headline.
    """
    figure, panes = panels(title, len(paths))
    reference = _reference(paths, truth)
    axes_world = widest_axes(reference)
    low, high = extent(reference @ axes_world.T)
    for number, (axes, (name, trajectory)) in enumerate(zip(panes, paths.items(), strict=True)):
        if truth is not None:
            axes.plot(
                *(truth.positions_world @ axes_world.T).T, color=hex_of(TRUTH), linewidth=2.2, alpha=0.5
            )
        if len(trajectory):
            seen = trajectory.positions_world @ axes_world.T
            axes.plot(*seen.T, color=hex_of(color_of(number)), linewidth=1.0)
            axes.plot(*seen[0], "o", color=hex_of(START), markersize=4)
            axes.plot(*seen[-1], "s", color=hex_of(END), markersize=4)
        caption(axes, title=f"{name}: {captions[name]}")
        fit_to_window(axes, low, high)
    save(figure, path)


def write_path_errors(
    path: Path, positions_m: Mapping[str, Array], steps_m: Mapping[str, Array], *, step: str, title: str
) -> None:
    """Draw what share of the poses lies within which distance of the truth, and boxes of the steps' errors.

    Args:
        path: PNG file to write.
        positions_m: Name to the (N,) distances of a path's poses.
        steps_m: Name to the (S,) errors of its motion over steps of one length.
        step: That length, in words.
        title: Headline.
    """
    figure, (shares, boxes) = panels(title, 2, width_in=WIDE_IN)
    _draw_shares(shares, positions_m, list(positions_m))
    caption(shares, x="distance from the truth, m", y="share of the poses")
    draw_boxes(boxes, steps_m)
    caption(boxes, x=f"error of the motion over {step}, m")
    save(figure, path)


def write_registration_errors(
    path: Path, errors_m: Mapping[str, Mapping[str, Array]], *, max_error_m: float, title: str
) -> None:
    """Draw, for each kind of guess, what share of the registrations lies within which distance of the truth.

    Registrations without an answer count as infinitely far, so a curve ends at the share of answers.

    Args:
        path: PNG file to write.
        errors_m: Kind of guess to name to the (N,) distances.
        max_error_m: Largest error that counts as right.
        title: Headline.
    """
    names = list(dict.fromkeys(name for kind in errors_m.values() for name in kind))
    count = len(errors_m)
    figure, panes = panels(title, count, columns=count, width_in=WIDE_IN, legend_in=_LEGEND_IN)
    for axes, (kind, of_name) in zip(panes, errors_m.items(), strict=True):
        axes.axvline(max_error_m, color=FAINT, linewidth=0.8, linestyle="dashed")
        _draw_shares(axes, of_name, names)
        shares = "share of the pairs" if axes is panes[0] else ""
        caption(axes, title=kind, x="distance from the truth, m", y=shares)
    lines, labels = axes.get_legend_handles_labels()
    figure.legend(lines, labels, loc="center right", fontsize=8, frameon=False)
    save(figure, path)


def _draw_shares(axes: "Axes", errors: Mapping[str, Array], names: Sequence[str]) -> None:
    everything = np.concatenate([np.empty(0), *errors.values()])
    finite = everything[np.isfinite(everything) & (everything > 0.0)]
    farthest = 1.3 * float(finite.max()) if len(finite) else 1.0
    for name, all_of_it in errors.items():
        known = np.sort(all_of_it[np.isfinite(all_of_it)])
        share = np.arange(1, len(known) + 1) / max(len(all_of_it), 1)
        color = hex_of(color_of(names.index(name)))
        # Each curve goes on to the edge, so that shares can be read off there.
        x, y = np.append(known, farthest), np.append(share, share[-1] if len(share) else 0.0)
        axes.step(x, y, where="post", color=color, linewidth=1.3, label=name)
    by_logarithm(axes)
    axes.set_ylim(0.0, 1.02)
    axes.grid(color=LINE, linewidth=0.4)


def _reference(paths: Mapping[str, Trajectory], truth: Trajectory | None) -> Array:
    shown = [truth] if truth is not None else [path for path in paths.values() if len(path)]
    return np.concatenate([np.zeros((0, 3)), *(path.positions_world for path in shown)])


def write_comparison_log(
    path: Path,
    runs: Sequence[OdometryRun],
    *,
    truth: Trajectory | None,
    trials: Sequence[Mapping[str, Any]],
) -> None:
    """Write /trajectory/NAME for every method and the truth, /errors/NAME, and /trials/NAME.

    Args:
        path: MCAP file to write.
        runs: Every method's; one without poses is left out.
        truth: True poses of the body.
        trials: A record of every registration. Its times are left out, so that the same comparison gives the
            same bytes.
    """
    with McapLog(path) as log:
        starts = [int(run.trajectory.stamps_ns[0]) for run in runs if len(run.trajectory)]
        if truth is not None and starts:
            log.trajectory(min(starts), truth, name="truth", color=TRUTH)
        for number, run in enumerate(runs):
            if len(run.trajectory):
                log.trajectory(min(starts), run.trajectory, name=run.method, color=color_of(number))
        for run in runs:
            if run.matched is None:
                continue
            rows = zip(
                run.matched.stamps_ns.tolist(),
                run.matched.position_errors_m.tolist(),
                run.matched.rotation_errors_rad.tolist(),
                strict=True,
            )
            for stamp_ns, position_m, rotation_rad in rows:
                log.record(
                    f"/errors/{run.method}",
                    "mapper/msg/PathError",
                    stamp_ns,
                    {"position_m": position_m, "rotation_rad": rotation_rad},
                )
        for trial in trials:
            log.record(
                f"/trials/{trial['method']}",
                "mapper/msg/Trial",
                trial["target_ns"],
                {
                    "source_ns": trial["source_ns"],
                    "frames_apart": trial["frames_apart"],
                    "guess_off_by": trial["guess"],
                    "outcome": trial["outcome"],
                    "translation_m": _known(trial["translation_m"]),
                    "rotation_rad": _known(trial["rotation_rad"]),
                    "reason": trial["reason"],
                },
            )


def _known(error: float | None) -> float:
    return np.inf if error is None else error
