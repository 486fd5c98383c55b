from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera, ray_table
from mapper.core.geometry import apply, exp, inverse
from mapper.sensing.depth_registration import DepthRegistration

DEPTH = PinholeCamera(212, 120, 106.0, 107.0, 105.2, 60.3)
COLOR = PinholeCamera(160, 120, 155.0, 154.0, 80.4, 58.7, (0.1, -0.2, 0.001, -0.002, 0.05))
LARGE = PinholeCamera(480, 360, 466.0, 463.0, 241.2, 176.0)
SMALL = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)
D435 = exp(np.array([0.004, -0.007, 0.005]), np.array([0.015, 0.0002, 0.0003]))
KINECT = exp(np.array([0.003, 0.006, -0.004]), np.array([-0.025, 0.0005, -0.001]))
L515 = exp(np.array([-0.004, 0.003, 0.006]), np.array([-0.0005, 0.0139, -0.0036]))
FACING, TILTED, GRAZING = (0.0, 0.0, 1.0, 2.0), (0.5, -0.3, 1.0, 2.0), (0.0, 1.0, 0.05, 0.9)


def depth_of(camera, T_color_camera, *surfaces):
    """Exact depth of planes (n · x = h in the colour camera's frame, maybe within x limits), in a camera."""
    T_camera_color = inverse(T_color_camera)
    R, origin = T_color_camera[:3, :3], T_color_camera[:3, 3]
    rays = np.dstack([ray_table(camera).astype(float), np.ones((camera.height_px, camera.width_px))]) @ R.T
    nearest_m = np.full(rays.shape[:2], np.inf)
    for *normal, h, low, high in surfaces:
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (h - np.dot(normal, origin)) / (rays @ normal)
            points = origin + rays * along[..., None]
        z = apply(T_camera_color, points.reshape(-1, 3))[:, 2].reshape(along.shape)
        hit = (along > 0.0) & (points[..., 0] >= low) & (points[..., 0] <= high) & (z < 8.0)
        nearest_m = np.where(hit & (z < nearest_m), z, nearest_m)
    return np.where(np.isfinite(nearest_m), nearest_m, 0.0).astype(np.float32)


def everywhere(plane):
    return (*plane, -np.inf, np.inf)


def reference(depth_m, depth_camera, camera, T):
    """The registration pixel by pixel, in double precision."""
    rays = ray_table(depth_camera).astype(float)
    rows, columns = np.nonzero(depth_m > 0.0)
    z = depth_m[rows, columns].astype(float)
    points = apply(T, np.column_stack([rays[rows, columns] * z[:, None], z]))
    pixels = np.full((*depth_m.shape, 2), np.nan)
    depths = np.zeros(depth_m.shape)
    limit = 1.1 * (ray_table(camera).astype(float) ** 2).sum(axis=2).max()
    seen = (points[:, 2] > 0.5 * z) & ((points[:, :2] / points[:, 2:]) ** 2).sum(axis=1).__le__(limit)
    rows, columns, points = rows[seen], columns[seen], points[seen]
    pixels[rows, columns] = camera.distort(camera.project(points))
    depths[rows, columns] = points[:, 2]
    spacing = np.array([camera.fx_px / depth_camera.fx_px, camera.fy_px / depth_camera.fy_px])
    found = np.full((camera.height_px, camera.width_px), np.inf)
    for i, j in zip(rows, columns, strict=True):
        usual = spacing * depth_m[i, j] / depths[i, j]
        ends = []
        for axis, (a, b) in ((0, (0, 1)), (1, (1, 0))):
            for sign in (-1, 1):
                n, m = i + sign * a, j + sign * b
                half = 0.5 * usual[axis]
                if 0 <= n < depth_m.shape[0] and 0 <= m < depth_m.shape[1] and depths[n, m] > 0.0:
                    step = sign * (pixels[n, m] - pixels[i, j])[axis]
                    # Between two pixels of a row the left one's spacing counts.
                    own = (n, m) if axis == 0 and sign < 0 else (i, j)
                    most = 1.5 * spacing[axis] * depth_m[own] / depths[own]
                    half = 0.5 * step if 0.0 < step <= most else half
                ends.append(pixels[i, j, axis] + sign * half)
        left, right, top, bottom = ends
        inside = np.s_[
            max(int(np.floor(top)) + 1, 0) : max(int(np.floor(bottom)) + 1, 0),
            max(int(np.floor(left)) + 1, 0) : max(int(np.floor(right)) + 1, 0),
        ]
        found[inside] = np.minimum(found[inside], depths[i, j])
    return np.where(np.isfinite(found), found, 0.0)


def register(depth_m, depth_camera, camera, T):
    return DepthRegistration(ray_table(depth_camera), camera, T).register(depth_m)


@pytest.mark.parametrize("T", [D435, KINECT, L515], ids=["d435", "kinect", "l515"])
@pytest.mark.parametrize("camera", [COLOR, LARGE, SMALL], ids=["color", "large", "small"])
def test_the_kernel_does_what_a_loop_over_pixels_does(camera, T):
    rng = np.random.default_rng(5)
    depth_m = depth_of(DEPTH, T, everywhere(TILTED), (*FACING[:3], 1.1, -0.3, 0.2))
    depth_m *= 1.0 + 0.01 * rng.standard_normal(depth_m.shape).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.1] = 0.0
    found, wanted = register(depth_m, DEPTH, camera, T), reference(depth_m, DEPTH, camera, T)
    # A projection that lies on a pixel's centre is rounded to either side.
    assert np.isclose(found, wanted, rtol=1e-5).mean() > 0.999
    assert found.dtype == np.float32


