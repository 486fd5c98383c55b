"""LiDAR simulator: a log in memory whose scans are cast when they are loaded, or written as a KITTI folder.

The lidar frame has x forward, y left, z up. A sweep begins looking back and turns clockwise seen from
above; its stamp is when it begins, so times are never negative.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array
from mapper.core.timebase import seconds_text_from_ns
from mapper.core.trajectory import Trajectory
from mapper.runtime.atomic import new_folder, write_json
from mapper.runtime.ordered_map import ordered_map
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, set_or_first
from mapper.simulation.lidar.cast import cast
from mapper.simulation.lidar.route import Drive, make_drive, scan_stamps
from mapper.simulation.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.traffic import Traffic, make_traffic
from mapper.simulation.path import seconds_of
from mapper.simulation.source import synthetic_log
from mapper.simulation.streams import Stream, noise_index, rng_of
from mapper.sources.base import Log
from mapper.sources.gnss_files import write_gnss
from mapper.sources.imu_files import write_imu
from mapper.sources.scan_folders.kitti_writing import save_scan
from mapper.sources.trajectory_files import write_kitti
from mapper.sources.wheel_files import write_wheels


def firing_times_s(sensor: LidarSensorConfig) -> Array:
    """Return (A,) seconds after the stamp at which the columns of a sweep are fired."""
    return np.linspace(0.0, sensor.sweep_s, sensor.azimuth_steps, endpoint=False)


def ray_directions(sensor: LidarSensorConfig) -> Array:
    """Return (A, E, 3) unit vectors in the lidar frame: columns in the order of firing, rings from below."""
    steps = np.arange(sensor.azimuth_steps) + 0.5
    azimuth = (np.pi - 2.0 * np.pi * steps / sensor.azimuth_steps)[:, None]
    elevation = np.linspace(sensor.lowest_ring_rad, sensor.highest_ring_rad, sensor.rings)[None, :]
    flat, up = np.cos(elevation), np.broadcast_to(np.sin(elevation), (sensor.azimuth_steps, sensor.rings))
    return np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, up], axis=2)


def measure(
    scene: OutdoorScene,
    sensor: LidarSensorConfig,
    T_world_lidar: Array,
    rng: np.random.Generator,
    *,
    traffic: Traffic | None = None,
    start_s: float = 0.0,
) -> tuple[Points32, NDArray[np.intp], NDArray[np.bool_]]:
    """Return the points of a sweep, the column of each, and whether each lies on what moves.

    Args:
        scene: The world, without what moves in it.
        sensor: The LiDAR.
        T_world_lidar: (A, 4, 4) its pose when each column is fired.
        rng: This scan's own noise.
        traffic: Moving objects; None is none.
        start_s: When the sweep begins, seconds after the log does.

    Returns:
        (N, 3) float32 metres in the lidar frame, (N,) columns, (N,) bool.
    """
    rays_lidar = ray_directions(sensor)
    rays_world = np.ascontiguousarray(rays_lidar @ T_world_lidar[:, :3, :3].transpose(0, 2, 1))
    origins_world = np.ascontiguousarray(T_world_lidar[:, :3, 3])
    ranges_m = cast(scene.world, origins_world, rays_world, sensor.max_range_m, True)
    moving = np.zeros(ranges_m.shape, np.bool_)
    if traffic is not None and len(traffic):
        fired_s = firing_times_s(sensor) if sensor.motion_distortion else np.zeros(len(origins_world))
        near_m = traffic.ranges_m(
            origins_world, rays_world, sensor.max_range_m, start_s=start_s, fired_s=fired_s
        )
        moving = near_m < ranges_m
        ranges_m = np.minimum(ranges_m, near_m)
    # Every ray has its own noise, so that what one ray meets does not change another's.
    noise_m = sensor.range_noise_m * rng.standard_normal(ranges_m.shape)
    kept = rng.random(ranges_m.shape) >= sensor.dropout_ratio
    returned = np.isfinite(ranges_m) & (ranges_m >= sensor.min_range_m) & kept
    points = rays_lidar[returned] * (ranges_m + noise_m)[returned, None]
    return points.astype(np.float32), np.nonzero(returned)[0], moving[returned]


class LidarSimulator:
    """LiDAR that moves through a street or a yard.

    Attributes:
        config: Settings of the log.
        scene: The world, without what moves in it.
        traffic: Objects that move in it.
        drive: The sensor's pose at any time.
        truth: Exact T_world_lidar where each sweep begins.
    """

    def __init__(self, config: LidarSynthConfig, scene: OutdoorScene | None = None) -> None:
        self.config = config
        self.scene = make_outdoor_scene(config) if scene is None else scene
        self.drive: Drive = make_drive(config, self.scene.route, self.scene.ground)
        self.traffic: Traffic = make_traffic(config, self.scene.route, self.scene.ground)
        stamps_ns = scan_stamps(config, self.scene.route)
        self.truth = Trajectory(stamps_ns, self.drive.poses(seconds_of(stamps_ns)))

    def log(self) -> Log:
        """Return the log that the LiDAR records."""
        return synthetic_log(
            self.config,
            name=f"synthetic-{self.config.scene}-{self.config.seed}",
            sensor="lidar",
            truth=self.truth,
            poses=self.drive.poses,
            simulate=lambda index, _colour: self.observe(index),
        )

    def observe(self, index: int) -> Scan:
        """Return a scan as the sensor reports it."""
        return self.observe_labelled(index)[0]

    def observe_labelled(self, index: int) -> tuple[Scan, NDArray[np.bool_]]:
        """Return a scan as the sensor reports it, and (N,) whether each of its points lies on a mover."""
        sensor, stamp_ns = self.config.sensor, int(self.truth.stamps_ns[index])
        start_s = seconds_of(self.truth.stamps_ns[index : index + 1])
        if sensor.motion_distortion:
            poses = self.drive.poses(start_s + firing_times_s(sensor))
        else:
            poses = np.broadcast_to(self.truth.T_world_body[index], (sensor.azimuth_steps, 4, 4))
        points_lidar, columns, moving = measure(
            self.scene,
            sensor,
            poses,
            rng_of(self.config.seed, Stream.SENSOR, noise_index(self.config.day, index)),
            traffic=self.traffic,
            start_s=float(start_s[0]),
        )
        times_s = firing_times_s(sensor)[columns].astype(np.float32) if sensor.motion_distortion else None
        return Scan(stamp_ns, points_lidar, times_s=times_s), moving


def write_lidar_log(
    out: Path, config: LidarSynthConfig, *, on_progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a synthetic log as KITTI's ``velodyne``, ``times.txt`` and ``poses.txt``, and the scene itself.

    There is no ``calib.txt``: the poses are the LiDAR's own. KITTI's records have no room for times, so
    scans with motion in them are numpy arrays with fields x, y, z and t, seconds after the stamp. The folder
    appears when it is complete.

    Args:
        out: Folder to make; it must not exist.
        config: Settings of the log.
        on_progress: Called with (scans written, scans in all) after every scan.

    Raises:
        SourceError: ``out`` exists, or cannot be written.
    """
    simulator = LidarSimulator(config)
    log = simulator.log()

    def save(index: int) -> None:
        save_scan(clouds / f"{index:06d}", simulator.observe(index))

    with new_folder(out) as folder:
        clouds = folder / "velodyne"
        clouds.mkdir()
        for done, _ in enumerate(ordered_map(save, range(len(log))), start=1):
            if on_progress is not None:
                on_progress(done, len(log))
        times = [seconds_text_from_ns(stamp_ns) for stamp_ns in log.stamps_ns.tolist()]
        (folder / "times.txt").write_text("\n".join(times) + "\n", encoding="utf-8")
        write_kitti(folder / "poses.txt", simulator.truth)
        if log.wheels is not None:
            write_wheels(folder, log.wheels, sensor=log.sensor)
        if log.gyroscope is not None and log.accelerations is not None:
            write_imu(folder, log.gyroscope, log.accelerations)
        if log.gnss is not None:
            write_gnss(folder, log.gnss)
        scene = {
            "config": set_or_first(config, exclude=set()),
            "ground": simulator.scene.ground.as_json(),
            "solids": simulator.scene.solids.as_json(),
        }
        write_json(folder / "scene.json", scene, indent=1)
