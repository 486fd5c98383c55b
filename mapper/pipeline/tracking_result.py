"""Result of the first pass over a log: every frame's result, and the graph before it is solved."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mapper.config.build import BuildConfig
from mapper.core.errors import TrackingError
from mapper.core.frames import Sensor
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure
from mapper.loops.place_file import AnyPlace, write_places
from mapper.odometry.base import FrameResult, see_more
from mapper.odometry.gyroscope_calibration import GyroscopeCalibration
from mapper.run import files
from mapper.run.doubtful_frames import placed_by_neighbours
from mapper.run.frame_records import records_of
from mapper.run.manifest import RunWarning
from mapper.run.stored_tracking import StoredTracking
from mapper.run.writer import RunWriter
from mapper.sources.base import Log, Skipped
from mapper.sources.frame_selection import too_few_text

BY_POSES = ("wheels", "given")
"""Kinds of odometry without tracking: frames have the poses of wheels, or known ones."""

_HINTS: Mapping[str, str] = {
    "rgbd": "is there texture, and depth in the images?",
    **dict.fromkeys(("lidar", "lidar-2d"), "do the scans overlap, and are their units metres?"),
    "wheels": "do the wheels' readings cover the frames' times, without gaps beyond odometry.max_gap_s?",
    "given": "do the given poses cover the frames' times, without gaps beyond odometry.max_gap_s?",
}


@dataclass(frozen=True, slots=True, eq=False)
class TrackingResult:
    """Result of the first pass over a log.

    Attributes:
        tracks: Results of the frames that could be read, in time order.
        skipped: The frames that could not be read.
        graph: Nodes at the odometry's estimates, with every factor, those of the loops last.
        loops: Every loop candidate with its verdict.
        frame_ms: Wall milliseconds that each frame took to read, detect and track, by stamp.
        warnings: Warnings about the frames that were read.
        places: Places by node, of the nodes that were searched for loops.
        gyroscope: Calibration of the log's gyroscope; None if it has none that was of use.
    """

    tracks: tuple[FrameResult, ...]
    skipped: tuple[Skipped, ...]
    graph: PoseGraph
    loops: tuple[LoopClosure, ...]
    frame_ms: Mapping[int, float]
    warnings: Sequence[RunWarning] = ()
    places: Mapping[int, AnyPlace] = field(default_factory=dict)
    gyroscope: GyroscopeCalibration | None = None

    @property
    def placed(self) -> list[FrameResult]:
        """The results of the frames that were not lost."""
        return [track for track in self.tracks if track.node is not None]

    @property
    def tracked(self) -> list[FrameResult]:
        """The results of the frames that were placed without a doubt."""
        return [track for track in self.placed if not track.doubts]

    def trajectory(self) -> Trajectory:
        """Return T_world_body = T_world_node · T_node_body of every frame that was not lost."""
        return self._poses(self.placed)

    def tracked_trajectory(self) -> Trajectory:
        """Return the same of the frames that were placed without a doubt."""
        return self._poses(self.tracked)

    def _poses(self, tracks: Sequence[FrameResult]) -> Trajectory:
        return trajectory_from(
            (track.stamp_ns, self.graph.T_world_node[track.node] @ track.T_node_body)
            for track in tracks
            if track.node is not None
        )


def refuse_a_fragment(
    tracking: TrackingResult, config: BuildConfig, *, sensor: Sensor, known: Sequence[RunWarning] = ()
) -> None:
    """Refuse to make a map from too little.

    Args:
        tracking: Result of the first pass.
        config: Settings, which say how much is enough.
        sensor: Sensor of the log.
        known: Warnings about the log, which are likelier causes than any usual one.

    Raises:
        TrackingError: Fewer frames were tracked, without a doubt, than the configuration requires.
    """
    read, tracked = len(tracking.tracks), len(tracking.tracked)
    enough = max(config.min_tracked_frames, math.ceil(round(config.min_tracked_ratio * read, 6)))
    if tracked >= enough:
        return
    if read == 0 and tracking.skipped:
        raise TrackingError(
            f"none of {len(tracking.skipped)} frames could be read; the first: {tracking.skipped[0].reason}"
        )
    unread = ""
    if tracking.skipped:
        unread = f"; {len(tracking.skipped)} could not be read, the first: {tracking.skipped[0].reason}"
    if tracked == read:
        raise TrackingError(f"{too_few_text(read, enough, (one.sentence for one in known))}{unread}")
    implausible = [warning.sentence for warning in known if warning.weight == "doubt"]
    hint = (
        "; ".join(implausible) or _HINTS[config.odometry.kind if config.odometry.kind in BY_POSES else sensor]
    )
    doubtful = len(tracking.placed) - tracked
    found = f"only {tracked} of {read} frames read could be tracked"
    if doubtful:
        found += f", {doubtful} more with doubts"
    unseen = [track for track in tracking.placed if track.doubts and track.diagnostics.unobservable]
    if 2 * len(unseen) > read and not implausible:
        found = f"{found} ({unseen[-1].doubts[-1].text})"
        hint = see_more(has_wheels=tracking.graph.has_wheels)
    raise TrackingError(
        f"{found}, want at least {enough}; {hint} "
        f"(min_tracked_frames and min_tracked_ratio set the limit){unread}"
    )


def save_places(writer: RunWriter, tracking: TrackingResult) -> None:
    """Write the places of the nodes that are in the graph; none, if no loops were searched."""
    nodes = [node for node in tracking.places if node in tracking.graph.T_world_node]
    if nodes:
        write_places(writer.folder / files.PLACES, tracking.places, nodes)


def from_tracking(tracking: TrackingResult, source: Log) -> StoredTracking:
    """Return the result of a log as a run stores it: doubtful frames are placed by their neighbours."""
    records = records_of(tracking.tracks, tracking.skipped)
    return StoredTracking(
        records=records,
        skipped=tracking.skipped,
        frame_ms=tracking.frame_ms,
        trajectory=placed_by_neighbours(tracking.trajectory(), tracking.graph, records),
        graph=tracking.graph,
        loops=tracking.loops,
        truth=source.truth,
        T_body_base=source.T_body_base,
    )
