"""LiDAR simulator: a log in memory whose scans are cast when they are loaded."""

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Scan
from mapper.core.trajectory import Trajectory
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar.route import Drive, make_drive, scan_stamps
from mapper.simulation.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.sensor import column_times_s, firing_times_s, measure
from mapper.simulation.lidar.traffic import Traffic, make_traffic
from mapper.simulation.path import seconds_of
from mapper.simulation.source import synthetic_log
from mapper.simulation.streams import Stream, noise_index, rng_of
from mapper.sources.base import Log


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
        times_s = column_times_s(sensor, columns) if sensor.motion_distortion else None
        return Scan(stamp_ns, points_lidar, times_s=times_s), moving
