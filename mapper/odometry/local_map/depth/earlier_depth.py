"""Comparison of a depth image with those of earlier keyframes: what has moved since, and what lies elsewhere.

What stands where an earlier image saw through has moved there, whatever its features show. And the surfaces
of a scene that stands still lie where they lay: if many do not, the pose is that of a moving object.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Points, Transform
from mapper.core.linear import turned
from mapper.core.timebase import NS_PER_S
from mapper.odometry.local_map.depth.depth_kernels import between, cell_of, place_in_cells
from mapper.odometry.local_map.landmarks.landmark_map import LandmarkMap
from mapper.odometry.local_map.observation.depth_surfaces import DepthCells
from mapper.odometry.local_map.observation.image_observation import ImageObservation
from mapper.sensing.config import KINECT_NOISE, DepthNoiseConfig

_APART_S, _OLDER, _MOST = 0.4, 1.5, 10
"""Age of the first keyframe that is compared: a pedestrian moves on by their own width in it. Each further
one is so many times as old, up to 15 s: someone who has stopped is found as well."""
_MARGIN_M, _MARGIN_SIGMAS, _MARGIN_RATIO = 0.1, 4.0, 0.02
"""Least distance in front of a surface of what has moved: more than the errors of poses, noise and scale."""
_MOST_MOVED_RATIO = 0.6
"""When more of the surfaces has moved it was the camera, and the pose is wrong."""
_SAME_M, _SAME_SIGMAS, _SAME_RATIO = 0.02, 3.0, 0.01
"""Surfaces that are no farther apart are the same."""
_SMOOTH = 1.1
"""Largest ratio of neighbouring cells' depths on one surface."""
_UNSYNCHRONISED_S = 0.03
"""Largest time between the depth and the colour of a pixel: images up to 20 ms apart are paired, and rows are
read up to half a readout from the stamp. Meanwhile the surfaces shift before a moving camera."""
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
        since_s: Age of the earlier image; 0 if too little of the frame is in one.
        far_ratio: Share of the farther half of the compared points.
    """

    ratio: float = 0.0
    distance_m: float = 0.0
    since_s: float = 0.0
    far_ratio: float = 0.0


class EarlierDepth:
    """Comparison of frames with the depth images of keyframes that are 0.4 to 15 s older."""

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
            reference: Keyframe of the same place; it and those before it are compared.
            points_camera: (N, 3) metres, camera frame; None are the frame's features.
        """
        points = observation.points_camera if points_camera is None else points_camera
        cells, earlier = observation.depth_cells, self._earlier(observation, reference, most=_MOST)
        if cells is None or not earlier:
            return np.zeros(len(points), np.bool_)
        before = (
            np.array([_cells_of(self._map, k).inverse_depth for k in earlier]),
            np.array([self._map.keyframes[k].T_camera_world for k in earlier]),
            _DepthCamera(cells.camera.parameters, cells.cell_px, self._noise),
        )
        moved: NDArray[np.bool_] = _in_free_space(points, T_camera_world, *before)
        if moved.sum() <= _MOST_MOVED_RATIO * (~np.isnan(points[:, 2])).sum():
            return moved
        # Most features may be on one person with a patterned shirt, so the surfaces are tested.
        if _in_free_space(cells.points(), T_camera_world, *before).mean() > _MOST_MOVED_RATIO:
            moved[:] = False
        return moved

    def displacement(
        self,
        observation: ImageObservation,
        T_camera_world: Transform,
        reference: int,
        twist_camera: Array | None,
        is_moving: NDArray[np.bool_] | None = None,
    ) -> Displacement:
        """Return how much of the depth image lies elsewhere than 0.4 s before.

        Args:
            observation: The frame.
            T_camera_world: (4, 4) its pose.
            reference: Keyframe of the same place; the newest up to it that is old enough is compared.
            twist_camera: (6,) velocity of the camera in its own axes, rad/s and m/s; None if it is unknown.
            is_moving: (C,) cells of the depth image that are left out; None leaves out none.
        """
        earlier = self._earlier(observation, reference, most=1)
        if observation.depth_cells is None or not earlier:
            return Displacement()
        keyframe, cells = self._map.keyframes[earlier[0]], observation.depth_cells
        points = cells.points()
        if is_moving is not None:
            points = points[~is_moving]
        twists = [np.zeros(6)] * 2 if twist_camera is None else [twist_camera, keyframe.twist_camera]
        compared, beside_m = _apart(
            points,
            T_camera_world,
            _cells_of(self._map, earlier[0]).inverse_depth,
            keyframe.T_camera_world,
            _DepthCamera(cells.camera.parameters, cells.cell_px, self._noise),
            *(_UNSYNCHRONISED_S * twist for twist in twists),
        )
        is_beside = beside_m > 0.0
        if not len(compared) or len(compared) < _MIN_COMPARED_RATIO * len(points):
            return Displacement()
        depths_m = points[compared, 2]
        return Displacement(
            float(is_beside.mean()),
            float(beside_m.sum() / max(int(is_beside.sum()), 1)),
            (observation.stamp_ns - keyframe.stamp_ns) / NS_PER_S,
            float(is_beside[depths_m >= np.median(depths_m)].mean()),
        )

    def _earlier(self, observation: ImageObservation, reference: int, *, most: int) -> list[int]:
        """Return keyframes of the same sub-map and camera, 0.4 s old and older, fewer of the oldest."""
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
            latest_ns = observation.stamp_ns - round(_OLDER * (observation.stamp_ns - there.stamp_ns))
        return earlier


