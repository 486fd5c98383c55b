"""Camera simulator: an RGB-D log whose frames are rendered when they are loaded, in memory or on a disk.

Disturbances of the recording are gaps, a frozen camera, a hand before the lens, jumps of the exposure.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import DepthImage, Frame, Image, PinholeCamera, RgbdFrame, Sensor
from mapper.core.geometry import Array
from mapper.core.timebase import seconds_text_from_ns
from mapper.core.trajectory import Trajectory
from mapper.runtime.atomic import new_folder
from mapper.runtime.ordered_map import ordered_map
from mapper.simulation.boxes import write_scene
from mapper.simulation.builder import FACES
from mapper.simulation.config import DisturbanceConfig, LidarSynthConfig, SynthConfig, set_or_first
from mapper.simulation.kinect import observe, warp_of
from mapper.simulation.movers import Movers, make_movers
from mapper.simulation.noise import fractal, tinted
from mapper.simulation.path import Motion, frame_stamps, make_motion, seconds_of
from mapper.simulation.raycast import Rendering
from mapper.simulation.readings import measure_gnss, measure_imu, measure_wheels
from mapper.simulation.scene import Scene, make_scene
from mapper.simulation.shutter import Shutter
from mapper.simulation.streams import Stream, noise_index, rng_of
from mapper.sources.base import FrameRef, Log
from mapper.sources.calibration_file import calibration_text
from mapper.sources.image_files.reading import TUM_UNITS_PER_M
from mapper.sources.readings_beside import write_readings
from mapper.sources.trajectory_files import write_tum

# One filter and no search for repeats: noise has none, and it takes a third of the time.
_COLOUR_PNG = (
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_SUB,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)
_DEPTH_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB)
_GOOD_JPG = (cv2.IMWRITE_JPEG_QUALITY, 92)
_IMU_AFTER_S = 0.5  # readings go on for this time after the last stamp, beyond the last sweep
_SKIN = (196, 148, 122)
_SWAY_SHARE, _SWAY_HZ = 0.03, 0.4
_HAND_BULGE = 0.15


def camera_of(config: SynthConfig) -> PinholeCamera:
    """Return the ideal camera of a configuration: square pixels, principal point in the middle."""
    focal_px = config.width_px / (2.0 * math.tan(config.horizontal_view_rad / 2.0))
    middle = ((config.width_px - 1) / 2.0, (config.height_px - 1) / 2.0)
    return PinholeCamera(config.width_px, config.height_px, focal_px, focal_px, *middle)


def synthetic_log(
    config: SynthConfig | LidarSynthConfig,
    *,
    name: str,
    sensor: Sensor,
    truth: Trajectory,
    poses: Callable[[Array], Array],
    simulate: Callable[[int, bool], Frame],
) -> Log:
    """Return the log of a simulated sensor, with wheels, an IMU and GNSS where configured.

    Args:
        config: Settings of the log.
        name: Name of the log.
        sensor: Kind of the frames.
        truth: Exact T_world_body of every frame.
        poses: Maps (N,) seconds after the start to (N, 4, 4) exact T_world_body.
        simulate: Returns a frame by its number; an image is grey where the second argument is false.
    """
    wheels = gyroscope = accelerations = gnss = None
    last_s = float(seconds_of(truth.stamps_ns[-1:])[0])
    if config.wheels is not None:
        rng = rng_of(config.seed, Stream.WHEELS)
        wheels = measure_wheels(config.wheels, poses, duration_s=last_s, sensor=sensor, rng=rng)
    if config.imu is not None:
        rng = rng_of(config.seed, Stream.IMU)
        duration_s = last_s + _IMU_AFTER_S
        gyroscope, accelerations = measure_imu(config.imu, poses, duration_s=duration_s, rng=rng)
    if isinstance(config, LidarSynthConfig) and config.gnss is not None:
        rng = rng_of(config.seed, Stream.GNSS)
        gnss = measure_gnss(config.gnss, poses, duration_s=last_s, rng=rng)
    return Log(
        path=Path(name),
        name=name,
        kind="synthetic",
        sensor=sensor,
        stamps_ns=truth.stamps_ns,
        entry_at=lambda index: FrameRef(int(truth.stamps_ns[index]), partial(simulate, index)),
        truth=truth,
        wheels=wheels,
        gyroscope=gyroscope,
        accelerations=accelerations,
        gnss=gnss,
    )


class CameraSimulator:
    """RGB-D camera that moves through a flat.

    Attributes:
        config: Settings of the log.
        scene: The world, without what moves in it.
        movers: Objects that move in it.
        camera: The camera.
        motion: Its pose at any time.
        truth: Exact T_world_camera of every frame, also of those that the log drops.
        kept: Indices of the frames that are in the log.
    """

    def __init__(self, config: SynthConfig, scene: Scene | None = None) -> None:
        self.config = config
        self.scene = make_scene(config) if scene is None else scene
        self.camera = camera_of(config)
        self.motion: Motion = make_motion(config, self.scene)
        self.movers: Movers = make_movers(config, self.scene, self.motion)
        self._shutter = Shutter(
            self.camera, config.sensor, self.motion, partial(self.movers.scene_at, self.scene)
        )
        stamps_ns = frame_stamps(config, self.motion)
        self.truth = Trajectory(stamps_ns, self.motion.poses(seconds_of(stamps_ns)))
        chances = rng_of(config.seed, Stream.DROPS).random(len(stamps_ns))
        chances[0] = 1.0
        self._times_s = seconds_of(stamps_ns)
        self._shown = shown_frames(config.disturbances, self._times_s)
        gap = between(self._times_s, config.disturbances.gap_start_s, config.disturbances.gap_duration_s)
        self.kept: NDArray[np.intp] = np.flatnonzero((chances >= config.drop_ratio) & ~gap)
        self._warp_px = warp_of(config) if config.sensor.disparity_warp_px > 0.0 else None

    def log(self) -> Log:
        """Return the log that the camera records."""
        log = synthetic_log(
            self.config,
            name=f"synthetic-{self.config.path}-{self.config.seed}",
            sensor="rgbd",
            truth=self.truth,
            poses=self.motion.poses,
            simulate=self.observe,
        )
        return log.subset(self.kept)

    def render(self, index: int) -> Rendering:
        """Return a frame's image and depth before the sensor's noise."""
        time_s = float(self._times_s[index])
        exact = self._shutter.take(time_s, self.truth.T_world_body[index])
        return disturbed(exact, self.config, time_s)

    def moving_pixels(self, index: int, depth_m: DepthImage) -> NDArray[np.bool_]:
        """Return (H, W) whether each pixel of a frame's measured depth lies on what moves.

        The sensor measures a fraction of a pixel beside a pixel, so near an outline the surface is that of
        the neighbouring pixel whose exact depth is nearest to the measured one.

        Args:
            index: The frame.
            depth_m: (H, W) its depth as ``observe`` returned it.
        """
        exact = self.render(int(self._shown[index]))
        moving = exact.surface >= FACES * len(self.scene.boxes)
        padded_m, padded = np.pad(exact.depth_m, 1, mode="edge"), np.pad(moving, 1, mode="edge")
        height, width = depth_m.shape
        nearest_m, found = np.full(depth_m.shape, np.inf, np.float32), np.zeros(depth_m.shape, np.bool_)
        for row, column in product((1, 0, 2), repeat=2):
            around = slice(row, row + height), slice(column, column + width)
            miss_m = np.abs(padded_m[around] - depth_m)
            better = miss_m < nearest_m
            nearest_m[better], found[better] = miss_m[better], padded[around][better]
        return found

    def observe(self, index: int, colour: bool = True) -> RgbdFrame:
        """Return a frame as the sensor reports it, in grey where ``colour`` is false."""
        shown = int(self._shown[index])
        if between(self._times_s[shown], self.config.blackout_start_s, self.config.blackout_duration_s):
            shape = (self.camera.height_px, self.camera.width_px)
            image, depth_m = np.zeros((*shape, 3), dtype=np.uint8), np.zeros(shape, dtype=np.float32)
        else:
            image, depth_m = observe(
                self.render(shown),
                focal_px=self.camera.fx_px,
                sensor=self.config.sensor,
                rng=rng_of(self.config.seed, Stream.SENSOR, noise_index(self.config.day, shown)),
                warp_px=self._warp_px,
            )
        frame = RgbdFrame(int(self.truth.stamps_ns[index]), image, depth_m, self.camera)
        return frame if colour else replace(frame, image=frame.gray)


def write_tum_log(
    out: Path, config: SynthConfig, *, on_progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a synthetic log as a TUM folder: images, lists, truth, calibration, and the scene itself.

    The folder appears when it is complete; until then it is ``out`` with ``.partial`` behind its name.

    Args:
        out: Folder to make; it must not exist.
        config: Settings of the log.
        on_progress: Called with (frames written, frames in all) after every frame.

    Raises:
        SourceError: ``out`` exists, or cannot be written.
    """
    with new_folder(out) as folder:
        for name in ("rgb", "depth"):
            (folder / name).mkdir()
        _write(folder, CameraSimulator(config), on_progress or (lambda _done, _total: None))


