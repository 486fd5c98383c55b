"""Image of a moving camera: blurred by exposure, read row by row, bent by a lens, its depth a little late."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Array, Transform, angle_between
from mapper.simulation.config import SensorConfig
from mapper.simulation.path import Motion
from mapper.simulation.raycast import Rendering, render
from mapper.simulation.scene import Scene

_BLUR_STEP_PX = 2.0
_MAX_SUBEXPOSURES = 12
_ROLL_STEP_PX = 1.0
_MAX_BANDS = 24
_INVERSION_STEPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """Lens with radial distortion before an ideal camera.

    Attributes:
        wide: Ideal camera that sees all that the lens does.
        columns: (H, W) float32 where each pixel of the image lies in the wide one.
        rows: (H, W) float32.
    """

    wide: PinholeCamera
    columns: NDArray[np.float32]
    rows: NDArray[np.float32]

    def bend(self, ideal: Rendering) -> Rendering:
        """Return the wide camera's image as it is behind the lens; depth is taken from the nearest pixel."""
        nearest = (np.rint(self.rows).astype(np.intp), np.rint(self.columns).astype(np.intp))
        rgb = cv2.remap(ideal.rgb, self.columns, self.rows, cv2.INTER_LINEAR)
        return Rendering(
            np.asarray(rgb, dtype=np.uint8),
            ideal.depth_m[nearest],
            ideal.surface[nearest],
            ideal.cosine[nearest],
        )


def make_lens(camera: PinholeCamera, *, k1: float, k2: float) -> Lens:
    """Return the lens of a camera, x_d = x · (1 + k1 r² + k2 r⁴) (Brown 1971)."""
    rows, columns = np.indices((camera.height_px, camera.width_px)).astype(np.float64)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    focal, middle = (camera.fx_px, camera.fy_px), (camera.cx_px, camera.cy_px)
    bent = (pixels - middle) / focal
    straight = bent.copy()
    for _ in range(_INVERSION_STEPS):
        square = (straight**2).sum(axis=1, keepdims=True)
        straight = bent / (1.0 + k1 * square + k2 * square**2)
    ideal = straight * focal + middle
    beyond = np.concatenate([-ideal.min(axis=0), ideal.max(axis=0) - pixels.max(axis=0)])
    margin = max(math.ceil(beyond.max()), 0) + 1
    wide = replace(
        camera,
        width_px=camera.width_px + 2 * margin,
        height_px=camera.height_px + 2 * margin,
        cx_px=camera.cx_px + margin,
        cy_px=camera.cy_px + margin,
    )
    maps = (ideal + margin).astype(np.float32).reshape(camera.height_px, camera.width_px, 2)
    return Lens(wide, np.ascontiguousarray(maps[:, :, 0]), np.ascontiguousarray(maps[:, :, 1]))


class Shutter:
    """Camera that moves while it takes an image.

    Args:
        camera: The ideal camera.
        sensor: Its exposure, its readout, its lens and the delay of its depth.
        motion: Its pose at any time.
        scene_at: Returns the world at a time in seconds after the start.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        sensor: SensorConfig,
        motion: Motion,
        scene_at: Callable[[float], Scene],
    ) -> None:
        self._camera, self._sensor, self._motion, self._scene_at = camera, sensor, motion, scene_at
        bends = sensor.radial_k1 != 0.0 or sensor.radial_k2 != 0.0
        self._lens = make_lens(camera, k1=sensor.radial_k1, k2=sensor.radial_k2) if bends else None

    def take(self, time_s: float, T_world_camera: Transform) -> Rendering:
        """Return the image and depth of a frame.

        Args:
            time_s: Middle of the exposure of the middle row, seconds after the start.
            T_world_camera: (4, 4) pose at that time.
        """
        exact = self._read_out(time_s, T_world_camera)
        rgb, exposure_s = exact.rgb, self._sensor.exposure_s
        if exposure_s > 0.0:
            count = self._steps(time_s, exposure_s, step_px=_BLUR_STEP_PX, most=_MAX_SUBEXPOSURES)
            total = np.zeros(rgb.shape, dtype=np.uint16)
            for moment_s in time_s + _spread_s(exposure_s, count):
                total += self._read_out(float(moment_s)).rgb
            rgb = ((total + count // 2) // count).astype(np.uint8)
        if self._sensor.depth_delay_s != 0.0:
            exact = self._read_out(time_s + self._sensor.depth_delay_s)
        seen = replace(exact, rgb=rgb)
        return seen if self._lens is None else self._lens.bend(seen)

    def _read_out(self, time_s: float, T_world_camera: Transform | None = None) -> Rendering:
        """Return the image of which the middle row is of a time, and each band of rows of its own."""
        camera = self._camera if self._lens is None else self._lens.wide
        if self._sensor.readout_s == 0.0:
            if T_world_camera is None:
                T_world_camera = self._motion.poses(np.array([time_s]))[0]
            return render(self._scene_at(time_s), camera, T_world_camera)
        count = self._steps(time_s, self._sensor.readout_s, step_px=_ROLL_STEP_PX, most=_MAX_BANDS)
        edges = np.linspace(0, camera.height_px, count + 1).round().astype(int).tolist()
        times_s = time_s + _spread_s(self._sensor.readout_s, count)
        bands = []
        for i, T_world_band in enumerate(self._motion.poses(times_s)):
            rows = edges[i + 1] - edges[i]
            band = replace(camera, height_px=rows, cy_px=camera.cy_px - edges[i])
            bands.append(render(self._scene_at(float(times_s[i])), band, T_world_band))
        return Rendering(
            *(
                np.concatenate([getattr(band, name) for band in bands])
                for name in ("rgb", "depth_m", "surface", "cosine")
            )
        )

    def _steps(self, time_s: float, duration_s: float, *, step_px: float, most: int) -> int:
        """Return the number of steps of a time in which a point at a metre moves no more than ``step_px``."""
        half_s = duration_s / 2.0
        begin, end = self._motion.poses(np.array([time_s]) + np.array([-half_s, half_s]))
        turn_px = angle_between(begin[:3, :3], end[:3, :3]) * self._camera.fx_px
        shift_px = float(np.linalg.norm(end[:3, 3] - begin[:3, 3])) * self._camera.fx_px
        return int(np.clip(math.ceil((turn_px + shift_px) / step_px), 1, most))


def _spread_s(duration_s: float, count: int) -> Array:
    """Return the middles of equal parts of a time around 0."""
    return duration_s * ((np.arange(count) + 0.5) / count - 0.5)
