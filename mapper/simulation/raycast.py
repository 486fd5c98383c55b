"""Exact images of a scene by ray casting: the first surface on every pixel's ray, and its colour.

Boxes are drawn from near to far. A box is tried only in the 16 × 16 px tiles that its projection
touches and in which something deeper is still to be seen (hierarchical z-buffer, Greene et al. 1993);
inside a tile each ray is intersected exactly with the slabs of the box (Kay & Kajiya 1986).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import NO_DISTORTION, DepthImage, Image, PinholeCamera
from mapper.core.geometry import Array, Transform
from mapper.simulation.boxes import BoxView, view_of
from mapper.simulation.scene import Scene
from mapper.simulation.shade import locate, paint

_TILE_PX = 16
_NEAR_M = 0.02


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
