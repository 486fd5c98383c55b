"""Trial of other settings of the odometry, on the stretch of a log with most lost and doubtful frames."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.config.build import BuildConfig
from mapper.config.loading import overridden
from mapper.core.errors import ConfigError, MapperError
from mapper.core.frames import Sensor
from mapper.core.timebase import NS_PER_S
from mapper.loops.config import NoLoopsConfig
from mapper.odometry.config import PnpConfig
from mapper.odometry.scans.config import HoughOdometryConfig
from mapper.pipeline.track import track_log
from mapper.run.manifest import Trial
from mapper.run.results import RunResults
from mapper.run.timeline import span_text
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

_FRAMES: Mapping[Sensor, int] = {"rgbd": 40, "lidar": 15}
"""Length of a trial by sensor: some seconds of work for all settings together."""
_LEAD = 4
"""A trial begins 1 / ``_LEAD`` of its frames before the stretch in question, to have a map there."""

_FACTORS: Mapping[str, Mapping[str, float]] = {
    "local-map": {"detector.max_features": 2, "search_px": 2, "max_depth_m": 2},
    "pnp": {"detector.max_features": 2, "max_depth_m": 2},
    "isvd": {"detector.max_features": 2, "previous_frames": 2, "max_depth_m": 2},
    "gicp": {"voxel_m": 0.5, "coarse_cell_m": 2, "keyframe_distance_m": 0.5},
    "icp": {"voxel_m": 0.5, "keyframe_distance_m": 0.5},
    "kiss-icp": {"map_voxel_m": 0.5, "keyframe_distance_m": 0.5},
    "hough-ndt": {"voxel_m": 0.5},
}
"""Settings that are tried, by kind of odometry, with the factor from the run's own value to the other."""
_OTHERS: Mapping[str, PnpConfig | HoughOdometryConfig] = {
    "local-map": PnpConfig(),
    "gicp": HoughOdometryConfig(),
    "icp": HoughOdometryConfig(),
}
"""Other odometry that is tried, by kind of the run's own."""


def try_settings(
    source: Log, config: BuildConfig, results: RunResults, *, progress: Progress = SILENT
) -> Trial | None:
    """Track the stretch in which most frames were lost or doubtful again, with a few other settings.

    The run's own settings are tried too, from the stretch's first frame on and without loops, so that the
    numbers can be compared. The stretch is chosen by counting frames, so the same log gives the same trial.

    Returns:
        Number of frames that each setting lost or doubted; None if no frame was, or no other setting applies.
    """
    unplaced_ns = [record.stamp_ns for record in results.records if record.outcome in ("lost", "doubtful")]
    candidates = dict(candidate_settings(config))
    is_unplaced = np.isin(source.stamps_ns, unplaced_ns)
    if not is_unplaced.any() or not candidates:
        return None
    frames = worst_stretch(is_unplaced, _FRAMES[source.sensor])
    stretch = source.subset(frames)
    begin_s, end_s = ((stretch.stamps_ns[[0, -1]] - source.stamps_ns[0]) / NS_PER_S).tolist()
    with progress.stage("try") as report:
        own = _unplaced(stretch, config)
        tried = {}
        for done, (setting, other) in enumerate(candidates.items(), start=1):
            tried[setting] = _unplaced(stretch, other)
            report(done, len(candidates))
    return Trial(where=span_text(begin_s, end_s), frames=len(frames), unplaced=own, tried=tried)


def candidate_settings(config: BuildConfig) -> Iterator[tuple[str, BuildConfig]]:
    """Yield the settings to try instead of a configuration's own, as ``--set`` takes them."""
    odometry = config.odometry
    for name, factor in _FACTORS.get(odometry.kind, {}).items():
        value: Any = odometry.model_dump()
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if not isinstance(value, int | float):
            continue  # None, or another detector's
        other = int(value * factor) if isinstance(value, int) else value * factor
        setting = f"odometry.{name}={other:g}"
        try:
            yield setting, overridden(config, [setting])
        except ConfigError:
            continue  # beyond what the setting may be
    if (instead := _OTHERS.get(odometry.kind)) is not None:
        yield f"odometry.kind={instead.kind}", config.model_copy(update={"odometry": instead})


def worst_stretch(is_unplaced: NDArray[np.bool_], length: int) -> NDArray[np.intp]:
    """Return the indices of the frames of a trial: those among which most are lost or doubtful.

    Args:
        is_unplaced: (N,) whether each frame of the log is lost or doubtful.
        length: Number of frames of a trial; a shorter log is tried whole.
    """
    counts = np.concatenate([[0], np.cumsum(is_unplaced)])
    begins = np.arange(max(len(is_unplaced) - length, 0) + 1)
    lead = length // _LEAD
    after = np.minimum(begins + lead, len(is_unplaced))
    until = np.minimum(begins + length, len(is_unplaced))
    # The first frames of a trial count little: a map begins there.
    worst = int((counts[until] - counts[np.where(begins > 0, after, 0)]).argmax())
    return np.arange(worst, int(until[worst]))


def _unplaced(stretch: Log, config: BuildConfig) -> int:
    try:
        tracking = track_log(stretch, config.model_copy(update={"loops": NoLoopsConfig()}), progress=SILENT)
    except MapperError:
        return len(stretch)
    return len(stretch) - len(tracking.tracked)
