"""Parts of Foxglove's messages: timestamps, poses and lines, and lines as dots."""

import numpy as np
from foxglove import messages

from mapper.core.geometry import Points, Transform
from mapper.core.rotations import quaternion_from_rotation
from mapper.core.timebase import NS_PER_S, check_stamp
from mapper.export.palette import Rgb

_DOT_SPACING_M = 0.01
_MAX_DOTS = 100_000
_LINE_WIDTH_PX = 2.0
WORLD = "world"


def sample_segments(starts: Points, ends: Points) -> Points:
    """Return points along (S, 3) segments, ends included: 1 cm apart, or further where that is too many."""
    lengths_m = np.linalg.norm(ends - starts, axis=1)
    spacing_m = max(_DOT_SPACING_M, float(lengths_m.sum()) / _MAX_DOTS)
    counts = np.ceil(lengths_m / spacing_m).astype(np.intp) + 1
    segment = np.repeat(np.arange(len(starts)), counts)
    step = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (step / np.maximum(counts[segment] - 1, 1))[:, None]
    points: Points = starts[segment] * (1.0 - share) + ends[segment] * share
    return points


def timestamp_of(stamp_ns: int) -> messages.Timestamp:
    """Return a stamp in nanoseconds as Foxglove's timestamp.

    Raises:
        DataError: It is before 1970 or after 2038.
    """
    check_stamp(stamp_ns)
    return messages.Timestamp(int(stamp_ns // NS_PER_S), int(stamp_ns % NS_PER_S))


def vector_of(T: Transform) -> messages.Vector3:
    """Return the translation of a (4, 4) pose as Foxglove's vector."""
    x, y, z = T[:3, 3].tolist()
    return messages.Vector3(x=x, y=y, z=z)


def quaternion_of(T: Transform) -> messages.Quaternion:
    """Return the rotation of a (4, 4) pose as Foxglove's quaternion."""
    x, y, z, w = (float(value) for value in quaternion_from_rotation(T[:3, :3]))
    return messages.Quaternion(x=x, y=y, z=z, w=w)


def pose_of(T: Transform) -> messages.Pose:
    """Return a (4, 4) pose as Foxglove's."""
    return messages.Pose(position=vector_of(T), orientation=quaternion_of(T))


def lines_of(points: Points, color: Rgb, *, stamp_ns: int, name: str) -> messages.SceneEntity:
    """Return an entity of separate lines: points 2k and 2k + 1 are the ends of line k."""
    red, green, blue = (channel / 255.0 for channel in color)
    line = messages.LinePrimitive(
        type=messages.LinePrimitiveLineType.LineList,
        pose=pose_of(np.eye(4)),
        thickness=_LINE_WIDTH_PX,
        scale_invariant=True,
        points=[messages.Point3(x=x, y=y, z=z) for x, y, z in points.tolist()],
        color=messages.Color(r=red, g=green, b=blue, a=1.0),
    )
    return messages.SceneEntity(timestamp=timestamp_of(stamp_ns), frame_id=WORLD, id=name, lines=[line])
