"""Messages of MCAP files: Foxglove's of poses and lines, and ROS 2's of grids, poses and flat records as CDR.

ROS's are those of which Foxglove's own schemas have no twin that both viewers draw; see
:mod:`mapper.export.mcap_log`.
"""

from collections.abc import Mapping

import numpy as np
from foxglove import messages

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points, Transform
from mapper.core.rotations import quaternion_from_rotation
from mapper.core.timebase import NS_PER_S, check_stamp
from mapper.export.figures import Rgb
from mapper.octree.grid import OccupancyGrid
from mapper.sources.ros.typestore import (
    custom_typestore,
    make_header,
    make_message,
    make_pose,
    make_time,
    serialize,
)

_DOT_SPACING_M = 0.01
_MAX_DOTS = 100_000
_LINE_WIDTH_PX = 2.0
MAP = "map"
"""Name of the levelled world (REP 105)."""


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


def transform_of(
    stamp_ns: int, T_parent_child: Transform, *, parent: str, child: str
) -> messages.FrameTransform:
    """Return the (4, 4) pose of a frame in its parent as Foxglove's transform."""
    return messages.FrameTransform(
        timestamp=timestamp_of(stamp_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=vector_of(T_parent_child),
        rotation=quaternion_of(T_parent_child),
    )


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
    return messages.SceneEntity(timestamp=timestamp_of(stamp_ns), frame_id=MAP, id=name, lines=[line])


Value = int | float | str

OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
UNCERTAIN_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"

_FIELD_TYPES: dict[type, str] = {int: "int64", float: "float64", str: "string"}


def encode_occupancy_grid(grid: OccupancyGrid, *, stamp_ns: int, frame_id: str) -> bytes:
    """Return a nav_msgs/msg/OccupancyGrid; its cell codes are the grid's own."""
    height, width = grid.cells.shape
    T_frame_grid = np.eye(4)
    T_frame_grid[:2, 3] = grid.origin_world_m
    info = make_message(
        "nav_msgs/msg/MapMetaData",
        map_load_time=make_time(stamp_ns),
        resolution=grid.resolution_m,
        width=width,
        height=height,
        origin=make_pose(T_frame_grid),
    )
    header = make_header(stamp_ns, frame_id)
    return serialize(make_message(OCCUPANCY_GRID, header=header, info=info, data=grid.cells.ravel()))


def encode_uncertain_pose(
    T_frame_body: Transform, covariance: Array, *, stamp_ns: int, frame_id: str
) -> bytes:
    """Return a geometry_msgs/msg/PoseWithCovarianceStamped.

    Args:
        T_frame_body: (4, 4) pose of the body.
        covariance: (6, 6) in the body's tangent (rotation, translation); ROS has (translation, rotation)
            along the frame's axes.
        stamp_ns: The message's time.
        frame_id: The frame.
    """
    to_axes = np.zeros((6, 6))
    to_axes[:3, 3:] = to_axes[3:, :3] = T_frame_body[:3, :3]
    pose = make_message(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=make_pose(T_frame_body),
        covariance=(to_axes @ covariance @ to_axes.T).ravel(),
    )
    return serialize(make_message(UNCERTAIN_POSE, header=make_header(stamp_ns, frame_id), pose=pose))


def record_definition(record: Mapping[str, Value]) -> str:
    """Return the message definition of a flat record: int64, float64 and string fields in its order.

    Raises:
        DataError: A value of another type; NumPy's scalars must be converted first.
    """
    for name, value in record.items():
        if type(value) not in _FIELD_TYPES:
            raise DataError(f"record: {name} is a {type(value).__name__}; want an int, a float or a str")
    return "".join(f"{_FIELD_TYPES[type(value)]} {name}\n" for name, value in record.items())


def encode_record(record: Mapping[str, Value], *, type_: str, definition: str) -> bytes:
    """Return a flat record as a message of the type that :func:`record_definition` defines."""
    store = custom_typestore(type_, definition)
    return bytes(store.serialize_cdr(store.types[type_](*record.values()), type_, little_endian=True))
