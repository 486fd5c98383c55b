"""Alignment of depth images on exact planes: right where they observe the motion, and they say where not."""

import numpy as np
import pytest

from mapper.core.geometry import angle_between, apply, exp, inverse
from mapper.odometry.camera.depth_surfaces import depth_cells, surface_of
from mapper.odometry.keyframes.depth_alignment import Landmarks, align_depth, observes_all
from tests.support.depth_rooms import CAMERA, CORNER, box_depth

ROOM, WALL_ONLY = (1.6, 2.1, 1.3), (50.0, 1.5, 50.0)
FACING_A_WALL = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
INTRINSICS = np.array([CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px, 40.0])
NO_LANDMARKS = Landmarks(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), INTRINSICS)


def cells_of(T_world_camera, half_m, rng=None):
    depth_m = box_depth(T_world_camera, half_m)
    if rng is not None:
        depth_m = depth_m + (0.003 * depth_m**2 * rng.standard_normal(depth_m.shape)).astype(np.float32)
    return depth_cells(depth_m, CAMERA)


def aligned(target, T_target, source, *, guess, landmarks=NO_LANDMARKS, sigma=0.05):
    return align_depth(
        source,
        source.points(),
        [surface_of(target)],
        [inverse(T_target)],
        keyframes=1,
        T_camera_world=inverse(guess),
        T_prior=inverse(guess),
        prior=np.eye(6) / sigma**2,
        landmarks=landmarks,
        noise=None,
    )


def moved(T, rng, *, metres=0.05, radians=0.05):
    return T @ exp(rng.normal(0.0, radians, 3), rng.normal(0.0, metres, 3))


def error_m(alignment, truth):
    return float(np.linalg.norm((alignment.T_camera_world @ truth)[:3, 3]))


def test_planes_are_those_of_the_walls():
    cells = cells_of(CORNER, ROOM)
    surface = surface_of(cells)
    fitted = surface.planes[..., 3] > 0.0
    assert fitted.mean() > 0.6
    normals_world = surface.planes[fitted][:, :3] @ CORNER[:3, :3].T
    assert np.abs(normals_world).max(axis=1).min() > 0.999
    points = np.dstack([cells.rays, np.ones(cells.rays.shape[:2])]) / cells.inverse_depth[..., None]
    offsets_m = (
        np.einsum("ni,ni->n", points[fitted], surface.planes[fitted][:, :3]) - surface.planes[fitted][:, 3]
    )
    assert np.abs(offsets_m).max() < 1e-3


