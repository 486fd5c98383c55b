"""Small logs of stereo cameras, lasers and scanners, and of LiDARs' packets, for the corpus."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from tests.support.driver_recordings import street, write_pcap, write_vlp16
from tests.support.e57_files import fields as e57_fields
from tests.support.e57_files import write as write_e57
from tests.support.las_files import write_las
from tests.support.ouster_osf import metadata, scan_message, write_osf
from tests.support.ouster_packets import (
    SCAN_NS,
    Ouster,
    drawn,
    imu_packet,
    simulated,
    write_capture,
    write_recording,
)
from tests.support.planar_drives import Drive, Laser, drive, hall, write_carmen, write_ros
from tests.support.recordings import write
from tests.support.stereo_rig import (
    BARREL,
    FISHEYE,
    RECTIFIED,
    projections,
    recorded,
    write_euroc,
    write_imu,
    write_kitti,
    write_kitti_drive,
    write_kitti_navigation,
)


def _velodyne(folder: Path) -> Path:
    return write_vlp16(folder / "log.bag", street(azimuth_steps=90, duration_s=0.3), scans=2)[0]


def _pcap(folder: Path) -> Path:
    return write_pcap(folder / "log.pcap", street(azimuth_steps=90, duration_s=0.3), packets=200)


def _ouster(folder: Path, *, is_captured: bool) -> Path:
    log = street(azimuth_steps=64, duration_s=0.4).log()
    sensor, lidar, imu = simulated(log, rings_deg=np.linspace(-15.0, 15.0, 16).tolist(), columns=64)
    imu = [(lidar[0][0] + i, imu_packet(lidar[0][0] + i, np.ones(3), np.ones(3))) for i in range(3)]
    if is_captured:
        return write_capture(folder / "log.pcap", lidar, imu, metadata=sensor.metadata())
    return write_recording(folder / "log.bag", lidar, imu, metadata=sensor.metadata(flat=True))


def _osf(folder: Path) -> Path:
    sensor, stamps_ns = Ouster(), [k * SCAN_NS for k in range(1, 5)]
    readings = np.array(stamps_ns), np.ones((4, 3)), np.ones((4, 3))
    scans = [
        (
            ns,
            scan_message(
                sensor, drawn(sensor, k), stamp_ns=ns, imu=readings, encoding=("png", "zpng")[k % 2]
            ),
        )
        for k, ns in enumerate(stamps_ns)
    ]
    return write_osf(folder / "log.osf", [scans], [metadata(sensor)], per_chunk=1)


def _stereo(folder: Path) -> Path:
    topics = "/stereo/left/image_rect", "/stereo/right/image_rect"
    return write(folder / "log", recorded(RECTIFIED, topics, projections=projections(0.12)))


def _euroc(folder: Path) -> Path:
    write_imu(write_euroc(folder / "log", BARREL), 50)
    return folder / "log"


def _kitti_drive(folder: Path) -> Path:
    write_kitti_navigation(write_kitti_drive(folder / "log", BARREL, is_rectified=False))
    return folder / "log"


def _e57(folder: Path) -> Path:
    return write_e57(folder / "log.e57", *(e57_fields(seed)[1] for seed in range(3)))


def _las(folder: Path) -> Path:
    return write_las(folder / "log.laz", street(azimuth_steps=30, duration_s=2.5).log())


def _laser() -> Drive:
    walls, way = hall()
    return drive((walls, np.array([way[0], 0.9 * way[0] + 0.1 * way[1]])), Laser(beams=61))


SENSOR_LOGS: Mapping[str, Callable[[Path], Path]] = {
    "bag, velodyne": _velodyne,
    "pcap": _pcap,
    "pcap, ouster": lambda folder: _ouster(folder, is_captured=True),
    "bag, ouster": lambda folder: _ouster(folder, is_captured=False),
    "osf": _osf,
    "rosbag2, stereo": _stereo,
    "euroc": _euroc,
    "euroc, kalibr": lambda folder: write_euroc(folder / "log", FISHEYE, kalibr=True),
    "kitti, stereo": lambda folder: write_kitti(folder / "log"),
    "kitti, stereo drive": _kitti_drive,
    "e57": _e57,
    "las": _las,
    "bag, laser": lambda folder: write_ros(folder / "log.bag", _laser()),
    "carmen": lambda folder: write_carmen(folder / "log.log", _laser()),
    "carmen, later": lambda folder: write_carmen(folder / "log.clf", _laser(), message="ROBOTLASER1"),
}
"""Makers of these inputs."""
