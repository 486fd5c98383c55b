"""MCAP files that Foxglove and Rerun both show: a run's results, a comparison's, a registration's.

What each viewer makes of the topics (Foxglove's documentation; Rerun 0.41's importer, which the tests run):

=====================  ============================  ==================  ===========================
topic                  schema                        Foxglove            Rerun
=====================  ============================  ==================  ===========================
/tf                    foxglove.FrameTransform       transform tree      Transform3D
/tf_static             foxglove.FrameTransforms      transform tree      Transform3D
/pose                  geometry_msgs/msg/            pose with an        a bare record
                       PoseWithCovarianceStamped     ellipsoid
/camera/image          foxglove.CompressedImage      image               EncodedImage
/camera/calibration    foxglove.CameraCalibration    projection          Pinhole
/trajectory/NAME       foxglove.PosesInFrame         line or axes        InstancePoses3D
/trajectory/NAME/dots  foxglove.PointCloud           points              Points3D
/graph/factors         foxglove.SceneUpdate          lines               a bare record: no lines yet
/graph/factors/dots    foxglove.PointCloud           points              Points3D
/map/NAME              foxglove.PointCloud           points              Points3D
/map/slice             nav_msgs/msg/OccupancyGrid    map                 GridMap
/map/traversable       nav_msgs/msg/OccupancyGrid    map                 GridMap
/plan                  foxglove.PosesInFrame         line                InstancePoses3D
/plan/dots             foxglove.PointCloud           points              Points3D
/diagnostics           mapper/msg/Diagnostics        plots, raw values   plots, raw values
/loops                 mapper/msg/Loop               plots, raw values   plots, raw values
/errors/NAME           mapper/msg/PathError          plots, raw values   plots, raw values
/trials/NAME           mapper/msg/Trial              raw values          plots, raw values
/registration          mapper/msg/Registration       raw values          plots, raw values
=====================  ============================  ==================  ===========================

``mapper export RUN --as foxglove-layout`` arranges them in Foxglove.

So lines are logged as dots too, the slice is a ROS message (Rerun ignores foxglove.Grid) and so are the
diagnostics (Rerun keeps JSON as opaque bytes).

Every message's ``log_time`` and ``publish_time`` is the stamp of the data. Results of the whole log belong
at the first stamp: both viewers show the latest message at or before the playhead, and the transforms too are
those of the solved graph.

The ``mcap`` package writes the file, because the writer inside foxglove-sdk reports a full disk only when the
file is closed; foxglove-sdk encodes the messages.
"""

import struct
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from foxglove import messages
from foxglove.messages import PackedElementFieldNumericType as NumericType
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from zstandard import ZstdError

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Array, Points, Transform
from mapper.core.timebase import check_stamp
from mapper.core.trajectory import Trajectory
from mapper.export.figures import ESTIMATE, FACTORS, PLAN, Rgb
from mapper.export.mcap_messages import (
    MAP,
    OCCUPANCY_GRID,
    UNCERTAIN_POSE,
    Value,
    encode_occupancy_grid,
    encode_record,
    encode_uncertain_pose,
    lines_of,
    pose_of,
    record_definition,
    sample_segments,
    timestamp_of,
    transform_of,
)
from mapper.graph.model import BetweenFactor
from mapper.octree.grid import OccupancyGrid
from mapper.runtime.atomic import atomic_file
from mapper.sources.ros.typestore import definition

_PLAN, _DOTS = "/plan", "/dots"
PLAN_TOPICS = (_PLAN, _PLAN + _DOTS)

_LIBRARY = "mapper"
_POINT = np.dtype([("position", "<f4", 3), ("rgba", "u1", 4)])