def test_edges_and_holes_have_no_surface():
    depth_m = np.full((120, 160), 2.0, np.float32)
    depth_m[:, 81:] = 1.0
    depth_m[:40] = 0.0
    cells = depth_cells(depth_m, CAMERA)
    assert (cells.inverse_depth[:20] == 0.0).all()
    assert (cells.inverse_depth[20:, 40] == 0.0).all()
    assert np.allclose(cells.inverse_depth[20:, :40], 0.5)
    assert np.allclose(cells.inverse_depth[20:, 41:], 1.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_corner_gives_the_whole_motion(seed):
    rng = np.random.default_rng(seed)
    truth = moved(CORNER, rng)

    found = aligned(cells_of(CORNER, ROOM, rng), CORNER, cells_of(truth, ROOM, rng), guess=CORNER)

    assert found.unobservable == ""
    assert error_m(found, truth) < 0.006
    assert angle_between(inverse(found.T_camera_world)[:3, :3], truth[:3, :3]) < 0.004
    assert found.agreeing_ratio > 0.95
    sigma_m = np.sqrt(np.linalg.inv(found.information)[3:, 3:].diagonal())
    assert (sigma_m > 1e-4).all()
    assert (sigma_m < 0.01).all()


def test_a_bare_wall_leaves_three_motions_to_the_prediction():
    rng = np.random.default_rng(0)
    truth = FACING_A_WALL @ exp(np.zeros(3), np.array([0.08, 0.0, 0.06]))
    guess = FACING_A_WALL @ exp(np.zeros(3), np.array([0.03, 0.0, 0.0]))

    found = aligned(
        cells_of(FACING_A_WALL, WALL_ONLY, rng), FACING_A_WALL, cells_of(truth, WALL_ONLY, rng), guess=guess
    )

    assert found.unobservable == "translation along x and y, rotation about z"
    position = inverse(found.T_camera_world)[:3, 3]
    assert position[1] == pytest.approx(0.06, abs=0.003)  # towards the wall: measured
    assert position[0] == pytest.approx(0.03, abs=0.003)  # along it: as predicted
    sigma_m = np.sqrt(np.linalg.inv(found.information)[3:, 3:].diagonal())
    assert sigma_m[0] == pytest.approx(0.05, rel=0.2)  # as sure as the prediction
    assert sigma_m[2] < 0.01


def test_landmarks_decide_what_a_wall_does_not_show():
    rng = np.random.default_rng(1)
    truth = FACING_A_WALL @ exp(np.array([0.0, 0.0, 0.03]), np.array([0.08, -0.04, 0.06]))
    on_wall = np.column_stack([rng.uniform(-0.6, 0.6, 12), np.full(12, 1.5), rng.uniform(-0.5, 0.5, 12)])
    seen = apply(inverse(truth), on_wall)
    pixels = seen[:, :2] / seen[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:4] + rng.normal(0.0, 0.3, (12, 2))
    measured = np.column_stack([pixels, INTRINSICS[4] / seen[:, 2]])
    landmarks = Landmarks(on_wall, measured, np.ones((12, 3)), INTRINSICS)

    found = aligned(
        cells_of(FACING_A_WALL, WALL_ONLY, rng),
        FACING_A_WALL,
        cells_of(truth, WALL_ONLY, rng),
        guess=FACING_A_WALL,
        landmarks=landmarks,
        sigma=0.5,
    )

    assert found.unobservable == ""
    assert found.is_landmark_inlier.all()
    assert error_m(found, truth) < 0.005


def test_only_a_view_with_surfaces_all_around_observes_all():
    rng = np.random.default_rng(2)
    assert observes_all(surface_of(cells_of(CORNER, ROOM, rng)))
    assert not observes_all(surface_of(cells_of(FACING_A_WALL, WALL_ONLY, rng)))
    corridor = FACING_A_WALL @ exp(np.array([0.0, 0.7, 0.0]), np.zeros(3))
    assert not observes_all(surface_of(cells_of(corridor, (30.0, 1.2, 30.0), rng)))
    assert not observes_all(surface_of(depth_cells(np.zeros((120, 160), np.float32), CAMERA)))


def test_a_thing_before_the_walls_contradicts_the_keyframe():
    cells = cells_of(CORNER, ROOM)
    covered = box_depth(CORNER, ROOM)
    covered[30:, 40:] = 0.5

    found = aligned(cells, CORNER, depth_cells(covered, CAMERA), guess=CORNER)

    assert found.contradicting_ratio == pytest.approx(0.55, abs=0.1)
    assert found.agreeing_ratio < 0.5


def test_a_surface_that_is_gone_contradicts_the_keyframe_too():
    covered = box_depth(CORNER, ROOM)
    covered[30:, 40:] = 0.5

    found = aligned(depth_cells(covered, CAMERA), CORNER, cells_of(CORNER, ROOM), guess=CORNER)

    assert found.contradicting_ratio > 0.4


def test_what_the_keyframe_could_not_see_contradicts_nothing():
    """The camera moves sideways past a post, and sees what was behind it."""
    rng = np.random.default_rng(4)
    truth = CORNER @ exp(np.zeros(3), np.array([0.1, 0.0, 0.0]))

    def with_post(T_world_camera, column):
        depth_m = box_depth(T_world_camera, ROOM)
        depth_m += (0.003 * depth_m**2 * rng.standard_normal(depth_m.shape)).astype(np.float32)
        depth_m[:, column : column + 24] = 0.9
        return depth_cells(depth_m, CAMERA)

    shift_px = round(0.1 * CAMERA.fx_px / 0.9)
    found = aligned(with_post(CORNER, 60), CORNER, with_post(truth, 60 - shift_px), guess=truth)

    assert found.contradicting_ratio < 0.05
    assert found.weakest_ratio > 0.9
    assert found.visible_ratio < 0.85
    assert error_m(found, truth) < 0.006
