"""Comparison of a depth image with those of earlier keyframes: what has moved since, and what lies elsewhere.

What stands where an earlier image saw through has moved there, whatever its features show. And the surfaces
of a scene that stands still lie where they lay: if many do not, the pose is that of something that moves.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform
from mapper.core.linear import between
from mapper.core.timebase import NS_PER_S
from mapper.odometry.camera.depth_surfaces import DepthCells
from mapper.odometry.camera.image_observation import ImageObservation
from mapper.odometry.keyframes.depth_kernels import cell_of, place_in_cells
from mapper.odometry.keyframes.landmarks import LandmarkMap
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig

_APART_S, _MOST = 0.4, 6
"""Time between the keyframes that are compared: someone who walks moves on by his own width in it."""
_MARGIN_M, _MARGIN_SIGMAS, _MARGIN_RATIO = 0.1, 4.0, 0.02
"""What has moved stands this far in front of a surface: more than the errors of poses, noise and scale."""
_MOST_MOVED_RATIO = 0.6
"""When more has moved it was the camera, and the pose is wrong."""
_SAME_M, _SAME_SIGMAS, _SAME_RATIO = 0.02, 3.0, 0.01
"""Surfaces that are no farther apart are the same."""
_SMOOTH = 1.1
"""Largest ratio of neighbouring cells' depths on one surface."""
_ELSEWHERE_M = 0.4
"""Surfaces that are farther apart are others, one of which hides the other."""
_MIN_COMPARED_RATIO = 0.1
"""With fewer of the points on surfaces that the keyframe saw, nothing is compared."""


@dataclass(frozen=True, slots=True)
class Displacement:
    """Part of a depth image that lies beside the surfaces an earlier one saw there.

    Attributes:
        ratio: Share of the points on the same surfaces or beside them.
        distance_m: Their mean distance along the earlier rays; 0 if there are none.
        since_s: Age of the earlier image.
    """

    ratio: float = 0.0
    distance_m: float = 0.0
    since_s: float = 0.0


class EarlierDepth:
    """Comparison of frames with the depth images of keyframes at least 0.4 s older."""

    def __init__(self, landmark_map: LandmarkMap, noise: DepthNoiseConfig | None) -> None:
        self._map = landmark_map
        noise = noise or KINECT_NOISE
        self._noise = np.array([noise.constant_m, noise.linear, noise.quadratic_per_m])

    def moved(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        reference: int,
        points_camera: Points | None = None,
    ) -> NDArray[np.bool_]:
        """Return (N,) which points stand where an earlier keyframe saw through; none if most of them do.

        Args:
            observation: The frame.
            T_camera_world: (4, 4) its pose, good to a few centimetres.
            reference: Keyframe that sees the place; it and those before it are compared.
            points_camera: (N, 3) metres, camera frame; None are the frame's features.
        """
        points = observation.points_camera if points_camera is None else points_camera
        earlier = self._earlier(observation, reference, most=_MOST)
        if observation.depth_cells is None or not earlier:
            return np.zeros(len(points), np.bool_)
        moved: NDArray[np.bool_] = _in_free_space(
            points,
            T_camera_world,
            np.array([_cells_of(self._map, k).inverse_depth for k in earlier]),
            np.array([self._map.keyframes[k].T_camera_world for k in earlier]),
            _optics(observation.depth_cells),
            observation.depth_cells.cell_px,
            self._noise,
        )
        if moved.sum() > _MOST_MOVED_RATIO * (~np.isnan(points[:, 2])).sum():
            moved[:] = False
        return moved

    def displacement(
        self, observation: ImageObservation, T_camera_world: Transform, reference: int
    ) -> Displacement:
        """Return how much of the depth image lies elsewhere than 0.4 s before; arguments as for ``moved``."""
        earlier = self._earlier(observation, reference, most=1)
        if observation.depth_cells is None or not earlier:
            return Displacement()
        keyframe, cells = self._map.keyframes[earlier[0]], observation.depth_cells
        points = cells.points()
        same, beside, distance_m = _apart(
            points,
            T_camera_world,
            _cells_of(self._map, earlier[0]).inverse_depth,
            keyframe.T_camera_world,
            _optics(cells),
            cells.cell_px,
            self._noise,
        )
        if beside == 0 or same + beside < _MIN_COMPARED_RATIO * len(points):
            return Displacement()
        since_s = (observation.stamp_ns - keyframe.stamp_ns) / NS_PER_S
        return Displacement(beside / (same + beside), distance_m / beside, since_s)

    def _earlier(self, observation: ImageObservation, reference: int, *, most: int) -> list[int]:
        """Return keyframes of the same sub-map and camera, each 0.4 s older than the one before."""
        keyframes, cells = self._map.keyframes, observation.depth_cells
        if cells is None:
            return []
        apart_ns = round(_APART_S * NS_PER_S)
        origin, latest_ns = keyframes[reference].origin, observation.stamp_ns - apart_ns
        earlier: list[int] = []
        for k in range(reference, origin - 1, -1):
            there = keyframes[k]
            if there.stamp_ns > latest_ns or there.origin != origin or there.doubt_m > 0.0:
                continue
            theirs = self._map.observation(k).depth_cells
            if theirs is None or theirs.camera != cells.camera:
                continue
            earlier.append(k)
            if len(earlier) == most:
                break
            latest_ns = there.stamp_ns - apart_ns
        return earlier


