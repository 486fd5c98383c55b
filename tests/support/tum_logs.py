"""Tiny RGB-D logs as TUM folders, and their pictures."""

import shutil
from pathlib import Path

import cv2
import numpy as np

from mapper.core.timebase import seconds_text_from_ns

FIRST_NS = 1_305_031_102_175_304_000
PERIOD_NS = 33_333_000
DEPTH_LEAD_NS = 9_999_000
CALIBRATION = "fx_px = 60.0\nfy_px = 61.0\ncx_px = 31.5\ncy_px = 23.5\n"


def picture(seed: int, *, width_px: int = 64, height_px: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Return an RGB image and a 16-bit depth image with a hole."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height_px // 4, width_px // 4, 3), dtype=np.uint8)
    rgb = cv2.resize(coarse, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    rows, columns = np.mgrid[:height_px, :width_px]
    depth = (5000 + 20 * rows + 10 * columns + 100 * seed).astype(np.uint16)
    depth[: height_px // 4, : width_px // 4] = 0
    return rgb, depth


def write_picture(colour: Path, depth: Path, seed: int, **size: int) -> None:
    """Write the two images of ``picture`` as files."""
    rgb, units = picture(seed, **size)
    for path, pixels in ((colour, rgb[:, :, ::-1]), (depth, units)):
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), pixels)


def copy_numbered(log: Path, folder: Path) -> Path:
    """Copy a TUM log's images to a folder of numbered ones, as Redwood has them, and its calibration."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
        for number, image in enumerate(sorted((log / kind).iterdir())):
            shutil.copy(image, folder / kind / f"{number:06}.png")
    shutil.copy(log / "calibration.toml", folder)
    return folder


def write_tiny_log(log: Path, n: int, *, ending: str = ".png") -> Path:
    """Write a TUM folder of ``n`` 64×48 frames with truth along x at 0.3 m/s."""
    colour_lines, depth_lines, truth_lines = (["# tiny"] for _ in range(3))
    for i in range(n):
        stamp_ns = FIRST_NS + i * PERIOD_NS
        stamp, depth_stamp = (seconds_text_from_ns(t) for t in (stamp_ns, stamp_ns - DEPTH_LEAD_NS))
        write_picture(log / f"rgb/{stamp}{ending}", log / f"depth/{depth_stamp}.png", seed=i)
        colour_lines.append(f"{stamp} rgb/{stamp}{ending}")
        depth_lines.append(f"{depth_stamp} depth/{depth_stamp}.png")
        truth_lines.append(f"{seconds_text_from_ns(stamp_ns + 1_000_000)} {0.01 * i} 0 1.5 0 0 0.6 0.8")
    for name, lines in (("rgb", colour_lines), ("depth", depth_lines), ("groundtruth", truth_lines)):
        (log / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (log / "calibration.toml").write_text(CALIBRATION + "depth_factor = 5000\n")
    return log
