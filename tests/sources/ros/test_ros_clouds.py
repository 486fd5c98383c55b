import numpy as np
import pytest

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import Scan
from mapper.sources.ros.cloud_messages import in_true_order, scan_from, structured, usable_fields
from mapper.sources.ros.decode_ros import POINT_FIELD_TYPES, decode_ros
from mapper.sources.ros.encode_ros import cloud_message
from mapper.sources.ros.messages import CloudMessage
from mapper.sources.ros.recording import Topic

STAMP_NS = 1_700_000_000_123_456_789
TOPIC = Topic("/points", "sensor_msgs/msg/PointCloud2", "cdr")
XYZ = [("x", 0, "<f4", 1), ("y", 4, "<f4", 1), ("z", 8, "<f4", 1)]


def scan_of(message, *, T=None, colours=True):
    return scan_from(message, T_body_frame=np.eye(4) if T is None else T, with_colours=colours, where="m")


def some_points(n=50):
    return np.random.default_rng(1).uniform(-20.0, 20.0, (n, 3)).astype(np.float32)


def packed(points, fields, *, point_bytes, order="<"):
    data = np.zeros(
        len(points),
        np.dtype(
            {
                "names": [f[0] for f in fields],
                "offsets": [f[1] for f in fields],
                "formats": [order + f[2][1:] for f in fields],
                "itemsize": point_bytes,
            }
        ),
    )
    for axis, name in enumerate("xyz"):
        data[name] = points[:, axis]
    return data


def test_what_is_written_is_read_bit_by_bit():
    rng = np.random.default_rng(0)
    points = some_points()
    scan = Scan(
        STAMP_NS,
        points,
        colors=rng.integers(0, 256, (50, 3), dtype=np.uint8),
        times_s=np.linspace(0.0, 0.1, 50, dtype=np.float32),
    )
    data = memoryview(cloud_message("/points", scan, frame="lidar").cdr)
    message = decode_ros(TOPIC, data)
    again = scan_of(message)
    assert (message.stamp_ns, message.frame) == (STAMP_NS, "lidar")
    np.testing.assert_array_equal(again.points_body, points)
    np.testing.assert_array_equal(again.colors, scan.colors)
    np.testing.assert_allclose(again.times_s, scan.times_s, atol=1e-9)
    assert scan_of(message, colours=False).colors is None


def test_the_payload_is_not_copied():
    data = memoryview(cloud_message("/points", Scan(STAMP_NS, some_points()), frame="lidar").cdr)
    points = decode_ros(TOPIC, data).points
    start = np.frombuffer(data, np.uint8).ctypes.data
    assert start <= points.ctypes.data < start + len(data)


@pytest.mark.parametrize("order", ["<", ">"])
def test_fields_may_lie_anywhere_in_a_point_of_either_byte_order(order):
    points = some_points()
    fields = [("intensity", 0, "<u2", 1), ("z", 24, "<f8", 1), ("x", 4, "<f4", 1), ("y", 12, "<f8", 1)]
    data = packed(points, fields, point_bytes=40, order=order).tobytes()
    fields = [(name, offset, order + kind[1:], count) for name, offset, kind, count in fields]
    view = structured(memoryview(data), fields, point_bytes=40, shape=(1, 50))
    np.testing.assert_array_equal(scan_of(CloudMessage(STAMP_NS, "lidar", view)).points_body, points)


def test_organised_rows_may_be_padded():
    points = some_points(48)
    data = packed(points, XYZ, point_bytes=12).view(np.uint8).reshape(4, 12 * 12)
    data = np.pad(data, ((0, 0), (0, 20)), constant_values=77).tobytes()
    view = structured(memoryview(data), XYZ, point_bytes=12, shape=(4, 12), row_bytes=164)
    np.testing.assert_array_equal(scan_of(CloudMessage(STAMP_NS, "lidar", view)).points_body, points)


def test_missing_returns_are_dropped_with_their_times():
    points = some_points(8)
    points[1] = 0.0
    points[3, 2] = np.nan
    points[5, 0] = np.inf
    points[6] = [1e30, 1.0, 0.0]
    fields = [*XYZ, ("t", 12, "<u4", 1)]
    data = packed(points, fields, point_bytes=16)
    data["t"] = np.arange(8) * 10_000_000
    view = structured(memoryview(data.tobytes()), fields, point_bytes=16, shape=(1, 8))
    scan = scan_of(CloudMessage(STAMP_NS, "lidar", view))
    np.testing.assert_array_equal(scan.points_body, points[[0, 2, 4, 7]])
    np.testing.assert_allclose(scan.times_s, [0.0, 0.02, 0.04, 0.07], atol=1e-9)


def test_separate_colours_are_read():
    fields = [*XYZ, ("r", 12, "<u1", 1), ("g", 13, "<u1", 1), ("b", 14, "<u1", 1)]
    data = packed(some_points(3), fields, point_bytes=16)
    data["r"], data["g"], data["b"] = [1, 2, 3], [4, 5, 6], [7, 8, 9]
    view = structured(memoryview(data.tobytes()), fields, point_bytes=16, shape=(1, 3))
    assert scan_of(CloudMessage(STAMP_NS, "lidar", view)).colors.tolist() == [[1, 4, 7], [2, 5, 8], [3, 6, 9]]


