"""A registration as a Rerun recording: the target, and the source as every stage moves it."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mapper.core.frames import Points32, Sensor
from mapper.core.geometry import Transform
from mapper.export.palette import ESTIMATE, TRUTH
from mapper.export.rerun.recording import new_recording, transform_of
from mapper.export.rerun.target import streaming

_TIMELINE = "stage"
_DOT_PX = rr.Radius.ui_points(1.5)
_UP = {"lidar": rr.ViewCoordinates.RIGHT_HAND_Z_UP, "rgbd": rr.ViewCoordinates.RDF}


def record_registration(
    target: str,
    points_target: Points32,
    points_source: Points32,
    stages: Sequence[tuple[str, Transform]],
    *,
    sensor: Sensor,
    name: str,
) -> None:
    """Send both clouds to a file or a viewer; the timeline "stage" steps from the beginning to the answer.

    Args:
        target: FILE.rrd, "spawn", "connect" or "connect:URL", as ``streaming`` takes it.
        points_target: (N, 3) metres; the recording's world is the target's frame.
        points_source: (M, 3) metres, source frame.
        stages: A line of text on each, and T_target_source after it.
        sensor: Determines which axis is up.
        name: Name of the recording in the viewer.

    Raises:
        ConfigError: The target is none.
        ViewerError: No viewer can be started or reached.
    """
    recording = new_recording()
    with streaming(recording, target, _blueprint(), keeps=lambda: False):
        recording.send_recording_name(name)
        recording.log("world", _UP[sensor], static=True)
        for entity, points, color in (
            ("world/target", points_target, TRUTH),
            ("world/source", points_source, ESTIMATE),
        ):
            cloud = rr.Points3D(points.astype(np.float32), colors=[color], radii=_DOT_PX)
            recording.log(entity, cloud, static=True)
        for number, (text, T_target_source) in enumerate(stages):
            recording.set_time(_TIMELINE, sequence=number)
            recording.log("world/source", transform_of(T_target_source))
            recording.log("stages", rr.TextLog(text))


def _blueprint() -> rrb.Blueprint:
    views = rrb.Vertical(
        rrb.Spatial3DView(name="clouds", origin="/world"),
        rrb.TextLogView(name="stages", origin="/stages"),
        row_shares=[5, 1],
    )
    return rrb.Blueprint(views, rrb.TimePanel(timeline=_TIMELINE), auto_views=False, collapse_panels=True)