def _write(folder: Path, simulator: CameraSimulator, on_progress: Callable[[int, int], None]) -> None:
    config, log = simulator.config, simulator.log()
    lists = {
        "rgb": ["# color images", "# timestamp filename"],
        "depth": ["# depth maps", "# timestamp filename"],
    }

    def save(index: int) -> str:
        frame = simulator.observe(index)
        name = seconds_text_from_ns(frame.stamp_ns)
        _save_images(folder, name, frame, image_format=config.image_format)
        return name

    for done, name in enumerate(ordered_map(save, simulator.kept.tolist()), start=1):
        lists["rgb"].append(f"{name} rgb/{name}.{config.image_format}")
        lists["depth"].append(f"{name} depth/{name}.png")
        on_progress(done, len(log))
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_tum(folder / "groundtruth.txt", simulator.truth)
    calibration = calibration_text(simulator.camera, depth_units_per_m=TUM_UNITS_PER_M)
    (folder / "calibration.toml").write_text(calibration, encoding="utf-8")
    write_readings(log, folder, are_imu=True)
    unset = {"wall_distance_m"} if config.path != "wall" else set()
    settings = set_or_first(config, exclude=unset)
    moving = simulator.movers.as_json(seconds_of(simulator.truth.stamps_ns))
    write_scene(folder / "scene.json", simulator.scene.boxes, settings, moving=moving)


