"""A synthetic log in memory: a ``FrameSource`` whose frames are rendered when they are loaded."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mapper.core.frames import DepthImage, Image, PinholeCamera, RgbdFrame, Scan, Sensor
from mapper.core.geometry import angle_between
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory
from mapper.simulation.config import SynthConfig
from mapper.simulation.movers import Movers, make_movers
from mapper.simulation.path import Motion, frame_stamps, make_motion, seconds_of
from mapper.simulation.raycast import Rendering, render
from mapper.simulation.scene import Scene, make_scene
from mapper.simulation.sensor import observe
from mapper.simulation.streams import Stream, rng_of
from mapper.simulation.wheel_readings import counted
from mapper.sources.base import Accelerations, ImageFiles

_BLUR_STEP_PX = 2.0
_MAX_SUBEXPOSURES = 12


def camera_of(config: SynthConfig) -> PinholeCamera:
    """Return the ideal camera of a configuration: square pixels, principal point in the middle."""
    focal_px = config.width_px / (2.0 * math.tan(config.horizontal_view_rad / 2.0))
    middle = ((config.width_px - 1) / 2.0, (config.height_px - 1) / 2.0)
    return PinholeCamera(config.width_px, config.height_px, focal_px, focal_px, *middle)


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticEntry:
    """One frame that will be rendered when it is loaded."""

    source: "SyntheticSource"
    index: int

    @property
    def stamp_ns(self) -> int:
        """Time of the frame, nanoseconds."""
        return int(self.source.stamps_ns[self.index])

    @property
    def files(self) -> ImageFiles | None:
        """None: there are none."""
        return None

    def load(self, *, colour: bool = True) -> RgbdFrame:
        """Render the frame, with its own noise; every call gives the same pixels."""
        image, depth_m = self.source.observe(self.index)
        frame = RgbdFrame(self.stamp_ns, image, depth_m, self.source.camera)
        return frame if colour else RgbdFrame(self.stamp_ns, frame.gray, depth_m, self.source.camera)

    def scan(self) -> Scan:
        """Render the frame and keep its returns."""
        return self.load(colour=False).scan()


class SyntheticSource:
    """A log that was never written.

    Attributes:
        config: What it is made from.
        scene: The world, without what moves in it.
        movers: What moves in it.
        camera: The camera.
        motion: Its pose at any time.
        stamps_ns: (N,) stamps of all frames, also of those that the log drops.
        path: A name for messages.
        name: The same.
        kind: "synthetic".
        sensor: "rgbd".
        truth: The exact pose of every frame, also of dropped ones.
        accelerations: None; there is no accelerometer.
        wheels: What the vehicle's would have counted; None without.
        notes: Empty.
    """

    def __init__(self, config: SynthConfig, scene: Scene | None = None) -> None:
        self.config = config
        self.scene = make_scene(config) if scene is None else scene
        self.movers: Movers = make_movers(config, self.scene)
        self.camera = camera_of(config)
        self.motion: Motion = make_motion(config, self.scene)
        self.stamps_ns: Stamps = frame_stamps(config, self.motion)
        self.name = f"synthetic-{config.path}-{config.seed}"
        self.path = Path(self.name)
        self.kind = "synthetic"
        self.sensor: Sensor = "rgbd"
        self.accelerations: Accelerations | None = None
        self.wheels: Trajectory | None = None
        if config.wheels is not None:
            self.wheels = counted(
                config.wheels,
                self.motion.poses,
                duration_s=float(seconds_of(self.stamps_ns[-1:])[0]),
                sensor=self.sensor,
                rng=rng_of(config.seed, Stream.WHEELS),
            )
        self.notes: Sequence[str] = ()

    @cached_property
    def truth(self) -> Trajectory:
        """Exact T_world_camera of every frame."""
        return Trajectory(self.stamps_ns, self.motion.poses(seconds_of(self.stamps_ns)))

    @cached_property
    def kept(self) -> tuple[int, ...]:
        """Indices of the frames that are in the log; the first always is."""
        chances = rng_of(self.config.seed, Stream.DROPS).random(len(self.stamps_ns))
        return tuple(i for i, chance in enumerate(chances) if i == 0 or chance >= self.config.drop_ratio)

    def __len__(self) -> int:
        return len(self.kept)

    def entries(self) -> Iterator[SyntheticEntry]:
        """Yield every kept frame's entry in time order."""
        for index in self.kept:
            yield SyntheticEntry(self, index)

    def render(self, index: int) -> Rendering:
        """Return the exact image and depth of a frame, blurred by motion during the exposure."""
        middle_s = seconds_of(self.stamps_ns[index : index + 1])
        scene = self.movers.scene_at(self.scene, float(middle_s[0]))
        exact = render(scene, self.camera, self.truth.T_world_body[index])
        exposure_s = self.config.sensor.exposure_s
        if exposure_s == 0.0:
            return exact
        count = self._subexposures(index)
        moments_s = exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        total = np.zeros(exact.rgb.shape, dtype=np.uint16)
        times_s = middle_s + moments_s
        for time_s, T_world_camera in zip(times_s, self.motion.poses(times_s), strict=True):
            scene = self.movers.scene_at(self.scene, float(time_s))
            total += render(scene, self.camera, T_world_camera).rgb
        blurred = ((total + count // 2) // count).astype(np.uint8)
        return Rendering(blurred, exact.depth_m, exact.surface, exact.cosine)

    def _subexposures(self, index: int) -> int:
        """Return how many images make a smooth blur: one for each two pixels of motion at a metre."""
        half_s = self.config.sensor.exposure_s / 2.0
        middle_s = seconds_of(self.stamps_ns[index : index + 1])
        begin, end = self.motion.poses(middle_s + np.array([-half_s, half_s]))
        turn_px = angle_between(begin[:3, :3], end[:3, :3]) * self.camera.fx_px
        shift_px = float(np.linalg.norm(end[:3, 3] - begin[:3, 3])) * self.camera.fx_px
        return int(np.clip(math.ceil((turn_px + shift_px) / _BLUR_STEP_PX), 1, _MAX_SUBEXPOSURES))

    def observe(self, index: int) -> tuple[Image, DepthImage]:
        """Return colour and depth of a frame as the sensor reports them."""
        if self._covered(index):
            shape = (self.camera.height_px, self.camera.width_px)
            return np.zeros((*shape, 3), dtype=np.uint8), np.zeros(shape, dtype=np.float32)
        rng = rng_of(self.config.seed, Stream.SENSOR, index)
        return observe(self.render(index), focal_px=self.camera.fx_px, sensor=self.config.sensor, rng=rng)

    def _covered(self, index: int) -> bool:
        start_s = self.config.blackout_start_s
        time_s = float(seconds_of(self.stamps_ns[index]))
        return start_s <= time_s < start_s + self.config.blackout_duration_s
