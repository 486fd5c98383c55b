"""ROS message types (rosbags' typestores), and ROS 2 messages made and serialised as CDR with them."""

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapper.core.geometry import Transform
from mapper.core.rotations import quaternion_from_rotation
from mapper.core.timebase import NS_PER_S

_GPS_STATUS = """\
std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
_GPS_NUMBERS = (
    *("latitude", "longitude", "altitude", "track", "speed", "climb", "pitch", "roll", "dip", "time"),
    *("gdop", "pdop", "hdop", "vdop", "tdop", "err", "err_horz", "err_vert", "err_track", "err_speed"),
    *("err_climb", "err_time", "err_pitch", "err_roll", "err_dip"),
)
_GPS_FIX = "\n".join(
    [
        "std_msgs/Header header",
        "GPSStatus status",
        *(f"float64 {name}" for name in _GPS_NUMBERS),
        "float64[9] position_covariance",
        "uint8 COVARIANCE_TYPE_UNKNOWN=0",
        "uint8 position_covariance_type",
    ]
)
_OCTOMAP = """\
std_msgs/Header header
bool binary
string id
float64 resolution
int8[] data
"""


@cache
def typestore(encoding: str) -> Any:
    """Return the standard messages: Noetic's for "ros1", else Humble's and OctoMap's.

    Those that a map is made from have not changed in later releases.
    """
    if encoding != "ros1":
        store = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(_OCTOMAP, "octomap_msgs/msg/Octomap"))
        _add_receivers(store)
        return store
    store = get_typestore(Stores.ROS1_NOETIC)
    _add_receivers(store)
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):  # rosbags leaves them out of Noetic's
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store


def _add_receivers(store: Any) -> None:
    """Add the messages of GNSS receivers' drivers (gps_umd, nmea_navsat_driver)."""
    for package in ("gps_common", "gps_msgs"):
        store.register(get_types_from_msg(_GPS_STATUS, f"{package}/msg/GPSStatus"))
        store.register(get_types_from_msg(_GPS_FIX, f"{package}/msg/GPSFix"))
    store.register(get_types_from_msg("std_msgs/Header header\nstring sentence\n", "nmea_msgs/msg/Sentence"))


@cache
def custom_typestore(type_: str, definition: str) -> Any:
    """Return a store of one message type that ROS does not have.

    Args:
        type_: Its name, e.g. "mapper/msg/Loop".
        definition: Its fields in ROS' own notation, a line each.
    """
    store = get_typestore(Stores.EMPTY)  # a store takes one definition of a name, and logs differ
    store.register(get_types_from_msg(definition, type_))
    return store


def definition(type_: str) -> str:
    """Return the text that defines a ROS 2 message type and all that it is made of."""
    text, _ = typestore("cdr").generate_msgdef(type_, ros_version=2)
    return str(text)


def make_message(type_: str, **fields: Any) -> Any:
    """Return a ROS 2 message; every field must be given."""
    return typestore("cdr").types[type_](**fields)


def make_time(stamp_ns: int) -> Any:
    """Return a builtin_interfaces/msg/Time."""
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    return make_message("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def make_header(stamp_ns: int, frame: str) -> Any:
    """Return a std_msgs/msg/Header."""
    return make_message("std_msgs/msg/Header", stamp=make_time(stamp_ns), frame_id=frame)


def make_pose(T: Transform) -> Any:
    """Return a geometry_msgs/msg/Pose of a (4, 4) pose."""
    x, y, z = T[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_rotation(T[:3, :3]).tolist()
    return make_message(
        "geometry_msgs/msg/Pose",
        position=make_message("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=make_message("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def serialize(message: Any) -> bytes:
    """Return a ROS 2 message as CDR, little-endian."""
    return bytes(typestore("cdr").serialize_cdr(message, message.__msgtype__, little_endian=True))
