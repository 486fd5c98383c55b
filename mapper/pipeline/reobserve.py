"""Views of a finished run's frames, observed again from the log, since a run does not keep them."""

from collections.abc import Collection, Iterator

from mapper.config.build import BuildConfig
from mapper.core.deskew import twist_at
from mapper.core.trajectory import Trajectory
from mapper.features.frame_view import FrameView
from mapper.odometry.factory import odometry_for
from mapper.odometry.scans.scan_observation import ScanObservation
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.sweep_motion import motion_during
from mapper.sources.base import FrameRef, Log


def reobserve(
    source: Log,
    trajectory: Trajectory,
    stamps_ns: Collection[int],
    config: BuildConfig,
    *,
    progress: Progress = SILENT,
) -> dict[int, FrameView]:
    """Return what ``reobserve_each`` yields, by stamp."""
    return dict(reobserve_each(source, trajectory, stamps_ns, config, progress=progress))


def reobserve_each(
    source: Log,
    trajectory: Trajectory,
    stamps_ns: Collection[int],
    config: BuildConfig,
    *,
    progress: Progress = SILENT,
) -> Iterator[tuple[int, FrameView]]:
    """Yield the stamps and views of some frames of a log, as a configuration's odometry makes them.

    Args:
        source: The log.
        trajectory: Poses of the body: scans are deskewed by its motion.
        stamps_ns: Stamps of the frames; each has a pose.
        config: Settings of the odometry.
        progress: Receives the stage and its counts.

    Raises:
        FrameError: A frame cannot be read.
    """
    odometry = odometry_for(config.odometry, source)
    index_of = {int(stamp_ns): index for index, stamp_ns in enumerate(trajectory.stamps_ns)}

    def view(entry: FrameRef) -> tuple[int, FrameView]:
        observation, index = odometry.read(entry), index_of[entry.stamp_ns]
        if isinstance(observation, ScanObservation):
            motion = motion_during(observation.scan, trajectory, index, source.gyroscope, source.wheels)
        else:
            motion = twist_at(trajectory, index)
        return entry.stamp_ns, odometry.view(observation, motion)

    entries = list(source.entries_of(stamps_ns))
    with progress.stage("observe") as report:
        for done, seen in enumerate(ordered_map(view, entries, workers=config.workers), start=1):
            yield seen
            report(done, len(entries))
