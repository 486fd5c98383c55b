"""Ouster's recordings of scans (.osf), written after the schemas of its SDK (ouster_osf/fb/*.fbs).

https://github.com/ouster-lidar/ouster-sdk; tables as https://flatbuffers.dev/internals has them.
"""

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from zlib import crc32

import cv2
import numpy as np
import zstandard

from tests.support.ouster_packets import FIRST_NS, SCAN_NS, Ouster

Value = tuple[str, int] | str | bytes | np.ndarray | Sequence[Mapping[int, "Value"]]
"""Field of a table: an integer and its kind, a string, bytes, a vector, or a vector of tables."""


def table(fields: Mapping[int, Value]) -> tuple[bytes, int]:
    """Return a table with its vtable before it and what it refers to behind it, and where it begins.

    Everything begins at a multiple of eight bytes, as the SDK checks.
    """
    slots, inline, later = [0] * (1 + max(fields)), bytes(4), []
    for number, value in fields.items():
        kind, stored = value if isinstance(value, tuple) else ("I", 0)
        inline += bytes(-len(inline) % struct.calcsize(kind))
        slots[number] = len(inline)
        inline += struct.pack(f"<{kind}", stored)
        if not isinstance(value, tuple):
            later.append((slots[number], value))
    vtable = _padded(struct.pack(f"<HH{len(slots)}H", 4 + 2 * len(slots), len(inline), *slots))
    start = len(vtable)
    data = bytearray(_padded(vtable + struct.pack("<i", start) + inline[4:]))
    for slot, value in later:
        struct.pack_into("<I", data, start + slot, len(data) + 4 - start - slot)
        data += _padded(bytes(4) + _vector(value))
    return bytes(data), start


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 8)


def _vector(value: Value) -> bytes:
    if isinstance(value, str):
        return struct.pack("<I", len(value.encode())) + value.encode() + b"\0"
    if isinstance(value, bytes):
        return struct.pack("<I", len(value)) + value
    if isinstance(value, np.ndarray):
        return struct.pack("<I", len(value)) + value.tobytes()
    offsets, tables, space = [], b"", (len(value) + 1) // 2 * 8
    for i, one in enumerate(value):
        data, start = table(one)
        offsets.append(space - 4 * i + len(tables) + start)
        tables += data
    return struct.pack("<I", len(offsets)) + _padded(struct.pack(f"<{len(offsets)}I", *offsets)) + tables


def buffer(fields: Mapping[int, Value], identifier: bytes = b"") -> bytes:
    """Return a table as a buffer that begins with its size."""
    data, start = table(fields)
    head = _padded(bytes(8) + identifier)
    return struct.pack("<II", len(head) + len(data) - 4, len(head) - 4 + start) + head[8:] + data


def checked(data: bytes) -> bytes:
    """Return a buffer with its checksum behind it."""
    return data + struct.pack("<I", crc32(data))


def zpng(image: np.ndarray) -> bytes:
    """Encode an image of (H, W) numbers as ZPNG (https://github.com/catid/Zpng) does."""
    depth = image.itemsize
    pixels = np.ascontiguousarray(image).view(np.uint8).reshape(*image.shape, depth)
    steps = np.diff(pixels, axis=1, prepend=np.uint8(0))
    if depth == 4:
        red, green, blue, alpha = np.moveaxis(steps, 2, 0)
        steps = np.stack([blue, green - blue, green - red, alpha])
    channels, width = {1: (1, 1), 2: (1, 2), 4: (4, 1)}[depth]
    head = struct.pack("<HHHBB", 0xFBF8, image.shape[1], image.shape[0], channels, width)
    return head + zstandard.ZstdCompressor(level=1).compress(np.ascontiguousarray(steps).tobytes())


def png(image: np.ndarray) -> bytes:
    """Encode an image as PNG: 32 bits as red, green, blue and alpha, the lowest first."""
    if image.itemsize == 4:
        image = np.ascontiguousarray(image).view(np.uint8).reshape(*image.shape, 4)[:, :, [2, 1, 0, 3]]
    return cv2.imencode(".png", image)[1].tobytes()


def shifts_of(sensor: Ouster) -> list[int]:
    """Return by how many columns images of each beam are moved, some of them back."""
    return [(5, 2, -2, -5)[beam % 4] for beam in range(len(sensor.altitudes_deg))]


def metadata(sensor: Ouster, T_base_sensor: np.ndarray | None = None) -> str:
    """Return the sensor's metadata as the SDK writes them."""
    tree = json.loads(sensor.metadata())
    tree["lidar_data_format"]["pixel_shift_by_row"] = shifts_of(sensor)
    tree["ouster-sdk"] = {
        "extrinsic": (np.eye(4) if T_base_sensor is None else T_base_sensor).ravel().tolist()
    }
    return json.dumps(tree)


