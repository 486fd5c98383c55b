"""HoloLens 2's recordings by StreamRecorder before a slanted wall.

https://github.com/microsoft/HoloLens2ForCV/tree/main/Samples/StreamRecorder
"""

from pathlib import Path

import cv2
import numpy as np

from mapper.core.geometry import Transform, exp, inverse

START_NS, TICK_NS, TICKS_TO_1970 = 1_700_000_000_000_000_000, 100, 116_444_736_000_000_000
COLOUR_NS = [START_NS + k * 33_333_300 for k in range(13)]
DEPTH_NS = [START_NS + at_ms * 1_000_000 for at_ms in (70, 210, 360)]
COLOUR_PX, DEPTH_PX = (380, 214), (320, 288)
FOCAL_PX, CENTRE_PX = (291.0, 292.5), (178.5, 110.0)
"""As of the file, whose centres of pixels are halves."""
NORMAL_WORLD, OFFSET_M = np.array([0.35, -0.2, 1.0]) / np.linalg.norm([0.35, -0.2, 1.0]), 2.4
"""The wall: points p with n·p = offset."""
T_RIG_COLOUR = exp(np.array([0.12, 0.01, -0.02]), np.array([0.03, 0.06, 0.01]))
T_DEPTH_RIG = exp(np.array([-0.3, 0.02, 0.01]), np.array([-0.02, -0.05, 0.02]))
_FROM_Y_UP = np.diag([1.0, -1.0, -1.0, 1.0])


def rig_pose(stamp_ns: int) -> Transform:
    """Return T_world_rig: it moves and turns steadily."""
    seconds = 1e-9 * (stamp_ns - START_NS)
    return exp(np.array([0.05, 0.2, 0.02]) * seconds, np.array([0.2, 0.1, -0.1]) * seconds)


def unit_rays() -> np.ndarray:
    """Return (H, W, 3) unit rays of a wide lens that has none in the corners."""
    columns, rows = np.meshgrid(np.arange(DEPTH_PX[0]) + 0.5, np.arange(DEPTH_PX[1]) + 0.5)
    x, y = (columns - 163.0) / 190.0, (rows - 141.0) / 190.0
    r2 = x * x + y * y
    rays = np.dstack([x * (1.0 + 0.12 * r2), y * (1.0 + 0.12 * r2), np.ones_like(x)])
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    rays[r2 > 1.1] *= [1.0, 1.0, 0.0]
    return rays


def write_hololens(
    folder: Path, *, is_raw: bool = False, focal_px: tuple[float, ...] = (FOCAL_PX[0],)
) -> Path:
    """Write a recording of 13 colour images and 3 of depth; image k has the grey value 10 k.

    Args:
        folder: Folder to make.
        is_raw: Colour is BGRA, as before ``convert_images.py``.
        focal_px: fx of the images, in turn.
    """
    for name in ("PV", "Depth Long Throw"):
        (folder / name).mkdir(parents=True)
    lines = [_line(*CENTRE_PX, *COLOUR_PX)]
    for k, stamp_ns in enumerate(COLOUR_NS):
        T_world_colour = rig_pose(stamp_ns) @ T_RIG_COLOUR @ _FROM_Y_UP
        fx = focal_px[k % len(focal_px)]
        lines.append(_line(_ticks(stamp_ns), fx, FOCAL_PX[1], *T_world_colour.ravel()))
        bgra = np.full((*COLOUR_PX[::-1], 4), (10 * k, 10 * k + 1, 10 * k + 2, 255), np.uint8)
        if is_raw:
            (folder / f"PV/{_ticks(stamp_ns)}.bytes").write_bytes(bgra.tobytes())
        else:
            cv2.imwrite(str(folder / f"PV/{_ticks(stamp_ns)}.png"), bgra[..., :3])
    (folder / "2023-11-14-221320_pv.txt").write_text("".join(lines))
    rays, poses = unit_rays(), []
    for stamp_ns in DEPTH_NS:
        T_world_depth = rig_pose(stamp_ns) @ inverse(T_DEPTH_RIG)
        towards = rays @ T_world_depth[:3, :3].T @ NORMAL_WORLD
        distances_m = (OFFSET_M - NORMAL_WORLD @ T_world_depth[:3, 3]) / towards
        units = np.where(rays[..., 2] > 0.0, np.rint(1000.0 * distances_m), 0.0).astype(np.uint16)
        cv2.imwrite(str(folder / f"Depth Long Throw/{_ticks(stamp_ns)}.pgm"), units)
        cv2.imwrite(str(folder / f"Depth Long Throw/{_ticks(stamp_ns)}_ab.pgm"), units // 4)
        poses.append(_line(_ticks(stamp_ns), *rig_pose(stamp_ns).ravel()))
    (folder / "Depth Long Throw_rig2world.txt").write_text("".join(poses))
    (folder / "Depth Long Throw_extrinsics.txt").write_text(_line(*T_DEPTH_RIG.ravel()))
    rays.astype("<f4").tofile(folder / "Depth Long Throw_lut.bin")
    return folder


def _ticks(stamp_ns: int) -> int:
    return TICKS_TO_1970 + stamp_ns // TICK_NS


def _line(*numbers: float) -> str:
    """Return a line as C++ streams write it: of six digits, but integers whole."""
    return ",".join(f"{n}" if isinstance(n, int) else f"{n:g}" for n in numbers) + "\n"