@pytest.mark.parametrize(
    "numbers",
    [
        {"point_bytes": 12, "shape": (1, 4001)},
        {"point_bytes": 8, "shape": (1, 50)},
        {"point_bytes": 12, "shape": (1, 2**40)},
        {"point_bytes": 12, "shape": (1000, 50), "row_bytes": 0},  # these rows overlap
        {"point_bytes": 12, "shape": (40_000, 40), "row_bytes": 1},
        {"point_bytes": 12, "shape": (2, 50), "row_bytes": 599},
        {"point_bytes": 0, "shape": (2, 50), "row_bytes": 600},
    ],
)
def test_numbers_that_do_not_fit_the_payload_are_refused(numbers):
    """A message of 48 kB must not become a cloud of gigabytes."""
    with pytest.raises(DataError, match=r"a cloud of \d+×\d+ points of \d+ bytes"):
        structured(memoryview(bytes(48_000)), XYZ if numbers["point_bytes"] else [], **numbers)


@pytest.mark.parametrize(
    "field",
    [
        pytest.param(("intensity", 12, 0, 1), id="unknown type"),
        pytest.param(("t", 12, 6, 2), id="two times a point"),
        pytest.param(("x", 12, 7, 1), id="a name that is taken"),
        pytest.param(("ring", 400, 4, 1), id="beyond the point"),
    ],
)
def test_a_field_that_holds_no_number_of_each_point_is_left_out_with_a_note(field):
    points = some_points()
    payload = packed(points, XYZ, point_bytes=16).tobytes()
    stated = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), field]
    fields, notes = usable_fields(stated, POINT_FIELD_TYPES, order="<", point_bytes=16)
    view = structured(memoryview(payload), fields, point_bytes=16, shape=(1, len(points)))
    np.testing.assert_array_equal(scan_of(CloudMessage(STAMP_NS, "lidar", view)).points_body, points)
    assert len(notes) == 1
    assert field[0] in notes[0]


def test_the_step_of_a_single_row_does_not_matter():
    data = packed(some_points(), XYZ, point_bytes=12).tobytes()
    view = structured(memoryview(data), XYZ, point_bytes=12, shape=(1, 50), row_bytes=7)
    np.testing.assert_array_equal(view["x"], some_points()[:, 0])


def test_a_cloud_without_heights_is_refused():
    view = structured(memoryview(bytes(80)), XYZ[:2], point_bytes=8, shape=(1, 10))
    with pytest.raises(FrameError, match="m: points of x, y; want x, y and z"):
        scan_of(CloudMessage(STAMP_NS, "lidar", view))


ORDERS = {
    "side by side": [("x", 0, "<f4", 1), ("y", 4, "<f4", 1), ("z", 8, "<f4", 1)],
    "after another": [("x", 4, "<f4", 1), ("y", 8, "<f4", 1), ("z", 12, "<f4", 1)],
    "the other way round": [("x", 8, "<f4", 1), ("y", 4, "<f4", 1), ("z", 0, "<f4", 1)],
    "apart": [("x", 0, "<f4", 1), ("y", 8, "<f4", 1), ("z", 12, "<f4", 1)],
}


@pytest.mark.parametrize("fields", ORDERS.values(), ids=ORDERS)
@pytest.mark.parametrize("missing", [[], [0, 7, 49], range(50)])
def test_returns_are_gathered_in_order_wherever_coordinates_lie(fields, missing):
    points = some_points()
    measured = np.delete(points, list(missing), axis=0)
    for row, nothing in zip(missing, [np.nan, 0.0, np.inf, -6000.0, 1e30] * 10, strict=False):
        points[row] = nothing
    data = packed(points, fields, point_bytes=20)
    message = bytearray(data.tobytes())
    cloud = structured(memoryview(message), fields, point_bytes=20, shape=(5, 10))
    again = scan_of(CloudMessage(STAMP_NS, "lidar", cloud)).points_body
    np.testing.assert_array_equal(again, measured)
    message[:] = bytes(len(message))  # what was read is no view of it
    np.testing.assert_array_equal(again, measured)


@pytest.mark.parametrize("kind", ["f4", "f8", "i4"])
@pytest.mark.parametrize("stated", "<>")
@pytest.mark.parametrize("stored", "<>")
def test_points_are_in_the_order_of_bytes_that_makes_coordinates(kind, stated, stored):
    points = np.round(some_points() * 100.0)
    records = np.empty(len(points), [(name, f"{stored}{kind}") for name in "xyz"])
    for axis, name in enumerate("xyz"):
        records[name] = points[:, axis]
    size = np.dtype(kind).itemsize
    fields = [(name, size * axis, f"{stated}{kind}", 1) for axis, name in enumerate("xyz")]
    data = memoryview(records.tobytes())
    as_stated = structured(data, fields, point_bytes=3 * size, shape=(1, len(points)))
    found, notes = in_true_order(as_stated)
    np.testing.assert_array_equal(np.column_stack([found[name] for name in "xyz"]), points)
    assert len(notes) == (stated != stored)


def test_names_of_fields_are_read_without_what_pads_them():
    stated = [("x\0", 0, 7, 1), ("y ", 4, 7, 1), (" Z", 8, 7, 1)]
    fields, notes = usable_fields(stated, POINT_FIELD_TYPES, order="<", point_bytes=12)
    assert ([field[0] for field in fields], notes) == (["x", "y", "z"], [])
