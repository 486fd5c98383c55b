"""LiDAR simulator: a log in memory whose scans are cast when they are loaded, or written as a KITTI folder.

The lidar frame has x forward, y left, z up. A sweep begins looking back and turns clockwise seen from
above; its stamp is when it begins, so times are never negative. Cars, cyclists and pedestrians follow the
route, beside its middle.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array
from mapper.core.timebase import seconds_text_from_ns
from mapper.core.trajectory import Trajectory
from mapper.runtime.atomic import new_folder, write_json
from mapper.runtime.ordered_map import ordered_map
from mapper.simulation.builder import ORIGIN
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, set_or_first
from mapper.simulation.lidar import things
from mapper.simulation.lidar.cast import cast, sort_into_cells
from mapper.simulation.lidar.route import Drive, Route, make_drive, scan_stamps
from mapper.simulation.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.solids import Ground, Shape, Site, Solids
from mapper.simulation.path import seconds_of
from mapper.simulation.source import synthetic_log
from mapper.simulation.streams import Stream, noise_index, rng_of
from mapper.sources.base import Log
from mapper.sources.readings_beside import write_readings
from mapper.sources.scan_folders.kitti_writing import save_scan
from mapper.sources.trajectory_files import write_kitti

_LANE_M = 1.75
"""From the middle of the road to the middle of the oncoming lane."""
_CYCLE_LANE_M = (1.5, 2.1)
_PAVEMENT_M = (7.2, 7.6)
_ROAMING_M = (1.5, 4.0)
_LEAST_GAP_M = 12.0
_CAR_MPS, _CYCLIST_MPS, _PEDESTRIAN_MPS = (4.0, 9.0), (3.0, 6.0), (0.7, 1.6)
_PRISM_RAD, _PRISMS_HZ, _BEAMS_RAD = 0.307, np.array([121.57, -77.73]), 0.02
"""Deflection of each prism, turns of both (7294, -4664 a minute: Livox Mid-40), half of the beams' spread."""
_TURNS_HZ, _ZIGZAGS_HZ = 10.37, 187.3  # of no common period, so that sweeps differ


def firing_times_s(sensor: LidarSensorConfig) -> Array:
    """Return (A,) seconds after the stamp at which the columns of a sweep are fired."""
    return np.linspace(0.0, sensor.sweep_s, sensor.azimuth_steps, endpoint=False)


def ray_directions(sensor: LidarSensorConfig, start_s: float = 0.0) -> Array:
    """Return (A, E, 3) unit vectors in the lidar frame: columns in the order of firing, rings from below.

    Args:
        sensor: The LiDAR.
        start_s: When the sweep begins, on which the directions of patterns depend that do not repeat.
    """
    lowest_rad, highest_rad = sensor.lowest_ring_rad, sensor.highest_ring_rad
    times_s = start_s + firing_times_s(sensor)[:, None]
    across = np.linspace(-1.0, 1.0, sensor.rings)
    if sensor.pattern == "rings":
        steps = np.arange(sensor.azimuth_steps)[:, None] + 0.5
        azimuth = np.pi - 2.0 * np.pi * steps / sensor.azimuth_steps
        elevation = np.linspace(lowest_rad, highest_rad, sensor.rings)[None, :]
    elif sensor.pattern == "rosette":
        swing = _PRISM_RAD * np.exp(2j * np.pi * times_s * _PRISMS_HZ).sum(axis=1, keepdims=True)
        azimuth, elevation = swing.real, swing.imag + _BEAMS_RAD * across
    else:
        azimuth = np.pi - 2.0 * np.pi * _TURNS_HZ * times_s + _BEAMS_RAD * across
        height = np.abs(2.0 * (_ZIGZAGS_HZ * times_s % 1.0) - 1.0)
        elevation = lowest_rad + (highest_rad - lowest_rad) * height + _BEAMS_RAD * across
    flat, up = np.cos(elevation), np.sin(elevation)
    directions = np.broadcast_arrays(np.cos(azimuth) * flat, np.sin(azimuth) * flat, up)
    return np.stack(directions, axis=2)