@pytest.mark.parametrize("T", [D435, KINECT, L515], ids=["d435", "kinect", "l515"])
@pytest.mark.parametrize("camera", [COLOR, LARGE, SMALL], ids=["color", "large", "small"])
@pytest.mark.parametrize("plane", [FACING, TILTED, GRAZING], ids=["facing", "tilted", "grazing"])
def test_a_plane_has_the_depth_that_the_other_camera_would_measure(plane, camera, T):
    found = register(depth_of(DEPTH, T, everywhere(plane)), DEPTH, camera, T)
    exact = depth_of(camera, np.eye(4), everywhere(plane))
    measured = found > 0.0
    seen = (exact > 0.0) & (exact < 7.0)
    seen[:3] = seen[-3:] = seen[:, :3] = seen[:, -3:] = False
    assert measured[seen].mean() > 0.999
    # The sample is within half a pixel of depth along both axes; inverse depth is linear in these.
    slope = np.abs(plane[0]) / DEPTH.fx_px + np.abs(plane[1]) / DEPTH.fy_px
    error = np.abs(1.0 / found[seen & measured] - 1.0 / exact[seen & measured])
    assert error.max() < 0.55 * 1.1 * slope / plane[3] + 1e-3
    bias = np.mean(1.0 / found[seen & measured] - 1.0 / exact[seen & measured])
    assert abs(bias) < 0.06 * slope / plane[3] + 1e-4


@pytest.mark.parametrize("T", [D435, KINECT], ids=["d435", "kinect"])
@pytest.mark.parametrize("camera", [COLOR, LARGE, SMALL], ids=["color", "large", "small"])
@pytest.mark.parametrize("near", [(0.0, 0.0, 1.0, 0.6), (0.6, 0.0, 1.0, 0.6)], ids=["facing", "slanted"])
def test_nothing_shines_through_a_near_surface_and_no_step_is_bridged(near, camera, T):
    scene = (everywhere(FACING), (*near, -0.15, 0.1))
    found = register(depth_of(DEPTH, T, *scene), DEPTH, camera, T)
    exact = depth_of(camera, np.eye(4), *scene)
    is_near = exact < 1.5
    # One pixel of depth at either edge of the near surface may belong to the other.
    reach = int(np.ceil(camera.fx_px / DEPTH.fx_px)) + 1
    inner, outer = is_near.copy(), is_near.copy()
    for shift in range(1, reach + 1):
        inner &= np.roll(is_near, shift, axis=1) & np.roll(is_near, -shift, axis=1)
        outer |= np.roll(is_near, shift, axis=1) | np.roll(is_near, -shift, axis=1)
    assert inner.sum() > 300
    assert (found[inner] > 0.0).mean() > 0.999
    assert found[inner].max() < 1.2
    assert not ((found > 1.2) & (found < 1.9)).any()
    assert not ((found > 0.0) & (found < 1.2) & ~outer).any()
    # Background that only colour sees, beside the near surface, is as wide as the parallax: not measured.
    hidden_px = camera.fx_px * abs(T[0, 3]) * (1.0 / 0.6 - 1.0 / 2.0)
    empty_px = (found == 0.0)[camera.height_px // 2 - 5 : camera.height_px // 2 + 5].sum(axis=1).mean()
    assert empty_px == pytest.approx(hidden_px, abs=1.5 * reach)


def test_the_same_camera_gives_the_same_image():
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(0.4, 6.0, (120, 160)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.2] = 0.0
    camera = PinholeCamera(160, 120, 155.0, 154.0, 80.4, 58.7)
    np.testing.assert_array_equal(register(depth_m, camera, camera, np.eye(4)), depth_m)


def test_what_lies_outside_the_view_is_not_led_back_into_it_by_the_lens():
    folding = PinholeCamera(160, 120, 155.0, 154.0, 80.4, 58.7, (-0.6, 0.0, 0.0, 0.0, 0.0))
    wide = PinholeCamera(212, 120, 50.0, 50.0, 105.5, 59.5)  # sees 65° to the side, colour 27°
    sides = depth_of(wide, np.eye(4), everywhere(FACING))
    sides[:, 40:172] = 0.0
    assert not register(sides, wide, folding, np.eye(4)).any()


def test_points_behind_the_other_camera_are_not_seen():
    T = np.eye(4)
    T[2, 3] = -1.0
    for near_m in (0.5, 1.001):
        assert not register(np.full((120, 212), near_m, np.float32), DEPTH, COLOR, T).any()
    assert not register(np.zeros((120, 212), np.float32), DEPTH, COLOR, T).any()


def test_other_sizes_and_other_motions_are_refused():
    with pytest.raises(DataError):
        register(np.zeros((120, 160), np.float32), DEPTH, COLOR, D435)
    with pytest.raises(DataError):
        DepthRegistration(ray_table(DEPTH), COLOR, 2.0 * np.eye(4))
    with pytest.raises(DataError):
        DepthRegistration(ray_table(replace(DEPTH, fx_px=1.0)), COLOR, D435)
