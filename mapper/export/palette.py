"""The colours that every picture and viewer file shares, as (R, G, B) bytes."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.graph.model import Origin

Rgb = tuple[int, int, int]

ESTIMATE: Rgb = (214, 69, 37)
TRUTH: Rgb = (45, 108, 178)
START: Rgb = (38, 145, 87)
END: Rgb = (30, 33, 41)
PLAN: Rgb = (124, 58, 196)
ACCEPTED: Rgb = (196, 40, 140)
REJECTED: Rgb = (176, 182, 192)
FACTORS: dict[Origin, Rgb] = {
    "odometry": (140, 146, 158),
    "loop": (196, 40, 140),
    "wheel": (224, 160, 32),
}
UNKNOWN_CELL: Rgb = (214, 218, 224)
FREE_CELL: Rgb = (255, 255, 255)
OCCUPIED_CELL: Rgb = (35, 41, 54)


def height_colors(
    heights_m: NDArray[np.floating], *, between_m: tuple[float, float] | None = None
) -> NDArray[np.uint8]:
    """Return (N, 3) uint8 RGB for (N,) heights, from blue to red; the palette is Turbo (Mikhailov 2019).

    Args:
        heights_m: In any frame.
        between_m: Heights of pure blue and red; None is the 2nd and the 98th percentile.
    """
    if len(heights_m) == 0:
        return np.empty((0, 3), np.uint8)
    low, high = between_m or np.percentile(heights_m, [2.0, 98.0])
    share = np.clip((heights_m - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    levels = np.rint(255.0 * share).astype(np.uint8).reshape(-1, 1)
    bgr = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)
    return np.ascontiguousarray(bgr.reshape(-1, 3)[:, ::-1], dtype=np.uint8)
