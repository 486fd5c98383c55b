"""An Ouster's packets and metadata, written after its documentation (https://static.ouster.dev/sensor-docs).

A scan's ranges are (returns, beams, columns) in millimetres, 0 where nothing came back.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import rotation_exp, transform
from mapper.sources.base import Log
from tests.support.driver_recordings import DriverRecording, write_captured

FIRST_NS = 1_700_000_000_000_000_000
COLUMNS_PER_PACKET = 16
PIXELS = {
    "LEGACY": [("range", "<u4"), ("reflectivity", "<u2"), ("signal", "<u2"), ("nir", "<u2"), ("none", "<u2")],
    "RNG19_RFL8_SIG16_NIR16": [
        *[("range", "<u4"), ("reflectivity", "u1"), ("none", "u1")],
        *[("signal", "<u2"), ("nir", "<u2"), ("window", "<u2")],
    ],
    "RNG19_RFL8_SIG16_NIR16_DUAL": [
        *[("range", "<u4"), ("range2", "<u4"), ("signal", "<u2"), ("signal2", "<u2")],
        *[("nir", "<u2"), ("none", "<u2")],
    ],
    "RNG15_RFL8_NIR8": [("range", "<u2"), ("reflectivity", "u1"), ("nir", "u1")],
    "FUSA_RNG15_RFL8_NIR8_DUAL": [
        *[("range", "<u2"), ("reflectivity", "u1"), ("nir", "u1")],
        *[("range2", "<u2"), ("reflectivity2", "u1"), ("none", "u1")],
    ],
}
"""Data blocks of a channel, by the profile."""
SCAN_NS = 100_000_000


@dataclass(frozen=True)
class Ouster:
    """A sensor, small enough for tests; lengths in millimetres and angles in degrees, as it states them."""

    profile: str = "RNG19_RFL8_SIG16_NIR16"
    altitudes_deg: Sequence[float] = tuple(np.linspace(15.0, -15.0, 16))
    azimuths_deg: Sequence[float] = (3.1, 1.0, -1.0, -3.1) * 4
    columns: int = 256
    serial: int = 992146000760
    beam_mm: tuple[float, float] = (27.1, -5.0)
    T_sensor_lidar_mm: np.ndarray = field(
        default_factory=lambda: transform(
            rotation_exp(np.array([0.0, 0.0, np.pi])), np.array([0.0, 0.0, 36.18])
        )
    )
    T_sensor_imu_mm: np.ndarray = field(
        default_factory=lambda: transform(
            rotation_exp(np.array([0.0, 0.0, 0.5])), np.array([6.25, -11.8, 7.6])
        )
    )

    def metadata(self, *, flat: bool = False) -> str:
        """Return the JSON of the sensor, in sections, or as older drivers wrote it."""
        beams = {
            "beam_altitude_angles": list(self.altitudes_deg),
            "beam_azimuth_angles": list(self.azimuths_deg),
            "lidar_origin_to_beam_origin_mm": self.beam_mm[0],
        }
        if self.beam_mm[1]:
            out, up = self.beam_mm
            beams["beam_to_lidar_transform"] = [1, 0, 0, out, 0, 1, 0, 0, 0, 0, 1, up, 0, 0, 0, 1]
        mode = {"lidar_mode": f"{self.columns}x10"}
        layout = {
            "columns_per_frame": self.columns,
            "columns_per_packet": COLUMNS_PER_PACKET,
            "pixels_per_column": len(self.altitudes_deg),
            "udp_profile_lidar": self.profile,
        }
        lidar = {"lidar_to_sensor_transform": self.T_sensor_lidar_mm.ravel().tolist()}
        imu = {"imu_to_sensor_transform": self.T_sensor_imu_mm.ravel().tolist()}
        facts = {"prod_sn": f"{self.serial}", "prod_line": "OS-1-16"}
        if flat:
            return json.dumps({**beams, **mode, "data_format": layout, **lidar, **imu, **facts})
        return json.dumps(
            {
                "beam_intrinsics": beams,
                "config_params": {**mode, "udp_profile_lidar": "LEGACY"},
                "imu_intrinsics": imu,
                "lidar_data_format": layout,
                "lidar_intrinsics": lidar,
                "sensor_info": facts,
            }
        )

    def packets(
        self,
        ranges_mm: np.ndarray,
        *,
        stamp_ns: int = FIRST_NS,
        turn: int = 0,
        scan_ns: int = SCAN_NS,
        invalid: Iterable[int] = (),
    ) -> list[bytes]:
        """Return the packets of a turn, whose columns are measured one after the other from a stamp on."""
        is_legacy, is_fusa = self.profile == "LEGACY", self.profile.startswith("FUSA")
        header, footer = b"", b""
        if not is_legacy:
            turn_at = 4 if is_fusa else 2
            serial_at = 11 if is_fusa else 7
            whole = bytearray(32)
            whole[0] = 1
            whole[turn_at : turn_at + 2] = turn.to_bytes(2, "little")
            whole[serial_at : serial_at + 5] = self.serial.to_bytes(5, "little")
            header, footer = bytes(whole), bytes(32)
        packets = []
        for first in range(0, self.columns, COLUMNS_PER_PACKET):
            body = b""
            for column in range(first, first + COLUMNS_PER_PACKET):
                ns = (stamp_ns + column * scan_ns // self.columns).to_bytes(8, "little")
                number = column.to_bytes(2, "little")
                valid = column not in invalid
                pixels = self._pixels(ranges_mm[:, :, column])
                if is_legacy:
                    body += ns + number + turn.to_bytes(2, "little") + bytes(4) + pixels
                    body += (b"\xff" if valid else b"\0") * 4
                else:
                    body += ns + number + bytes([int(valid), 0]) + pixels
            packets.append(header + body + footer)
        return packets

    def _pixels(self, ranges_mm: np.ndarray) -> bytes:
        """Return a column's pixels; flags and signal are not zero, and reflectivities count the beams."""
        pixels = np.full(ranges_mm.shape[1], 0, np.dtype(PIXELS[self.profile]))
        beams = np.arange(len(pixels))
        for name in pixels.dtype.names:
            if not name.startswith("range"):
                pixels[name] = beams if name.startswith("refl") else 77
        for name, values in zip(("range", "range2"), ranges_mm, strict=False):
            if "RNG15" in self.profile:
                pixels[name] = values // 8 | 1 << 15
            elif "DUAL" in self.profile:
                pixels[name] = values | 0b10101 << 19 | beams.astype(np.uint32) << 24
            else:
                pixels[name] = values | 5 << 28
        return pixels.tobytes()

    def points(self, ranges_mm: np.ndarray) -> np.ndarray:
        """Return (returns, beams, columns, 3) points in the sensor's frame, metres."""
        found = np.zeros((*ranges_mm.shape, 3))
        out, up = self.beam_mm
        for column in range(self.columns):
            turned = 2.0 * np.pi * (1.0 - column / self.columns)
            origin = rotation_exp(np.array([0.0, 0.0, turned])) @ [out, 0.0, up]
            for beam, (altitude, azimuth) in enumerate(
                np.radians(list(zip(self.altitudes_deg, self.azimuths_deg, strict=True)))
            ):
                direction = (
                    rotation_exp(np.array([0.0, 0.0, turned - azimuth]))
                    @ rotation_exp(np.array([0.0, -altitude, 0.0]))[:, 0]
                )
                beyond = ranges_mm[:, beam, column] - np.hypot(out, up)
                found[:, beam, column] = origin + beyond[:, None] * direction
        T = self.T_sensor_lidar_mm
        return (found @ T[:3, :3].T + T[:3, 3]) / 1000.0


