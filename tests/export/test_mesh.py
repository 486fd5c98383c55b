import numpy as np
import pytest

from mapper.config.build import MeshConfig
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan, ray_table
from mapper.core.geometry import apply, inverse, transform
from mapper.core.rotations import rotation_from_euler
from mapper.export.mesh import Volume, as_mapped, in_order, rectified
from mapper.mapping.config import Edits, Region
from mapper.mapping.edits import MapEditor
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap

FR1 = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
NORMAL_WORLD, OFFSET_M = np.array([0.28, 0.0, 0.96]), 1.0
POSES = [
    transform(rotation_from_euler(0.1 * i, -0.05 * i, 0.2 * i), np.array([0.05 * i, -0.03 * i, 0.02 * i]))
    for i in range(3)
]


def frame_of_a_plane(T_world_camera, *, distortion):
    """See the plane n·p = d through a real lens: red where x < 0.1 m, blue beyond."""
    camera = PinholeCamera(320, 240, 260.0, 260.0, 160.2, 118.7, distortion)
    rays = ray_table(camera).astype(np.float64)
    rays_camera = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2).reshape(-1, 3)
    normal_camera = T_world_camera[:3, :3].T @ NORMAL_WORLD
    depth_m = (OFFSET_M - NORMAL_WORLD @ T_world_camera[:3, 3]) / (rays_camera @ normal_camera)
    is_left = apply(T_world_camera, rays_camera * depth_m[:, None])[:, 0] < 0.1
    image = np.where(is_left[:, None], [255, 0, 0], [0, 0, 255]).astype(np.uint8)
    return RgbdFrame(0, image.reshape(240, 320, 3), depth_m.astype(np.float32).reshape(240, 320), camera)


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0, 0.0), FR1], ids=["ideal", "fr1"])
def test_the_surface_of_a_plane_is_the_plane(distortion):
    o3d = pytest.importorskip("open3d", reason="the mesh extra is not installed", exc_type=ImportError)
    volume = Volume(o3d, MeshConfig(voxel_m=0.02, min_observations=1), max_depth_m=4.0, blocks=100)
    for T_world_camera in POSES:
        volume.add(rectified(frame_of_a_plane(T_world_camera, distortion=distortion), T_world_camera))

    surface = volume.surface()

    points = surface.points_world.astype(np.float64)
    assert np.percentile(np.abs(points @ NORMAL_WORLD - OFFSET_M), 95) < 0.003  # metres
    a, b, c = np.moveaxis(points[surface.triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    facing = -normals @ NORMAL_WORLD / np.linalg.norm(normals, axis=1).clip(1e-12)
    assert np.mean(facing > 0.9) > 0.95  # towards the cameras

    is_left = surface.colors[:, 0] > 128
    away = np.abs(points[:, 0] - 0.1) > 0.04
    np.testing.assert_array_equal(is_left[away], points[away, 0] < 0.1)


def test_rectifying_moves_pixels_to_where_an_ideal_camera_has_them():
    frame = frame_of_a_plane(np.eye(4), distortion=FR1)
    view = rectified(frame, np.eye(4))
    ideal = frame_of_a_plane(np.eye(4), distortion=(0.0, 0.0, 0.0, 0.0, 0.0))

    inner = (slice(20, -20), slice(20, -20))
    pixel_m = np.abs(np.gradient(ideal.depth_m, axis=1))[inner]
    assert (np.abs(view.depth_m - ideal.depth_m)[inner] < 0.6 * pixel_m).all()  # half a pixel: the nearest
    assert (np.abs(frame.depth_m - ideal.depth_m)[inner] > 4.0 * pixel_m).any()


def test_the_order_of_vertices_and_triangles_does_not_matter():
    rng = np.random.default_rng(0)
    points = rng.integers(0, 3, (40, 3)).astype(np.float32)  # with equal vertices among them
    colors = rng.integers(0, 2, (40, 3)).astype(np.uint8)
    triangles = rng.permuted(np.tile(np.arange(40, dtype=np.int32), (60, 1)), axis=1)[:, :3]
    shuffle = rng.permutation(40)
    turned = np.roll(np.argsort(shuffle).astype(np.int32)[rng.permutation(triangles)], 1, axis=1)

    ours, theirs = in_order(points, colors, triangles), in_order(points[shuffle], colors[shuffle], turned)

    for name in ("points_world", "colors", "triangles"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert len(np.unique(np.hstack([ours.points_world, ours.colors]), axis=0)) == len(ours.points_world)


def test_the_pose_of_the_camera_on_the_body_counts():
    T_body_camera = POSES[2]
    frame = frame_of_a_plane(np.eye(4), distortion=FR1)
    mounted = RgbdFrame(0, frame.image, frame.depth_m, frame.camera, T_body_camera)

    view = rectified(mounted, inverse(T_body_camera))

    np.testing.assert_allclose(view.T_world_camera, np.eye(4), atol=1e-12)


def test_depth_of_what_the_octree_does_not_have_is_left_out():
    T_world_camera = POSES[1]
    wall = frame_of_a_plane(T_world_camera, distortion=FR1)
    octree = OctreeMap(OctreeConfig(resolution_m=0.05))
    octree.insert(Scan(0, wall.scan().points_body), T_world_camera)
    depth_m = wall.depth_m.copy()
    depth_m[80:120, 100:200] *= 0.6  # who passes before the wall
    depth_m[:20] = np.nan
    passed = RgbdFrame(0, wall.image, depth_m, wall.camera)

    kept_m = as_mapped(passed, T_world_camera, octree, editor()).depth_m

    expected_m = wall.depth_m.copy()
    expected_m[80:120, 100:200] = expected_m[:20] = 0.0
    np.testing.assert_array_equal(kept_m, expected_m)


def editor(**regions):
    return MapEditor(Edits(**regions), np.zeros((1, 3)), room_m=0.0)


@pytest.mark.parametrize("kind", ["erase", "keep"])
def test_depth_that_was_edited_away_is_left_out(kind):
    T_world_camera = POSES[1]
    frame = frame_of_a_plane(T_world_camera, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
    octree = OctreeMap(OctreeConfig(resolution_m=0.05))
    octree.insert(frame.scan(), T_world_camera)
    rays = np.concatenate([ray_table(frame.camera), np.ones((240, 320, 1))], axis=2).astype(np.float64)
    x = apply(T_world_camera, (rays * frame.depth_m[..., None]).reshape(-1, 3))[:, 0].reshape(240, 320)
    region = Region(box_m=((0.1, -9.0, -9.0), (9.0, 9.0, 9.0)))

    kept_m = as_mapped(frame, T_world_camera, octree, editor(**{kind: (region,)})).depth_m

    sure = np.abs(x - 0.1) > 1e-4
    left = (x > 0.1) == (kind == "keep")
    assert 1000 < np.count_nonzero(left) < left.size - 1000
    np.testing.assert_array_equal(kept_m[sure], np.where(left, frame.depth_m, 0.0)[sure])