def scan_message(
    sensor: Ouster,
    ranges_mm: np.ndarray,
    *,
    stamp_ns: int = FIRST_NS,
    encoding: str = "zpng",
    invalid: Sequence[int] = (),
    imu: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> bytes:
    """Return a LidarScanMsg; reflectivities count the beams, readings are stamps, rates, accelerations."""
    columns = np.arange(sensor.columns)
    status = np.ones(len(columns), "<u4")
    status[list(invalid)] = 0
    reflectivities = np.broadcast_to(np.arange(ranges_mm.shape[1], dtype="u1")[:, None], ranges_mm.shape[1:])
    images = [(1 + k, 3, one.astype("<u4")) for k, one in enumerate(ranges_mm)]
    images += [(3, 2, np.full(ranges_mm.shape[1:], 77, "<u2"))]
    images += [(5 + k, 1, reflectivities) for k in range(len(ranges_mm))]
    channels = []
    for _, _, image in images:
        if encoding == "png":
            image = np.stack([np.roll(row, by) for row, by in zip(image, shifts_of(sensor), strict=True)])
        data = (
            {"zpng": zpng, "png": png}[encoding](image) if encoding in ("zpng", "png") else encoding.encode()
        )
        channels.append({0: data})
    fields: dict[int, Value] = {
        0: channels,
        1: np.array([(number, kind) for number, kind, _ in images], "u1,u1"),
        2: (stamp_ns + columns * SCAN_NS // sensor.columns).astype("<u8"),
        3: columns.astype("<u2"),
        4: status,
        5: ("i", 7),
    }
    if imu is not None:
        valid = np.ones(len(imu[0]), "<u2")
        valid[-1] = 0
        values = {
            "IMU_TIMESTAMP": (4, imu[0].astype("<u8").tobytes()),
            "IMU_STATUS": (2, valid.tobytes()),
            "IMU_GYRO": (9, zpng(imu[1].astype("<f4"))),
            "IMU_ACC": (9, zpng(imu[2].astype("<f4"))),
        }
        fields[8] = [{0: name, 1: ("B", kind), 4: data} for name, (kind, data) in values.items()]
    return buffer(fields)


def write_osf(
    path: Path,
    scans: Sequence[Sequence[tuple[int, bytes]]],
    texts: Sequence[str],
    *,
    per_chunk: int = 2,
    times_named: int = 1,
) -> Path:
    """Write the stamped scans of each sensor, with its metadata."""
    entries, chunks, listed, places, streams = [], [], [], [], []
    for k, (messages, text) in enumerate(zip(scans, texts, strict=True)):
        sensor_id, stream_id = 2 * k + 1, 2 * k + 2
        kind = "ouster/v1/os_sensor/"
        entries += [
            {0: ("I", sensor_id), 1: f"{kind}LidarSensor", 2: buffer({0: text})},
            {0: ("I", stream_id), 1: f"{kind}LidarScanStream", 2: buffer({0: ("I", sensor_id)})},
        ]
        first_ns, last_ns = messages[0][0] + SCAN_NS, messages[-1][0] + SCAN_NS
        streams.append({0: ("I", stream_id), 1: ("Q", first_ns), 2: ("Q", last_ns), 3: ("Q", len(messages))})
        for i in range(0, len(messages), per_chunk):
            stamped = [
                {0: ("Q", ns + SCAN_NS), 1: ("I", stream_id), 2: data}
                for ns, data in messages[i : i + per_chunk]
            ]
            at = sum(map(len, chunks))
            listed.append({0: ("Q", at), 1: ("I", stream_id), 2: ("I", len(stamped))})
            places.append((stamped[0][0][1], stamped[-1][0][1], at))
            chunks.append(checked(buffer({0: stamped}, b"OSF!")))
    info = {0: ("I", 99), 1: "ouster/v1/streaming/StreamingInfo", 2: buffer({0: listed, 1: streams})}
    offsets = np.array(places * times_named, "<u8,<u8,<u8")
    first_ns, last_ns = min(one[0] for one in places), max(one[1] for one in places)
    root = {0: "made", 1: ("Q", first_ns), 2: ("Q", last_ns), 3: offsets, 4: [*entries, info]}
    end = checked(buffer(root, b"OSF#"))
    header = {0: ("Q", 21), 1: ("B", 2), 2: ("Q", 0), 3: ("Q", 0)}
    size = len(checked(buffer(header, b"OSF$")))
    metadata_at = size + sum(map(len, chunks))
    header |= {2: ("Q", metadata_at), 3: ("Q", metadata_at + len(end))}
    path.write_bytes(checked(buffer(header, b"OSF$")) + b"".join(chunks) + end)
    return path
