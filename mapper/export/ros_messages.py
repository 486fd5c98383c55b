"""ROS 2 messages of a run's MCAP file as CDR: occupancy grids, and flat records of numbers and words.

Foxglove's own schemas have no twin of them that both viewers draw; see :mod:`mapper.export.mcap_log`.
"""

from collections.abc import Mapping

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Transform
from mapper.octree.grid import OccupancyGrid
from mapper.sources.ros.typestore import (
    custom_typestore,
    make_header,
    make_message,
    make_pose,
    make_time,
    serialize,
)

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
