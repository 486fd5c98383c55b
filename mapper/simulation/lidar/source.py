"""A synthetic LiDAR log in memory: a ``FrameSource`` whose scans are cast when they are loaded."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mapper.core.frames import Scan, Sensor
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar.route import Drive, make_drive, scan_stamps
from mapper.simulation.lidar.scene import OutdoorScene, make_outdoor_scene
from mapper.simulation.lidar.sensor import firing_times_s, render_scan, render_sweep
from mapper.simulation.path import seconds_of
from mapper.simulation.streams import Stream, rng_of
from mapper.simulation.wheel_readings import counted
from mapper.sources.base import Accelerations, ImageFiles


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticLidarEntry:
    """One scan that will be cast when it is loaded."""

    source: "SyntheticLidarSource"
    index: int

    @property
    def stamp_ns(self) -> int:
        """Start of the sweep, nanoseconds."""
        return int(self.source.stamps_ns[self.index])

    @property
    def files(self) -> ImageFiles | None:
        """None: there are no images."""
        return None

    def load(self, *, colour: bool = True) -> Scan:  # noqa: ARG002 - a scan has no colour to leave out
        """Cast the scan, with its own noise; every call gives the same points."""
        return self.source.observe(self.index)

    def scan(self) -> Scan:
        """Cast the scan."""
        return self.load()


class SyntheticLidarSource:
    """A log that was never written.

    Attributes:
        config: What it is made from.
        scene: The world.
        drive: The sensor's pose at any time.
        stamps_ns: (N,) when each sweep begins.
        path: A name for messages.
        name: The same.
        kind: "synthetic".
        sensor: "lidar".
        truth: The exact pose at every stamp.
        accelerations: None; there is no accelerometer.
        wheels: What the vehicle's would have counted; None without.
        notes: Empty.
    """

    def __init__(self, config: LidarSynthConfig, scene: OutdoorScene | None = None) -> None:
        self.config = config
        self.scene = make_outdoor_scene(config) if scene is None else scene
        self.drive: Drive = make_drive(config, self.scene.route, self.scene.ground)
        self.stamps_ns: Stamps = scan_stamps(config, self.scene.route)
        self.name = f"synthetic-{config.scene}-{config.seed}"
        self.path = Path(self.name)
        self.kind = "synthetic"
        self.sensor: Sensor = "lidar"
        self.accelerations: Accelerations | None = None
        self.wheels: Trajectory | None = None
        if config.wheels is not None:
            self.wheels = counted(
                config.wheels,
                self.drive.poses,
                duration_s=float(seconds_of(self.stamps_ns[-1:])[0]),
                sensor=self.sensor,
                rng=rng_of(config.seed, Stream.WHEELS),
            )
        self.notes: Sequence[str] = ()

    @cached_property
    def truth(self) -> Trajectory:
        """Exact T_world_lidar at every stamp."""
        return Trajectory(self.stamps_ns, self.drive.poses(seconds_of(self.stamps_ns)))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def entries(self) -> Iterator[SyntheticLidarEntry]:
        """Yield every scan's entry in time order."""
        for index in range(len(self)):
            yield SyntheticLidarEntry(self, index)

    def observe(self, index: int) -> Scan:
        """Return a scan as the sensor reports it."""
        sensor, stamp_ns = self.config.sensor, int(self.stamps_ns[index])
        rng = rng_of(self.config.seed, Stream.SENSOR, index)
        if not sensor.motion_distortion:
            T_world_lidar = self.truth.T_world_body[index]
            return render_scan(self.scene, sensor, T_world_lidar, rng, stamp_ns=stamp_ns)
        start_s = seconds_of(self.stamps_ns[index : index + 1])
        poses = self.drive.poses(start_s + firing_times_s(sensor))
        return render_sweep(self.scene, sensor, poses, rng, stamp_ns=stamp_ns)