class McapLog:
    """Writer of one MCAP file, a context manager: the file appears when the block ends without an error.

    Messages may come in any order of stamps: the file is chunked and indexed. The same calls give the
    same bytes.
    """

    def __init__(self, path: Path) -> None:
        """Prepare to write ``path``; no file is made until the block is entered."""
        self._opened = self._open(path)
        self._writer: Writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._record_fields: dict[str, str] = {}

    def __enter__(self) -> Self:
        self._opened.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._opened.__exit__(kind, error, trace)

    @contextmanager
    def _open(self, path: Path) -> Iterator[None]:
        with atomic_file(path) as part, part.open("wb") as file:
            self._writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
            self._writer.start(profile="", library=_LIBRARY)
            yield
            self._writer.finish()

    def transform(self, stamp_ns: int, T_parent_child: Transform, *, parent: str, child: str) -> None:
        """Log the pose of a frame in its parent on /tf."""
        self._publish("/tf", transform_of(stamp_ns, T_parent_child, parent=parent, child=child), stamp_ns)

    def static_transforms(self, stamp_ns: int, links: Iterable[tuple[str, str, Transform]]) -> None:
        """Log (parent, child, T_parent_child) that hold from a stamp on, on /tf_static.

        They are one message, since a viewer that jumps to a time reads the last message of a topic.
        """
        told = [transform_of(stamp_ns, T, parent=parent, child=child) for parent, child, T in links]
        if told:
            self._publish("/tf_static", messages.FrameTransforms(transforms=told), stamp_ns)

    def image(self, stamp_ns: int, jpeg: bytes, *, frame: str) -> None:
        """Log a JPEG on /camera/image, as :func:`mapper.mapping.thumbnails.encode_jpeg` makes it."""
        self._publish(
            "/camera/image",
            messages.CompressedImage(
                timestamp=timestamp_of(stamp_ns), frame_id=frame, data=jpeg, format="jpeg"
            ),
            stamp_ns,
        )

    def calibration(self, stamp_ns: int, camera: PinholeCamera, *, frame: str) -> None:
        """Log the camera of the images on /camera/calibration: of a shrunk image the shrunk camera."""
        K = camera.matrix
        self._publish(
            "/camera/calibration",
            messages.CameraCalibration(
                timestamp=timestamp_of(stamp_ns),
                frame_id=frame,
                width=camera.width_px,
                height=camera.height_px,
                distortion_model="plumb_bob",
                D=list(camera.distortion),
                K=K.ravel().tolist(),
                R=np.eye(3).ravel().tolist(),
                P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
            ),
            stamp_ns,
        )

    def trajectory(self, stamp_ns: int, trajectory: Trajectory, *, name: str, color: Rgb = ESTIMATE) -> None:
        """Log a whole trajectory on /trajectory/NAME, and its path as dots below that."""
        self._path(f"/trajectory/{name}", stamp_ns, trajectory.T_world_body, color)

    def factors(
        self,
        stamp_ns: int,
        factors: Iterable[BetweenFactor],
        *,
        T_world_node: Mapping[int, Transform],
    ) -> None:
        """Log the graph's factors as lines between their nodes, coloured by origin.

        Args:
            stamp_ns: The messages' time.
            factors: The measurements.
            T_world_node: Pose of every node that they name, e.g. as solved.
        """
        entities = []
        clouds, colors = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
        factors = list(factors)
        for origin, color in FACTORS.items():
            pairs = [(factor.i, factor.j) for factor in factors if factor.origin == origin]
            if not pairs:
                continue
            ends = np.array([[T_world_node[node][:3, 3] for node in pair] for pair in pairs])
            entities.append(lines_of(ends.reshape(-1, 3), color, stamp_ns=stamp_ns, name=origin))
            points = sample_segments(ends[:, 0], ends[:, 1])
            clouds.append(points)
            colors.append(np.broadcast_to(np.array(color, np.uint8), points.shape))
        self._publish("/graph/factors", messages.SceneUpdate(entities=entities), stamp_ns)
        self._points(f"/graph/factors{_DOTS}", stamp_ns, np.concatenate(clouds), np.concatenate(colors))

    def cloud(
        self, stamp_ns: int, points_world: NDArray[np.floating], *, colors: NDArray[np.uint8], name: str
    ) -> None:
        """Log (N, 3) points in metres with (N, 3) RGB bytes on /map/NAME, in the map's frame."""
        if points_world.ndim != 2 or points_world.shape[1] != 3 or colors.shape != points_world.shape:
            raise DataError(
                f"/map/{name}: points {points_world.shape} and colors {colors.shape}, want two of (N, 3)"
            )
        self._points(f"/map/{name}", stamp_ns, points_world, colors)

    def scan(
        self, stamp_ns: int, points: NDArray[np.floating], *, colors: NDArray[np.uint8], frame: str
    ) -> None:
        """Log (N, 3) points in metres with (N, 3) RGB bytes on /scan, in a frame that moves."""
        self._points("/scan", stamp_ns, points, colors, frame=frame)

    def plan(self, stamp_ns: int, waypoints_world: Points, *, frame: str = MAP) -> None:
        """Log a planned path through (N, 3) points on /plan, and as dots below that.

        The poses have no rotation: a path has positions only.

        Args:
            stamp_ns: The messages' time.
            waypoints_world: The points, metres.
            frame: Name of the levelled world in the file.
        """
        T_world_waypoint = np.tile(np.eye(4), (len(waypoints_world), 1, 1))
        T_world_waypoint[:, :3, 3] = waypoints_world
        self._path(_PLAN, stamp_ns, T_world_waypoint, PLAN, frame=frame)

    def _path(self, topic: str, stamp_ns: int, T_world_path: Array, color: Rgb, *, frame: str = MAP) -> None:
        """Log (N, 4, 4) poses on a topic, and the lines between them as dots below that."""
        poses = [pose_of(T) for T in T_world_path]
        message = messages.PosesInFrame(timestamp=timestamp_of(stamp_ns), frame_id=frame, poses=poses)
        self._publish(topic, message, stamp_ns)
        points = sample_segments(T_world_path[:-1, :3, 3], T_world_path[1:, :3, 3])
        self._points(f"{topic}{_DOTS}", stamp_ns, points, np.array(color, np.uint8), frame=frame)

    def copy(self, path: Path, *, without: Container[str]) -> None:
        """Log every message of another MCAP file, in its order, except those on some topics.

        Raises:
            DataError: The file is no MCAP log, or is damaged.
        """
        channels: dict[int, int] = {}
        try:
            with path.open("rb") as file:
                for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(
                    log_time_order=False
                ):
                    if channel.topic in without:
                        continue
                    if channel.id not in channels:
                        channels[channel.id] = self._copy_channel(schema, channel)
                    self._writer.add_message(
                        channels[channel.id],
                        log_time=message.log_time,
                        data=message.data,
                        publish_time=message.publish_time,
                        sequence=message.sequence,
                    )
        except (OSError, McapError, ValueError, struct.error, ZstdError) as error:
            raise DataError(
                f"{path}: cannot be read as MCAP: {error}; make it again with mapper fuse"
            ) from None

    def _copy_channel(self, schema: Schema | None, channel: Channel) -> int:
        schema_id = 0
        if schema is not None:
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            schema_id = self._schemas[schema.name]
        return int(
            self._writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, dict(channel.metadata)
            )
        )

    def grid(self, stamp_ns: int, grid: OccupancyGrid, *, name: str = "slice") -> None:
        """Log a 2D grid on /map/NAME, in the world's z = 0 plane."""
        check_stamp(stamp_ns)
        data = encode_occupancy_grid(grid, stamp_ns=stamp_ns, frame_id=MAP)
        self._publish_ros(f"/map/{name}", OCCUPANCY_GRID, data, stamp_ns)

    def pose(self, stamp_ns: int, T_world_body: Transform, covariance: Array) -> None:
        """Log a pose with its (6, 6) covariance in the body's tangent (rotation, translation) on /pose."""
        check_stamp(stamp_ns)
        data = encode_uncertain_pose(T_world_body, covariance, stamp_ns=stamp_ns, frame_id=MAP)
        self._publish_ros("/pose", UNCERTAIN_POSE, data, stamp_ns)

    def diagnostics(self, stamp_ns: int, record: Mapping[str, Value]) -> None:
        """Log one frame's numbers and words on /diagnostics."""
        self.record("/diagnostics", "mapper/msg/Diagnostics", stamp_ns, record)

    def loop(self, stamp_ns: int, record: Mapping[str, Value]) -> None:
        """Log one loop candidate and its verdict on /loops."""
        self.record("/loops", "mapper/msg/Loop", stamp_ns, record)

    def record(self, topic: str, schema: str, stamp_ns: int, record: Mapping[str, Value]) -> None:
        """Log numbers and words.

        Args:
            topic: E.g. "/loops".
            schema: Name of the records' message type.
            stamp_ns: Time of the record.
            record: Name to int, float or str; the same names and types every time.

        Raises:
            DataError: A value of another type, or other fields than those of the first record.
        """
        check_stamp(stamp_ns)
        fields = record_definition(record)
        if topic not in self._channels:
            self._record_fields[topic] = fields
            self._register(topic, schema, encoding="ros2msg", text=fields.encode())
        if fields != self._record_fields[topic]:
            raise DataError(
                f"{topic} at {stamp_ns}: fields {fields.split()}, "
                f"want those of the first record: {self._record_fields[topic].split()}"
            )
        self._write(topic, encode_record(record, type_=schema, definition=fields), stamp_ns)

    def _points(
        self,
        topic: str,
        stamp_ns: int,
        points: NDArray[np.floating],
        colors: NDArray[np.uint8],
        *,
        frame: str = MAP,
    ) -> None:
        packed = np.empty(len(points), _POINT)
        packed["position"] = points
        packed["rgba"][:, :3] = colors
        packed["rgba"][:, 3] = 255
        layout = [("x", 0, NumericType.Float32), ("y", 4, NumericType.Float32), ("z", 8, NumericType.Float32)]
        layout += [
            (name, 12 + i, NumericType.Uint8) for i, name in enumerate(("red", "green", "blue", "alpha"))
        ]
        self._publish(
            topic,
            messages.PointCloud(
                timestamp=timestamp_of(stamp_ns),
                frame_id=frame,
                pose=pose_of(np.eye(4)),
                point_stride=_POINT.itemsize,
                fields=[
                    messages.PackedElementField(name=name, offset=offset, type=kind)
                    for name, offset, kind in layout
                ],
                data=packed.tobytes(),
            ),
            stamp_ns,
        )

    def _publish(self, topic: str, message: Any, stamp_ns: int) -> None:
        if topic not in self._channels:
            schema = message.get_schema()
            self._register(topic, schema.name, encoding=schema.encoding, text=schema.data)
        self._write(topic, message.encode(), stamp_ns)

    def _publish_ros(self, topic: str, type_: str, data: bytes, stamp_ns: int) -> None:
        if topic not in self._channels:
            self._register(topic, type_, encoding="ros2msg", text=definition(type_).encode())
        self._write(topic, data, stamp_ns)

    def _register(self, topic: str, schema: str, *, encoding: str, text: bytes) -> None:
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema, encoding, text)
        message_encoding = "cdr" if encoding == "ros2msg" else encoding
        self._channels[topic] = self._writer.register_channel(topic, message_encoding, self._schemas[schema])

    def _write(self, topic: str, data: bytes, stamp_ns: int) -> None:
        self._writer.add_message(self._channels[topic], log_time=stamp_ns, data=data, publish_time=stamp_ns)