def imu_packet(stamp_ns: int, rates_radps: np.ndarray, acceleration_mps2: np.ndarray) -> bytes:
    """Return a packet of an inertial reading: degrees a second, and g; its system time is another."""
    stamps = np.array([12345, stamp_ns + 500_000, stamp_ns], "<u8")
    numbers = np.concatenate([acceleration_mps2 / 9.80665, np.degrees(rates_radps)])
    return stamps.tobytes() + numbers.astype("<f4").tobytes()


def nmea_packet(stamps_ns: Sequence[int], rates_radps: np.ndarray, accelerations_mps2: np.ndarray) -> bytes:
    """Return a packet of several readings (ACCEL32_GYRO32_NMEA), of which the last one is not valid."""
    kind = np.dtype(
        [("ns", "<u8"), ("id", "<u2"), ("status", "<u2"), ("felt", "<f4", 3), ("turned", "<f4", 3)]
    )
    samples = np.zeros(len(stamps_ns), kind)
    samples["ns"], samples["felt"], samples["turned"] = stamps_ns, accelerations_mps2, rates_radps
    samples["status"][:-1] = 1
    return b"\2".ljust(32, b"\0") + bytes(100) + samples.tobytes() + bytes(32)


Stamped = tuple[int, bytes]
"""When a packet was received, and its bytes."""


