"""The colour of every pixel: textures filtered by mip-maps (Williams 1983), brightness by face."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.simulation.boxes import BoxView
from mapper.simulation.builder import LEVELS, Atlas, Faces

_TAPS_APART = 0.1
"""Taps closer than this share of a filtered texel are one."""

_S_AXIS = np.array([1, 1, 0, 0, 0, 0])
_S_SIGN = np.array([-1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
_T_AXIS = np.array([2, 2, 2, 2, 1, 1])
_T_SIGN = np.array([-1.0, -1.0, -1.0, -1.0, 1.0, -1.0])
"""Directions of a face's columns (s) and rows (t) in the box's frame, so that print is not mirrored."""


@njit(cache=True, nogil=True, error_model="numpy")
def locate(
    view: BoxView,
    faces: Faces,
    depth: Array,
    surface: NDArray[np.int32],
    footprint: NDArray[np.float32],
    cosine: NDArray[np.float32],
) -> None:
    """Fill where on its texture each pixel with a surface lies, and how far its neighbours are.

    Args:
        view: The boxes and the camera.
        faces: The boxes' faces.
        depth: (H, W) metres along the optical axis.
        surface: (H, W) 6 · box + face, or −1.
        footprint: (H, W, 6), written: texel (s, t), and its exact derivatives along image columns and rows.
        cosine: (H, W), written: between the ray and the face's normal.
    """
    halves, R_box_camera, origin_box, intrinsics = view
    scales, offsets = faces.scales, faces.offsets
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    for v in range(height):
        y = (v - cy) / fy
        for u in range(width):
            if surface[v, u] < 0:
                continue
            b, face = surface[v, u] // 6, surface[v, u] % 6
            x, z, n = (u - cx) / fx, depth[v, u], face // 2
            i, j = _S_AXIS[face], _T_AXIS[face]
            ray_n = R_box_camera[b, n, 0] * x + R_box_camera[b, n, 1] * y + R_box_camera[b, n, 2]
            ray_i = R_box_camera[b, i, 0] * x + R_box_camera[b, i, 1] * y + R_box_camera[b, i, 2]
            ray_j = R_box_camera[b, j, 0] * x + R_box_camera[b, j, 1] * y + R_box_camera[b, j, 2]
            # As the ray turns, its depth on the plane changes too: d(z) = −z · d(ray_n) / ray_n.
            turn_u, turn_v = R_box_camera[b, n, 0] / ray_n, R_box_camera[b, n, 1] / ray_n
            s_scale, t_scale = scales[b, face, 0], scales[b, face, 1]
            s_step, t_step = _S_SIGN[face] * s_scale, _T_SIGN[face] * t_scale
            s = s_scale * halves[b, i] + s_step * (origin_box[b, i] + z * ray_i)
            t = t_scale * halves[b, j] + t_step * (origin_box[b, j] + z * ray_j)
            footprint[v, u, 0] = offsets[b, face, 0] + s
            footprint[v, u, 1] = offsets[b, face, 1] + t
            footprint[v, u, 2] = s_step * z / fx * (R_box_camera[b, i, 0] - ray_i * turn_u)
            footprint[v, u, 3] = t_step * z / fx * (R_box_camera[b, j, 0] - ray_j * turn_u)
            footprint[v, u, 4] = s_step * z / fy * (R_box_camera[b, i, 1] - ray_i * turn_v)
            footprint[v, u, 5] = t_step * z / fy * (R_box_camera[b, j, 1] - ray_j * turn_v)
            cosine[v, u] = abs(ray_n) / np.sqrt(x * x + y * y + 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def paint(
    faces: Faces,
    atlas: Atlas,
    footprint: NDArray[np.float32],
    surface: NDArray[np.int32],
    rgb: NDArray[np.uint8],
) -> None:
    """Fill the colour of each pixel with a surface, from trilinear taps (Williams 1983).

    Args:
        faces: The boxes' faces.
        atlas: Their textures.
        footprint: (H, W, 6) as ``locate`` writes it.
        surface: (H, W) 6 · box + face, or −1.
        rgb: (H, W, 3), written.
    """
    for v in range(surface.shape[0]):
        for u in range(surface.shape[1]):
            if surface[v, u] < 0:
                continue
            b, face = surface[v, u] // 6, surface[v, u] % 6
            texture, shade = faces.textures[b, face], faces.shades[b, face]
            s, t = footprint[v, u, 0], footprint[v, u, 1]
            level, taps, s_tap, t_tap = _cover(
                footprint[v, u, 2], footprint[v, u, 3], footprint[v, u, 4], footprint[v, u, 5]
            )
            fine = int(level)
            f = level - fine
            s_unit, t_unit = 1.0 / atlas.widths_px[texture, 0], 1.0 / atlas.heights_px[texture, 0]
            red, green, blue = 0.0, 0.0, 0.0
            for tap in range(taps):
                s_here, t_here = s + (2 * tap - 1) * s_tap, t + (2 * tap - 1) * t_tap
                for k in range(fine, fine + (2 if f > 0.0 else 1)):
                    weight = (1.0 - f if k == fine else f) / taps
                    rows, columns = atlas.heights_px[texture, k], atlas.widths_px[texture, k]
                    start = atlas.starts[texture, k]
                    # Sizes halve with rounding, so a level's true scale is its own size over the first one's.
                    column = s_here * (columns * s_unit) - 0.5
                    row = t_here * (rows * t_unit) - 0.5
                    left, top = np.floor(column), np.floor(row)
                    right_share, low_share = column - left, row - top
                    c0, r0 = _wrapped(int(left), columns), _wrapped(int(top), rows)
                    c1, r1 = _wrapped(c0 + 1, columns), _wrapped(r0 + 1, rows)
                    for r, r_share in ((r0, 1.0 - low_share), (r1, low_share)):
                        for c, c_share in ((c0, 1.0 - right_share), (c1, right_share)):
                            i, w = start + r * columns + c, weight * r_share * c_share
                            red += w * atlas.texels[i, 0]
                            green += w * atlas.texels[i, 1]
                            blue += w * atlas.texels[i, 2]
            rgb[v, u, 0] = np.uint8(min(shade * red + 0.5, 255.0))
            rgb[v, u, 1] = np.uint8(min(shade * green + 0.5, 255.0))
            rgb[v, u, 2] = np.uint8(min(shade * blue + 0.5, 255.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(s_u: float, t_u: float, s_v: float, t_v: float) -> tuple[float, int, float, float]:
    """Return the level and the number of the taps that cover a footprint, and their offset in s and t.

    A footprint is given by the texel's derivatives along image columns (u) and rows (v). Two taps lie along
    its longer side where that is much longer, so that floors seen at a slant stay sharp without aliasing.
    """
    long_px, short_px = np.sqrt(s_u * s_u + t_u * t_u), np.sqrt(s_v * s_v + t_v * t_v)
    if long_px < short_px:
        long_px, short_px, s_u, t_u = short_px, long_px, s_v, t_v
    # The taps part smoothly, to a quarter of the long side once it is twice the short one.
    apart = min(0.5 - 0.5 * short_px / long_px, 0.25)
    level_px = max(short_px, 0.5 * long_px, 1.0)
    level = min(np.log2(level_px), LEVELS - 1.0) if level_px > 1.0 else 0.0
    if apart * long_px > _TAPS_APART * level_px:
        return level, 2, apart * s_u, apart * t_u
    return level, 1, 0.0, 0.0


@njit(cache=True, nogil=True)
def _wrapped(index: int, size: int) -> int:
    """Return index modulo size: textures repeat; the division is slow and rarely needed."""
    return index if 0 <= index < size else index % size
