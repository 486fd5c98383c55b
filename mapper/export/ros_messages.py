"""The ROS 2 messages that viewers know and foxglove has no twin of, encoded as CDR without ROS.

CDR is OMG's Common Data Representation (DDS-RTPS 2.2, §10): little-endian here, and every number is
aligned to its own size counted from the end of the four-byte header.
"""

import struct
from collections.abc import Mapping

from mapper.core.errors import DataError
from mapper.core.timebase import NS_PER_S
from mapper.octree.slice import OccupancyGrid

Value = int | float | str

_SEPARATOR = 80 * "="
_HEADER_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_NAMES: dict[type, str] = {int: "int64", float: "float64", str: "string"}

OCCUPANCY_GRID_NAME = "nav_msgs/msg/OccupancyGrid"
OCCUPANCY_GRID_SCHEMA = f"""std_msgs/Header header
nav_msgs/MapMetaData info
int8[] data
{_SEPARATOR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
{_SEPARATOR}
MSG: nav_msgs/MapMetaData
builtin_interfaces/Time map_load_time
float32 resolution
uint32 width
uint32 height
geometry_msgs/Pose origin
{_SEPARATOR}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_SEPARATOR}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{_SEPARATOR}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


class _Cdr:
    """Bytes that grow by aligned values."""

    def __init__(self) -> None:
        self._body = bytearray()

    def put(self, code: str, value: float) -> None:
        """Append one number of a struct format character."""
        size = struct.calcsize(code)
        self._body += bytes(-len(self._body) % size)
        self._body += struct.pack("<" + code, value)

    def put_sequence(self, data: bytes) -> None:
        """Append a byte sequence behind its length."""
        self.put("I", len(data))
        self._body += data

    def put_text(self, text: str) -> None:
        """Append a string; CDR counts and stores its final zero."""
        self.put_sequence(text.encode("utf-8") + b"\x00")

    def put_time(self, stamp_ns: int) -> None:
        """Append a builtin_interfaces/Time."""
        self.put("i", stamp_ns // NS_PER_S)
        self.put("I", stamp_ns % NS_PER_S)

    def message(self) -> bytes:
        """Return header and body."""
        return _HEADER_LITTLE_ENDIAN + bytes(self._body)


def encode_occupancy_grid(grid: OccupancyGrid, *, stamp_ns: int, frame_id: str) -> bytes:
    """Return a nav_msgs/msg/OccupancyGrid; its cell codes are the grid's own."""
    cdr = _Cdr()
    cdr.put_time(stamp_ns)
    cdr.put_text(frame_id)
    cdr.put_time(stamp_ns)
    cdr.put("f", grid.resolution_m)
    height, width = grid.cells.shape
    cdr.put("I", width)
    cdr.put("I", height)
    for value in (*grid.origin_world_m, 0.0, 0.0, 0.0, 0.0, 1.0):
        cdr.put("d", float(value))
    cdr.put_sequence(grid.cells.tobytes())
    return cdr.message()


def record_schema(record: Mapping[str, Value]) -> str:
    """Return the ros2msg text of a flat record: int64, float64 and string fields in the record's order.

    Raises:
        DataError: A value of another type; NumPy's scalars must be converted first.
    """
    for name, value in record.items():
        if type(value) not in _NAMES:
            raise DataError(f"record: {name} is a {type(value).__name__}; want an int, a float or a str")
    return "".join(f"{_NAMES[type(value)]} {name}\n" for name, value in record.items())


def encode_record(record: Mapping[str, Value]) -> bytes:
    """Return a flat record as CDR, laid out as :func:`record_schema` says."""
    cdr = _Cdr()
    for value in record.values():
        if isinstance(value, str):
            cdr.put_text(value)
        else:
            cdr.put("q" if isinstance(value, int) else "d", value)
    return cdr.message()
