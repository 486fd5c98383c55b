"""Exact images of a scene by ray casting: the first surface on every pixel's ray, and its colour.

Boxes are drawn from near to far. A box is tried only in the 16 × 16 px tiles that its projection
touches and in which something deeper is still to be seen (hierarchical z-buffer, Greene et al. 1993);
inside a tile each ray is intersected exactly with the slabs of the box (Kay & Kajiya 1986). Textures are
filtered by mip-maps (Williams 1983), and brightness is that of the face.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import NO_DISTORTION, DepthImage, Image, PinholeCamera
from mapper.core.geometry import Array, Transform
from mapper.simulation.boxes import BoxView, view_of
from mapper.simulation.builder import LEVELS, Atlas, Faces
from mapper.simulation.scene import Scene

_TILE_PX = 16
_NEAR_M = 0.02
_TAPS_APART = 0.1
"""Taps closer than this share of a filtered texel are one."""
_S_AXIS = np.array([1, 1, 0, 0, 0, 0])
_S_SIGN = np.array([-1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
_T_AXIS = np.array([2, 2, 2, 2, 1, 1])
_T_SIGN = np.array([-1.0, -1.0, -1.0, -1.0, 1.0, -1.0])
"""Directions of a face's columns (s) and rows (t) in the box's frame, so that print is not mirrored."""


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """Image and depth of a scene by an ideal camera.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 exact depth along the optical axis, metres; 0 where the ray meets nothing.
        surface: (H, W) int32 face that was met, 6 · box + face; −1 where there is none.
        cosine: (H, W) float32 cosine between the ray and the face's normal, 0 … 1.
    """

    rgb: Image
    depth_m: DepthImage
    surface: NDArray[np.int32]
    cosine: NDArray[np.float32]


def render(scene: Scene, camera: PinholeCamera, T_world_camera: Transform) -> Rendering:
    """Return the exact image and depth of a scene from a pose of the camera's optical frame.

    Raises:
        DataError: The camera has distortion, which this renderer does not support.
    """
    if camera.distortion != NO_DISTORTION:
        raise DataError(f"render: camera with distortion {camera.distortion}; want a camera without")
    view = view_of(scene.boxes, camera, T_world_camera)
    shape = (camera.height_px, camera.width_px)
    depth_m = np.full(shape, np.inf)
    surface = np.full(shape, -1, dtype=np.int32)
    rectangles, nearest_m = _project(view, shape)
    order = np.argsort(nearest_m, kind="stable")
    order = order[np.isfinite(nearest_m[order])]
    _trace(view, order, rectangles, nearest_m, depth_m, surface)
    rgb = np.zeros((*shape, 3), dtype=np.uint8)
    cosine = np.zeros(shape, dtype=np.float32)
    footprint = np.zeros((*shape, 6), dtype=np.float32)
    locate(view, scene.faces, depth_m, surface, footprint, cosine)
    paint(scene.faces, scene.atlas, footprint, surface, rgb)
    depth_m[surface < 0] = 0.0
    return Rendering(rgb, depth_m.astype(np.float32), surface, cosine)


@njit(cache=True, nogil=True)
def _project(view: BoxView, shape: tuple[int, int]) -> tuple[NDArray[np.int64], Array]:
    """Return each box's pixel rectangle (first column, first row, end column, end row) and nearest depth.

    Edges that pass behind the camera are cut at the near plane. A box that cannot be seen has depth inf.
    """
    halves, R_box_camera, origin_box, intrinsics = view
    fx, fy, cx, cy = intrinsics
    rectangles = np.zeros((len(halves), 4), dtype=np.int64)
    nearest = np.full(len(halves), np.inf)
    corners = np.empty((8, 3))
    for b in range(len(halves)):
        for c in range(8):
            for k in range(3):
                corners[c, k] = 0.0
            for axis in range(3):
                reach = halves[b, axis] if (c >> axis) & 1 else -halves[b, axis]
                for k in range(3):
                    corners[c, k] += (reach - origin_box[b, axis]) * R_box_camera[b, axis, k]
        u0, v0, u1, v1, depth = np.inf, np.inf, -np.inf, -np.inf, np.inf
        for c in range(8):
            for axis in range(3):
                d = c ^ (1 << axis)
                z_c, z_d = corners[c, 2], corners[d, 2]
                if z_c < _NEAR_M and z_d < _NEAR_M:
                    continue
                # The visible end of each edge as seen from this corner: itself, or the cut.
                f = 0.0 if z_c >= _NEAR_M else (_NEAR_M - z_c) / (z_d - z_c)
                x = corners[c, 0] + f * (corners[d, 0] - corners[c, 0])
                y = corners[c, 1] + f * (corners[d, 1] - corners[c, 1])
                z = max(z_c, _NEAR_M)
                u, v = fx * x / z + cx, fy * y / z + cy
                u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
                depth = min(depth, z)
        if u1 < 0.0 or v1 < 0.0 or u0 > shape[1] - 1 or v0 > shape[0] - 1:
            continue
        rectangles[b, 0] = int(max(np.floor(u0), 0.0))
        rectangles[b, 1] = int(max(np.floor(v0), 0.0))
        rectangles[b, 2] = int(min(np.ceil(u1), shape[1] - 1.0)) + 1
        rectangles[b, 3] = int(min(np.ceil(v1), shape[0] - 1.0)) + 1
        nearest[b] = depth
    return rectangles, nearest


@njit(cache=True, nogil=True, error_model="numpy")
def _trace(
    view: BoxView,
    order: NDArray[np.int64],
    rectangles: NDArray[np.int64],
    nearest: Array,
    depth: Array,
    surface: NDArray[np.int32],
) -> None:
    """Fill depth and surface of every pixel; ``order`` lists boxes from near to far."""
    halves, R_box_camera, origin_box, intrinsics = view
    height, width = depth.shape
    deepest = np.full((-(-height // _TILE_PX), -(-width // _TILE_PX)), np.inf)
    for b in order:
        u0, v0, u1, v1 = rectangles[b]
        for tile_v in range(v0 // _TILE_PX, (v1 + _TILE_PX - 1) // _TILE_PX):
            top, bottom = tile_v * _TILE_PX, min((tile_v + 1) * _TILE_PX, height)
            for tile_u in range(u0 // _TILE_PX, (u1 + _TILE_PX - 1) // _TILE_PX):
                if nearest[b] >= deepest[tile_v, tile_u]:
                    continue
                left, right = tile_u * _TILE_PX, min((tile_u + 1) * _TILE_PX, width)
                part = max(left, u0), max(top, v0), min(right, u1), min(bottom, v1)
                if _trace_box(b, halves[b], R_box_camera[b], origin_box[b], intrinsics, part, depth, surface):
                    deepest[tile_v, tile_u] = depth[top:bottom, left:right].max()


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_box(
    b: int,
    half: Array,
    R: Array,
    origin: Array,
    intrinsics: Array,
    part: tuple[int, int, int, int],
    depth: Array,
    surface: NDArray[np.int32],
) -> bool:
    """Fill the pixels of a part of the image in which a box is the nearest; return whether there are any.

    Args:
        b: Number of the box.
        half: (3,) half of its edges, metres.
        R: (3, 3) R_box_camera.
        origin: (3,) position of the camera in the box's frame, metres.
        intrinsics: fx, fy, cx, cy in pixels.
        part: First column and row, and those after the last.
        depth: (H, W) metres, written.
        surface: (H, W) 6 · box + face, written.
    """
    fx, fy, cx, cy = intrinsics
    left, top, right, bottom = part
    centre, size = (origin[0], origin[1], origin[2]), (half[0], half[1], half[2])
    touched = False
    for v in range(top, bottom):
        y = (v - cy) / fy
        bx, by, bz = R[0, 1] * y + R[0, 2], R[1, 1] * y + R[1, 2], R[2, 1] * y + R[2, 2]
        for u in range(left, right):
            x = (u - cx) / fx
            ray = R[0, 0] * x + bx, R[1, 0] * x + by, R[2, 0] * x + bz
            enter, leave, face = _slabs(centre, size, ray)
            if enter <= leave and enter > _NEAR_M and enter < depth[v, u]:
                depth[v, u], surface[v, u] = enter, 6 * b + face
                touched = True
    return touched


@njit(cache=True, nogil=True, error_model="numpy")
def _slabs(
    origin: tuple[float, float, float], half: tuple[float, float, float], ray: tuple[float, float, float]
) -> tuple[float, float, int]:
    """Return where a ray enters and leaves a box, in lengths of the ray, and the face by which it enters."""
    ix, iy, iz = 1.0 / ray[0], 1.0 / ray[1], 1.0 / ray[2]
    # A slab is entered at centre − half and left at centre + half.
    mx, my, mz = -origin[0] * ix, -origin[1] * iy, -origin[2] * iz
    wx, wy, wz = half[0] * abs(ix), half[1] * abs(iy), half[2] * abs(iz)
    enter = max(mx - wx, my - wy, mz - wz)
    if enter == mx - wx:
        face = 0 if ix > 0.0 else 1
    elif enter == my - wy:
        face = 2 if iy > 0.0 else 3
    else:
        face = 4 if iz > 0.0 else 5
    return enter, min(mx + wx, my + wy, mz + wz), face


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