def _save_images(folder: Path, name: str, frame: RgbdFrame, *, image_format: str) -> None:
    units = np.rint(frame.depth_m * np.float32(TUM_UNITS_PER_M))
    units[units > np.iinfo(np.uint16).max] = 0.0  # deeper than 13.1 m does not fit: no measurement
    bgr = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
    options = _COLOUR_PNG if image_format == "png" else _GOOD_JPG
    for path, image, flags in (
        (folder / "rgb" / f"{name}.{image_format}", bgr, options),
        (folder / "depth" / f"{name}.png", units.astype(np.uint16), _DEPTH_PNG),
    ):
        _, encoded = cv2.imencode(path.suffix, image, flags)
        path.write_bytes(encoded.tobytes())


def between(times_s: Array, start_s: float, duration_s: float) -> NDArray[np.bool_]:
    """Return which of (N,) times lie in an interval, its end excluded."""
    return (times_s >= start_s) & (times_s < start_s + duration_s)


def shown_frames(config: DisturbanceConfig, times_s: Array) -> NDArray[np.intp]:
    """Return (N,) which frame's image is recorded for each: its own, or the one at which the camera froze."""
    shown = np.arange(len(times_s))
    frozen = np.flatnonzero(between(times_s, config.freeze_start_s, config.freeze_duration_s))
    shown[frozen] = max(frozen[0] - 1, 0) if len(frozen) else 0
    return shown


def disturbed(rendering: Rendering, config: SynthConfig, time_s: float) -> Rendering:
    """Return an exact image with the hand and the exposure that it has at a time, seconds after the start."""
    disturbances = config.disturbances
    if between(np.array(time_s), disturbances.hand_start_s, disturbances.hand_duration_s):
        rendering = _behind_hand(rendering, config, time_s)
    if disturbances.gain_step_s > 0.0:
        gain = gain_at(disturbances, time_s, seed=config.seed)
        rgb: Image = np.clip(np.rint(gain * rendering.rgb.astype(np.float32)), 0, 255).astype(np.uint8)
        rendering = replace(rendering, rgb=rgb)
    return rendering


def gain_at(config: DisturbanceConfig, time_s: float, *, seed: int) -> float:
    """Return by what the image's brightness is multiplied: by 1 at first, then more and less in turns."""
    step = int(time_s / config.gain_step_s)
    if step == 0:
        return 1.0
    share = float(rng_of(seed, Stream.GAINS, step).uniform(0.5, 1.0))
    return math.exp((share if step % 2 else -share) * math.log(config.gain_factor))


def _behind_hand(rendering: Rendering, config: SynthConfig, time_s: float) -> Rendering:
    """Return the image with an ellipse of skin in its middle, which sways a little."""
    height, width = rendering.depth_m.shape
    reach = math.sqrt(config.disturbances.hand_share / math.pi)
    angle = 2.0 * math.pi * _SWAY_HZ * time_s
    column = (np.arange(width) + 0.5) / width - 0.5 - _SWAY_SHARE * math.sin(angle)
    row = (np.arange(height)[:, None] + 0.5) / height - 0.5 - _SWAY_SHARE * math.sin(0.7 * angle)
    square = ((column / reach) ** 2 + (row / reach) ** 2).astype(np.float32)
    is_hand = square < 1.0
    rng = rng_of(config.seed, Stream.HAND)
    skin = tinted(_SKIN, 0.08 * fractal(rng, (height, width), cell_px=(height / 4, width / 4)))
    shift = np.array([[1, 0, _SWAY_SHARE * width * math.sin(angle)], [0, 1, 0]], dtype=np.float32)
    skin = np.asarray(cv2.warpAffine(skin, shift, (width, height), borderMode=cv2.BORDER_REFLECT), np.uint8)
    depth_m = np.float32(config.disturbances.hand_distance_m) * (1 + np.float32(_HAND_BULGE) * square)
    return Rendering(
        np.where(is_hand[:, :, None], skin, rendering.rgb),
        np.where(is_hand, depth_m, rendering.depth_m),
        np.where(is_hand, np.int32(-1), rendering.surface),
        np.where(is_hand, np.float32(1.0), rendering.cosine),
    )