def hidden_points(
    observation: ImageObservation, T_camera_world: Transform, points_world: Points
) -> NDArray[np.bool_]:
    """Return (N,) which points lie behind what a frame's depth image shows there; none without one."""
    cells = observation.depth_cells
    if cells is None:
        return np.zeros(len(points_world), np.bool_)
    hidden: NDArray[np.bool_] = _behind(
        points_world, T_camera_world, cells.inverse_depth, cells.camera.parameters, cells.cell_px
    )
    return hidden


def _cells_of(landmark_map: LandmarkMap, keyframe: int) -> DepthCells:
    cells = landmark_map.observation(keyframe).depth_cells
    assert cells is not None
    return cells


class _DepthCamera(NamedTuple):
    """Camera of depth images: (9,) as ``PlaneModel.optics``, cells' edge, (3,) a, b, c of a + b·z + c·z²."""

    optics: Array
    cell_px: int
    noise: Array


@njit(cache=True, nogil=True)
def _in_free_space(points, T_camera_world, inverse_depth, T_keyframes_world, camera):  # type: ignore[no-untyped-def]
    """Return (N,) which points lie in front of all nine cells about the one that a keyframe sees them in."""
    optics, cell_px, noise = camera
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
def _behind(points, T, inverse_depth, optics, cell_px):  # type: ignore[no-untyped-def]
    """Return (N,) which points lie behind all nine cells about the one that a camera has them in."""
    hidden = np.zeros(len(points), np.bool_)
    shape = inverse_depth.shape
    for n in range(len(points)):
        line, column, z = cell_of(T, points[n], optics, cell_px, shape)
        if line < 1 or column < 1 or line >= shape[0] - 1 or column >= shape[1] - 1:
            continue
        least = inverse_depth[line - 1 : line + 2, column - 1 : column + 2].min()
        hidden[n] = least > 0.0 and z - 1.0 / least > _MARGIN_M + _MARGIN_RATIO * z
    return hidden


@njit(cache=True, nogil=True)
def _apart(  # type: ignore[no-untyped-def]
    points, T_camera_world, inverse_depth, T_keyframe_world, camera, motion, keyframe_motion
):
    """Return (M,) which points lie on a keyframe's surfaces or beside them, and how far beside; 0 is on them.

    The inverse depth of a plane is linear in the image, so it is interpolated between the cells' middles.
    ``motion`` and ``keyframe_motion`` (6,) are the cameras' own in the time by which their depth may be late.
    """
    optics, cell_px, noise = camera
    T = between(T_keyframe_world, T_camera_world)
    rows, columns = inverse_depth.shape
    compared = np.empty(len(points), np.intp)
    beside_m = np.zeros(len(points))
    count = 0
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
        inverse = (1.0 - s) * upper + s * lower
        apart = abs(z - 1.0 / inverse)
        sigma_m = noise[0] + z * (noise[1] + z * noise[2])
        if apart > _ELSEWHERE_M:
            continue
        same_m = _SAME_M + _SAME_RATIO * z + _SAME_SIGMAS * sigma_m
        if apart > same_m:
            there = turned(T, points[n]) + T[:3, 3]
            shift = turned(T, _shift(motion, points[n])) - _shift(keyframe_motion, there)
            # A plane n · p = 1 that is shifted lies 1 + n · shift times as far off along each ray.
            nx = ((1.0 - s) * (b - a) + s * (d - c)) * optics[0] / cell_px
            ny = (lower - upper) * optics[1] / cell_px
            nz = inverse - (nx * there[0] + ny * there[1]) / z
            if apart > same_m + abs(nx * shift[0] + ny * shift[1] + nz * shift[2]) / inverse:
                beside_m[count] = apart
        compared[count] = n
        count += 1
    return compared[:count], beside_m[:count]


@njit(cache=True, nogil=True)
def _shift(motion, point):  # type: ignore[no-untyped-def]
    """Return (3,) by how much a small motion of the camera, (6,) rotation and translation, shifts a point."""
    shift = np.empty(3)
    shift[0] = motion[3] + motion[1] * point[2] - motion[2] * point[1]
    shift[1] = motion[4] + motion[2] * point[0] - motion[0] * point[2]
    shift[2] = motion[5] + motion[0] * point[1] - motion[1] * point[0]
    return shift
