"""Azure Kinect's recordings, written after https://learn.microsoft.com/azure/kinect-dk/record-file-format."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Transform

SCALE_NS = 1000
DATE_S, EPOCH_S = 1_700_000_000, 978_307_200
"""Seconds since the epoch of the recording's date, and of 2001, from which Matroska counts."""
NFOV = PinholeCamera(640, 576, 504.0, 504.0, 322.0, 331.0)
"""Depth camera of the mode NFOV_UNBINNED: columns 192 to 831 and rows 180 to 755 of 1024×1024."""


class Capture(NamedTuple):
    stamp_us: int
    rgb: np.ndarray
    depth_mm: np.ndarray


def element(number: int, *data: bytes) -> bytes:
    whole = b"".join(data)
    return number.to_bytes(-(-number.bit_length() // 8)) + (len(whole) | 1 << 56).to_bytes(8) + whole


def unsigned(number: int, value: int) -> bytes:
    return element(number, value.to_bytes(8))


def track(number: int, name: str, codec: bytes, size_px: tuple[int, int]) -> bytes:
    header = struct.pack("<IiiHH4sIiiII", 40, *size_px, 1, 16, codec, 0, 0, 0, 0, 0)
    video = element(0xE0, unsigned(0xB0, size_px[0]), unsigned(0xBA, size_px[1]))
    parts = [unsigned(0xD7, number), unsigned(0x83, 1), element(0x536E, name.encode())]
    return element(0xAE, *parts, element(0x86, b"V_MS/VFW/FOURCC"), element(0x63A2, header), video)


def block(number: int, data: bytes) -> bytes:
    return element(0xA3, bytes([0x80 | number]), struct.pack(">hB", 0, 0), data)


def camera_json(
    purpose: str,
    camera: PinholeCamera,
    sensor_px: tuple[int, int],
    whole_px: tuple[int, int],
    first_px: tuple[float, float],
    T: Transform,
) -> dict[str, object]:
    k1, k2, p1, p2, k3 = camera.distortion
    width, height = whole_px
    centre = [(camera.cx_px + first_px[0] + 0.5) / width, (camera.cy_px + first_px[1] + 0.5) / height]
    focal = [camera.fx_px / width, camera.fy_px / height]
    parameters = [*centre, *focal, k1, k2, k3, 0.0, 0.0, 0.0, 0.0, 0.0, p2, p1]
    return {
        "Purpose": f"CALIBRATION_CameraPurpose{purpose}",
        "Intrinsics": {
            "ModelParameters": parameters,
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        },
        "SensorWidth": sensor_px[0],
        "SensorHeight": sensor_px[1],
        "Rt": {"Rotation": T[:3, :3].ravel().tolist(), "Translation": T[:3, 3].tolist()},
    }


def calibration_json(colour: PinholeCamera, depth: PinholeCamera, T_color_depth: Transform) -> bytes:
    whole, side = (colour.width_px, colour.width_px * 3 // 4), (1024, 1024)
    top = (whole[1] - colour.height_px) / 2
    cameras = [
        camera_json("Depth", depth, side, side, (192, 180), np.eye(4)),
        camera_json("PhotoVideo", colour, (4096, 3072), whole, (0, top), T_color_depth),
    ]
    return json.dumps({"CalibrationInformation": {"Cameras": cameras}}).encode()


def encode(rgb: np.ndarray, codec: bytes) -> bytes:
    if codec == b"MJPG":
        return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    if codec == b"YUY2":
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_YUY2).tobytes()
    if codec != b"NV12":
        return b"\0"
    planes = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
    rows = rgb.shape[0]
    u, v = planes[rows:].reshape(2, -1)
    return planes[:rows].tobytes() + np.stack([u, v], axis=1).tobytes()


def write_azure_kinect(
    path: Path,
    captures: Sequence[Capture],
    *,
    colour: PinholeCamera,
    T_color_depth: Transform,
    depth: PinholeCamera = NFOV,
    codec: bytes = b"MJPG",
    samples: Sequence[tuple[int, Sequence[float], Sequence[float]]] = (),
    calibration: bytes | None = None,
) -> Path:
    """``samples`` are microseconds, m/s² and rad/s of the IMU."""
    data = calibration_json(colour, depth, T_color_depth) if calibration is None else calibration
    clusters = []
    for stamp_us, rgb, depth_mm in captures:
        images = [block(1, encode(rgb, codec)), block(2, depth_mm.astype(">u2").tobytes())]
        clusters.append((stamp_us, [unsigned(0xE7, stamp_us), *images]))
    for stamp_us, mps2, radps in samples:
        device_ns = 1000 * (stamp_us + 77)
        sample = struct.pack("<Q3fQ3f", device_ns, *mps2, device_ns + 2000, *radps)
        group = element(0xA0, element(0xA1, bytes([0x83]), struct.pack(">hB", 0, 0), sample))
        clusters.append((stamp_us, [unsigned(0xE7, stamp_us), group]))
    segment = [
        element(0x1549A966, unsigned(0x2AD7B1, SCALE_NS), unsigned(0x4461, (DATE_S - EPOCH_S) * 10**9)),
        element(
            0x1654AE6B,
            track(1, "COLOR", codec, (colour.width_px, colour.height_px)),
            track(2, "DEPTH", b"b16g", (depth.width_px, depth.height_px)),
            track(3, "IMU", b"", (0, 0)),
        ),
        element(
            0x1941A469,
            element(0x61A7, element(0x466E, b"calibration.json"), element(0x4660, b"application/json"),
                    element(0x465C, data), unsigned(0x46AE, 5)),
        ),
        *(element(0x1F43B675, *parts) for _, parts in sorted(clusters, key=lambda one: one[0])),
    ]  # fmt: skip
    head = element(0x1A45DFA3, element(0x4282, b"matroska"), unsigned(0x4287, 4), unsigned(0x4285, 2))
    path.write_bytes(head + element(0x18538067, *segment))
    return path