def write_recording(
    path: Path,
    lidar: Iterable[Stamped],
    imu: Iterable[Stamped] = (),
    *,
    metadata: str | None = None,
    package: str = "ouster_sensor_msgs",
) -> Path:
    """Write packets as the driver's messages, to a bag of ROS 1 (``.bag``) or a folder of ROS 2."""
    streams = [("/ouster/lidar_packets", one) for one in lidar] + [
        ("/ouster/imu_packets", one) for one in imu
    ]
    with DriverRecording(path, package) as recording:
        if metadata is not None:
            text = recording.make("std_msgs/msg/String", data=metadata)
            recording.write(min(received_ns for _, (received_ns, _) in streams), "/ouster/metadata", text)
        for topic, (received_ns, packet) in sorted(streams, key=lambda one: one[1][0]):
            message = recording.make("PacketMsg", buf=np.frombuffer(packet, np.uint8))
            recording.write(received_ns, topic, message)
    return path


def write_capture(
    path: Path, lidar: Iterable[Stamped], imu: Iterable[Stamped] = (), *, metadata: str | None = None
) -> Path:
    """Write packets as tcpdump captures them, and the metadata beside them."""
    streams = [(ns, 7502, packet) for ns, packet in lidar] + [(ns, 7503, packet) for ns, packet in imu]
    if metadata is not None:
        path.with_suffix(".json").write_text(metadata)
    return write_captured(path, sorted(streams, key=lambda one: one[0]))


def simulated(
    log: Log, *, rings_deg: Sequence[float], columns: int
) -> tuple[Ouster, list[Stamped], list[Stamped]]:
    """Return a sensor with a simulated LiDAR's rays, and the packets of its scans and inertial readings.

    A simulated column looks half a step beyond where it begins to turn.
    """
    sensor = Ouster(
        altitudes_deg=rings_deg,
        azimuths_deg=(180.0 / columns,) * len(rings_deg),
        columns=columns,
        beam_mm=(0.0, 0.0),
        T_sensor_lidar_mm=np.diag([-1.0, -1.0, 1.0, 1.0]),
        T_sensor_imu_mm=np.eye(4),
    )
    lidar, scan_ns = [], SCAN_NS
    for turn, scan in enumerate(log):
        points = scan.points_body.astype(np.float64)
        far = np.linalg.norm(points, axis=1)
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        column = np.floor((np.pi - azimuth) / (2.0 * np.pi) * columns).astype(int) % columns
        ring = np.abs(np.degrees(np.arcsin(points[:, 2] / far))[:, None] - np.asarray(rings_deg)).argmin(
            axis=1
        )
        ranges_mm = np.zeros((1, len(rings_deg), columns), np.uint32)
        ranges_mm[0, ring, column] = np.rint(far * 1000.0)
        stamp_ns = scan.stamp_ns
        packets = sensor.packets(ranges_mm, stamp_ns=stamp_ns, turn=turn % (1 << 16), scan_ns=scan_ns)
        step_ns = scan_ns // len(packets)
        lidar += [(stamp_ns + (i + 1) * step_ns, packet) for i, packet in enumerate(packets)]
    imu = []
    if log.gyroscope is not None and log.accelerations is not None:
        felt = log.accelerations.acceleration_mps2
        for stamp_ns, rates, one in zip(
            log.gyroscope.stamps_ns.tolist(), log.gyroscope.rates_radps, felt, strict=True
        ):
            imu.append((stamp_ns, imu_packet(stamp_ns, rates, one)))
    return sensor, lidar, imu


def drawn(sensor, seed, *, holes=0.1):
    """Return ranges such as a sensor measures, with some returns missing."""
    returns = 2 if "DUAL" in sensor.profile else 1
    rng = np.random.default_rng(seed)
    ranges_mm = rng.integers(500, 120_000, (returns, len(sensor.altitudes_deg), sensor.columns)).astype(
        np.uint32
    )
    ranges_mm[rng.random(ranges_mm.shape) < holes] = 0
    return ranges_mm // 8 * 8


def check_scan(scan: Scan, sensor, ranges_mm, stamp_ns, *, invalid=()):
    """Compare points, times and reflectivities with those that were written, column by column."""
    measured = ranges_mm > 0
    measured[:, :, list(invalid)] = False
    by_column = (0, 2, 1)
    where = measured.transpose(by_column)
    points = sensor.points(ranges_mm).transpose(*by_column, 3)[where]
    times_s = np.broadcast_to(np.arange(sensor.columns)[None, :, None] * 0.1 / sensor.columns, where.shape)
    beams = np.broadcast_to(np.arange(where.shape[2]), where.shape)
    assert len(scan.points_body) == len(points)
    np.testing.assert_allclose(scan.points_body, points, atol=1e-4)
    np.testing.assert_allclose((scan.stamp_ns - stamp_ns) / 1e9 + scan.times_s, times_s[where], atol=1e-7)
    np.testing.assert_array_equal(scan.intensities, beams[where])