def _cells_of(landmark_map: LandmarkMap, keyframe: int) -> DepthCells:
    cells = landmark_map.observation(keyframe).depth_cells
    assert cells is not None
    return cells


def _optics(cells: DepthCells) -> Array:
    """Return (9,) intrinsics and distortion, as the kernels of depth take them."""
    camera = cells.camera
    return np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.distortion])


@njit(cache=True, nogil=True)
def _in_free_space(points, T_camera_world, inverse_depth, T_keyframes_world, optics, cell_px, noise):
    """Return (N,) which points lie in front of all nine cells about the one that a keyframe sees them in."""
    moved = np.zeros(len(points), np.bool_)
    shape = inverse_depth.shape[1:]
    for k in range(len(inverse_depth)):
        T = between(T_keyframes_world[k], T_camera_world)
        for n in range(len(points)):
            if moved[n] or np.isnan(points[n, 2]):
                continue
            line, column, z = cell_of(T, points[n], optics, cell_px, shape)
            if line < 1 or column < 1 or line >= shape[0] - 1 or column >= shape[1] - 1:
                continue
            here = inverse_depth[k, line, column]
            if here <= 0.0 or 1.0 / here - z <= _MARGIN_M:
                continue  # the nearest about it are no farther
            around = inverse_depth[k, line - 1 : line + 2, column - 1 : column + 2]
            if around.min() <= 0.0:
                continue
            behind = 1.0 / around.max()
            sigma_m = noise[0] + behind * (noise[1] + behind * noise[2])
            moved[n] = behind - z > _MARGIN_M + _MARGIN_RATIO * behind + _MARGIN_SIGMAS * sigma_m
    return moved


@njit(cache=True, nogil=True)
def _apart(points, T_camera_world, inverse_depth, T_keyframe_world, optics, cell_px, noise):
    """Return how many points lie on a keyframe's surfaces, how many beside them, and the latter's distances.

    The inverse depth of a plane is linear in the image, so it is interpolated between the cells' middles.
    """
    T = between(T_keyframe_world, T_camera_world)
    rows, columns = inverse_depth.shape
    same = beside = 0
    distance_m = 0.0
    for n in range(len(points)):
        down, across, z = place_in_cells(T, points[n], optics, cell_px)
        down, across = down - 0.5, across - 0.5  # from the first cell's middle
        if down < 0.0 or across < 0.0 or down >= rows - 1 or across >= columns - 1:
            continue
        line, column = int(down), int(across)
        a, b = inverse_depth[line, column], inverse_depth[line, column + 1]
        c, d = inverse_depth[line + 1, column], inverse_depth[line + 1, column + 1]
        least = min(a, b, c, d)
        if least <= 0.0 or max(a, b, c, d) > _SMOOTH * least:
            continue
        s, t = down - line, across - column
        upper, lower = (1.0 - t) * a + t * b, (1.0 - t) * c + t * d
        apart = abs(z - 1.0 / ((1.0 - s) * upper + s * lower))
        sigma_m = noise[0] + z * (noise[1] + z * noise[2])
        if apart <= _SAME_M + _SAME_RATIO * z + _SAME_SIGMAS * sigma_m:
            same += 1
        elif apart <= _ELSEWHERE_M:
            beside += 1
            distance_m += apart
    return same, beside, distance_m