def measure(
    scene: OutdoorScene,
    sensor: LidarSensorConfig,
    T_world_lidar: Array,
    rng: np.random.Generator,
    *,
    traffic: "Traffic | None" = None,
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
    rays_lidar = ray_directions(sensor, start_s)
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
        write_readings(log, folder, are_imu=True)
        scene = {
            "config": set_or_first(config, exclude=set()),
            "ground": simulator.scene.ground.as_json(),
            "solids": simulator.scene.solids.as_json(),
        }
        write_json(folder / "scene.json", scene, indent=1)


@dataclass(frozen=True, slots=True)
class _Mover:
    """A thing that follows the route, stopping now and then.

    Attributes:
        solids: Its parts, standing on the world's origin, facing along x.
        start_m: Position along the route at the start.
        offset_m: Distance that it keeps to the left of the route.
        speed_mps: Its speed while it goes; negative against the sensor's direction.
        go_s: Duration of motion.
        stop_s: Duration of the stop after it.
        phase_s: Time from its last departure to the start of the log.
    """

    solids: Solids
    start_m: float
    offset_m: float
    speed_mps: float
    go_s: float
    stop_s: float
    phase_s: float

    def along_m(self, times_s: Array) -> Array:
        """Return (N,) distances along the route at (N,) seconds after the start."""
        cycles, into_s = np.divmod(times_s + self.phase_s, self.go_s + self.stop_s)
        gone_s = cycles * self.go_s + np.minimum(into_s, self.go_s)
        return self.start_m + self.speed_mps * (gone_s - min(self.phase_s, self.go_s))


@dataclass(frozen=True, slots=True, eq=False)
class Traffic:
    """All that moves in an outdoor scene.

    Attributes:
        movers: Each of them.
        route: Route that they follow.
        ground: Ground on which they stand.
    """

    movers: tuple[_Mover, ...]
    route: Route
    ground: Ground

    def __len__(self) -> int:
        return len(self.movers)

    def ranges_m(
        self, origins: Array, directions: Array, max_range_m: float, *, start_s: float, fired_s: Array
    ) -> Array:
        """Return (A, E) ranges to the nearest mover along unit rays, metres; inf where none is met.

        Args:
            origins: (A, 3) world frame, metres.
            directions: (A, E, 3) world frame.
            max_range_m: Length of the rays.
            start_s: When the sweep begins, seconds after the log does.
            fired_s: (A,) seconds after that at which each column is fired.
        """
        nearest = np.full(directions.shape[:2], np.inf)
        middle_world = origins[len(origins) // 2]
        for mover in self.movers:
            ends_s = np.array([start_s, start_s + fired_s[-1] + 1e-3])
            places, yaws_rad = self._places(mover, ends_s)
            if np.linalg.norm(places[0] - middle_world) > max_range_m + 5.0:
                continue
            world = sort_into_cells(_placed(mover.solids, places[0], float(yaws_rad[0])), self.ground)
            # Seen from the mover the sensor moves: one world serves the whole sweep.
            velocity_mps = (places[1] - places[0]) / (ends_s[1] - ends_s[0])
            moved = np.ascontiguousarray(origins - fired_s[:, None] * velocity_mps)
            np.minimum(nearest, cast(world, moved, directions, max_range_m, False), out=nearest)
        return nearest

    def _places(self, mover: _Mover, times_s: Array) -> tuple[Array, Array]:
        along_m = mover.along_m(times_s)
        headings_rad = self.route.headings_rad(along_m)
        left = np.column_stack([-np.sin(headings_rad), np.cos(headings_rad)])
        points_xy = self.route.points(along_m) + mover.offset_m * left
        facing_rad = headings_rad + (math.pi if mover.speed_mps < 0.0 else 0.0)
        return np.column_stack([points_xy, self.ground.height_m(points_xy)]), facing_rad


def make_traffic(config: LidarSynthConfig, route: Route, ground: Ground) -> Traffic:
    """Return the traffic of a configuration; its seed determines what each looks like and how it moves."""
    rng, movers = rng_of(config.seed, Stream.MOVERS), []
    for _ in range(config.cars):
        ahead = rng.random() < 0.4
        # Cars ahead keep to the sensor's lane and its speed; the others come towards it.
        speed_mps = config.speed_mps if ahead else -float(rng.uniform(*_CAR_MPS))
        start_m = float(rng.uniform(_LEAST_GAP_M, 40.0) if ahead else rng.uniform(0.0, route.length_m))
        mover = _mover(_car(rng), rng, start_m=start_m, offset_m=0.0 if ahead else _LANE_M, mps=speed_mps)
        movers.append(replace(mover, stop_s=0.0) if ahead else mover)
    for _ in range(config.cyclists):
        side = float(rng.choice([-1.0, 1.0]))
        speed_mps, offset_m = (
            -side * float(rng.uniform(*_CYCLIST_MPS)),
            side * float(rng.uniform(*_CYCLE_LANE_M)),
        )
        start_m = float(rng.uniform(0.0, route.length_m))
        movers.append(_mover(_cyclist(rng), rng, start_m=start_m, offset_m=offset_m, mps=speed_mps))
    beside_m = _PAVEMENT_M if config.scene == "street" else _ROAMING_M
    for _ in range(config.pedestrians):
        offset_m = float(rng.choice([-1.0, 1.0]) * rng.uniform(*beside_m))
        speed_mps = float(rng.choice([-1.0, 1.0]) * rng.uniform(*_PEDESTRIAN_MPS))
        start_m = float(rng.uniform(0.0, route.length_m))
        movers.append(_mover(_pedestrian(rng), rng, start_m=start_m, offset_m=offset_m, mps=speed_mps))
    return Traffic(tuple(movers), route, ground)


def _mover(
    solids: Solids, rng: np.random.Generator, *, start_m: float, offset_m: float, mps: float
) -> _Mover:
    go_s, stop_s = float(rng.uniform(6.0, 14.0)), float(rng.uniform(0.0, 4.0))
    return _Mover(solids, start_m, offset_m, mps, go_s, stop_s, float(rng.uniform(0.0, go_s)))


def _placed(solids: Solids, place: Array, yaw_rad: float) -> Solids:
    """Return solids that stand on the origin moved to a (3,) place and turned there."""
    hulls, (cosine, sine) = solids.hulls, (math.cos(yaw_rad), math.sin(yaw_rad))
    R = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    centers_world = hulls.centers_world @ R.T + place
    return Solids(
        replace(hulls, centers_world=centers_world, yaws_rad=hulls.yaws_rad + yaw_rad), solids.shapes
    )


def _site() -> Site:
    return Site(Ground(np.zeros(2), np.zeros((0, 4))))


def _car(rng: np.random.Generator) -> Solids:
    site = _site()
    things.car(site, ORIGIN, rng)
    for x in (-1.25, 1.25):
        for y in (-0.75, 0.75):
            site.add("car", ORIGIN, center=(x, y, 0.31), size=(0.62, 0.2, 0.62), shape=Shape.ELLIPSOID)
    return site.solids()


def _cyclist(rng: np.random.Generator) -> Solids:
    site = _site()
    things.bicycle(site, ORIGIN, rng)
    site.add("cyclist", ORIGIN, center=(0.0, 0.0, 0.7), size=(0.4, 0.34, 0.6), shape=Shape.ELLIPSOID)
    site.add("cyclist", ORIGIN, center=(0.1, 0.0, 1.2), size=(0.35, 0.45, 0.65), shape=Shape.ELLIPSOID)
    site.add("cyclist", ORIGIN, center=(0.25, 0.0, 1.6), size=(0.22, 0.2, 0.26), shape=Shape.ELLIPSOID)
    return site.solids()


def _pedestrian(rng: np.random.Generator) -> Solids:
    site, height_m = _site(), float(rng.uniform(1.3, 1.9))
    legs, trunk, head = 0.48 * height_m, 0.38 * height_m, 0.14 * height_m
    for side in (-0.1, 0.1):
        size = (0.16, 0.14, legs)
        center = (2.0 * side * float(rng.uniform(0.2, 1.0)), side, legs / 2.0)
        site.add("pedestrian", ORIGIN, center=center, size=size, shape=Shape.CYLINDER)
    size = (0.26, 0.44, trunk)
    site.add("pedestrian", ORIGIN, center=(0.0, 0.0, legs + trunk / 2.0), size=size, shape=Shape.CYLINDER)
    center, size = (0.0, 0.0, height_m - head / 2.0), (0.2, 0.18, head)
    site.add("pedestrian", ORIGIN, center=center, size=size, shape=Shape.ELLIPSOID)
    return site.solids()
