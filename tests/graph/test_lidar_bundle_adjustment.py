import numpy as np
import pytest

from mapper.core.geometry import apply, exp, inverse, log
from mapper.graph.lidar_bundle_adjustment import NodeClouds, adjust_planes, compare_thickness, find_surfaces
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas, PositionFactor
from mapper.graph.plane_kernels import Surfaces, linearise, times_eliminated

VOXEL_M = 0.2
SIGMAS = PoseSigmas(rotation_rad=0.005, translation_m=0.02)
FLOOR_M, ENOUGH = 0.01, 10.0


def room(rng, *, nodes=8, points=1500, noise_m=0.005):
    """Points of four walls, floor and ceiling in nodes that walk through it, and the true poses."""
    poses = np.array([exp([0.0, 0.0, 0.3 * k], [0.3 * k, 0.1 * k, 0.0]) for k in range(nodes)])
    clouds = []
    for T in poses:
        walls = rng.uniform([-4.0, -3.0, -1.5], [5.0, 4.0, 1.5], (points, 3))
        axis, side = rng.integers(3, size=points), rng.integers(2, size=points)
        limits = np.array([[-4.0, 5.0], [-3.0, 4.0], [-1.5, 1.5]])
        walls[np.arange(points), axis] = limits[axis, side] + rng.normal(0.0, noise_m, points)
        clouds.append(apply(inverse(T), walls))
    return NodeClouds(np.concatenate(clouds), np.repeat(np.arange(nodes), points)), poses


def drifted(poses, rng):
    """A graph of noisy steps between the poses, chained from the first."""
    graph = PoseGraph()
    graph.add_node(0, 0, poses[0])
    for k in range(1, len(poses)):
        error = exp(rng.normal(0, SIGMAS.rotation_rad, 3), rng.normal(0, SIGMAS.translation_m, 3))
        T = inverse(poses[k - 1]) @ poses[k] @ error
        graph.add_node(k, k, graph.T_world_node[k - 1] @ T)
        graph.add_factors([BetweenFactor(k - 1, k, T, SIGMAS.information)])
    return graph


def errors(poses, truth):
    """(K, 6) of the poses' rotation and translation."""
    return np.array([np.concatenate(log(inverse(a) @ b)) for a, b in zip(poses, truth, strict=True)])


@pytest.mark.parametrize("seed", range(3))
def test_poses_of_a_room_return_to_the_truth(seed):
    rng = np.random.default_rng(seed)
    clouds, truth = room(rng)
    graph = drifted(truth, rng)
    before = np.abs(errors(graph.poses, truth)).max(axis=0)

    adjusted = adjust_planes(graph, clouds, voxel_m=VOXEL_M)

    T_true_adjusted = truth[0] @ inverse(adjusted.poses[0])
    after = np.abs(errors(T_true_adjusted @ adjusted.poses, truth)).max(axis=0)
    assert before[3:].max() > 0.02
    assert after[:3].max() < 1.5e-3
    assert after[3:].max() < 4e-3
    np.testing.assert_allclose(adjusted.positions.mean(axis=0), graph.positions.mean(axis=0), atol=1e-9)


def test_what_no_surface_shows_stays_where_the_graph_has_it():
    """Over a bare floor x, y and the heading are the graph's."""
    rng = np.random.default_rng(0)
    clouds, truth = room(rng)
    graph = drifted(truth, rng)
    world = apply(
        np.eye(4),
        np.concatenate([apply(T, clouds.points_node[clouds.nodes == k]) for k, T in enumerate(truth)]),
    )
    floor = clouds[np.abs(world[:, 2] + 1.5) < 0.02]

    adjusted = adjust_planes(graph, floor, voxel_m=VOXEL_M).poses

    found = errors(truth[0] @ inverse(adjusted[0]) @ adjusted, truth)
    drift = errors(graph.poses, truth)
    np.testing.assert_allclose(found[:, 2:5], drift[:, 2:5], atol=4e-3)
    assert np.abs(found[:, [0, 1, 5]]).max() < 0.3 * np.abs(drift[:, [0, 1, 5]]).max()


def test_measured_positions_hold_the_whole():
    rng = np.random.default_rng(0)
    clouds, truth = room(rng)
    graph = drifted(truth, rng)
    graph.fixes = tuple(
        PositionFactor(k, np.zeros(3), T[:3, 3], np.eye(3) * 1e6) for k, T in enumerate(truth)
    )
    after = np.abs(errors(adjust_planes(graph, clouds, voxel_m=VOXEL_M).poses, truth)).max(axis=0)
    assert after[:3].max() < 2e-3
    assert after[3:].max() < 2e-3


def test_a_judge_of_other_points_tells_a_gain_from_none():
    rng = np.random.default_rng(1)
    clouds, truth = room(rng, points=4000)
    is_judge = np.arange(len(clouds.nodes)) % 2 == 1
    judge = clouds[is_judge]
    graph = drifted(truth, rng)
    adjusted = adjust_planes(graph, clouds[~is_judge], voxel_m=VOXEL_M)

    gain = compare_thickness(judge, graph.poses, adjusted.poses, voxel_m=VOXEL_M)
    loss = compare_thickness(judge, truth, graph.poses, voxel_m=VOXEL_M)
    none = compare_thickness(judge, truth, truth, voxel_m=VOXEL_M)

    assert gain.thinner_sigmas > 5.0
    assert gain.before_m > 1.5 * gain.after_m
    assert loss.thinner_sigmas < -5.0
    assert none.thinner_sigmas == 0.0


def test_the_two_faces_of_a_wall_are_two_surfaces():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(0.0, 1.0, (400, 2)), np.full(400, 0.45)])
    poses = np.array([exp(np.zeros(3), [0.5, 0.5, z]) for z in (2.0, 1.5, -2.0, -1.5)])
    points = [apply(inverse(T), wall + np.array([0.0, 0.0, 0.01 * (T[2, 3] > 0.0)])) for T in poses]
    clouds = NodeClouds(np.concatenate(points), np.repeat(np.arange(4), 400))

    surfaces = find_surfaces(clouds, poses, voxel_m=VOXEL_M)

    assert len(surfaces.origins_world) == 2
    assert surfaces.starts.tolist() == [0, 2, 4]
    assert linearise(surfaces, poses, FLOOR_M, ENOUGH).variances_m2.max() < 1e-9


def some_surfaces(*, noise_m):
    rng = np.random.default_rng(2)
    clouds, poses = room(rng, nodes=4, points=600, noise_m=noise_m)
    return find_surfaces(clouds, poses, voxel_m=VOXEL_M), poses


def moved(poses, tangents):
    return np.array([T @ exp(x[:3], x[3:]) for T, x in zip(poses, tangents, strict=True)])


def test_the_gradient_is_that_of_the_cost():
    surfaces, poses = some_surfaces(noise_m=0.02)
    found = linearise(surfaces, poses, FLOOR_M, ENOUGH).gradient
    for k, i in np.ndindex(found.shape):
        step = np.zeros((4, 6))
        step[k, i] = 1e-6
        up, down = (linearise(surfaces, moved(poses, s * step), FLOOR_M, ENOUGH).cost for s in (1, -1))
        assert found[k, i] == pytest.approx((up - down) / 2e-6, rel=1e-4, abs=0.05)


def hessian_of(surfaces, linearised, count):
    """The Hessian with free planes, column by column."""
    columns = []
    for unit in np.eye(6 * count):
        x = unit.reshape(count, 6)
        own = np.einsum("kij,kj->ki", linearised.own, x)
        columns.append((own - times_eliminated(surfaces, linearised, x)).ravel())
    return np.array(columns).T


def test_the_hessian_is_that_of_the_cost_where_surfaces_are_flat():
    every, poses = some_surfaces(noise_m=0.0)
    flat = np.flatnonzero(linearise(every, poses, FLOOR_M, ENOUGH).variances_m2 < 1e-12)
    sizes = np.diff(every.starts)
    of_flat = np.isin(np.repeat(np.arange(len(sizes)), sizes), flat)
    starts = np.concatenate([[0], np.cumsum(sizes[flat])])
    surfaces = Surfaces(starts, every.nodes[of_flat], every.moments[of_flat], every.origins_world[flat])
    found = hessian_of(surfaces, linearise(surfaces, poses, FLOOR_M, ENOUGH), 4)
    columns = []
    for unit in np.eye(24):
        step = 1e-6 * unit.reshape(4, 6)
        up, down = (linearise(surfaces, moved(poses, s * step), FLOOR_M, ENOUGH).gradient for s in (1, -1))
        columns.append((up - down).ravel() / 2e-6)
    np.testing.assert_allclose(found, np.array(columns).T, rtol=1e-3, atol=1e-5 * np.abs(found).max())


def test_the_kernels_agree_with_sums_over_the_points():
    """The reference fits a plane to each surface's points, and differentiates their distances from it."""
    rng = np.random.default_rng(3)
    poses = np.array([exp(rng.normal(0, 0.3, 3), rng.normal(0, 2.0, 3)) for _ in range(3)])
    clusters = [(0, 0), (0, 2), (1, 0), (1, 1), (1, 2)]  # (surface, node)
    clouds = [rng.normal(size=(12 + k, 3)) * [3.0, 2.0, 0.1] for k in range(len(clusters))]
    homogeneous = [np.column_stack([cloud, np.ones(len(cloud))]) for cloud in clouds]
    surfaces = Surfaces(
        np.array([0, 2, 5]),
        np.array([node for _, node in clusters]),
        np.array([p.T @ p for p in homogeneous]),
        rng.normal(size=(2, 3)),
    )
    found = linearise(surfaces, poses, FLOOR_M, ENOUGH)

    cost, hessian, gradient = 0.0, np.zeros((18, 18)), np.zeros(18)
    for s in range(2):
        of_surface = [k for k, (surface, _) in enumerate(clusters) if surface == s]
        points = np.concatenate([apply(poses[clusters[k][1]], clouds[k]) for k in of_surface])
        shares = np.concatenate(
            [np.full(len(clouds[k]), 1 / (1 + len(clouds[k]) / ENOUGH)) for k in of_surface]
        )
        mean = shares @ points / shares.sum()
        values, axes = np.linalg.eigh((shares[:, None] * (points - mean)).T @ (points - mean) / shares.sum())
        assert found.variances_m2[s] == pytest.approx(values[0], rel=1e-8)
        cost += 0.5 * shares.sum() * np.log(values[0] + FLOOR_M**2)
        distances = (points - mean) @ axes[:, 0]
        of_plane = np.column_stack([(points - mean) @ axes[:, 1:], np.ones(len(points))])
        of_nodes = np.zeros((len(points), 18))
        row = 0
        for k in of_surface:
            node = clusters[k][1]
            normal = poses[node][:3, :3].T @ axes[:, 0]
            rows = slice(row, row + len(clouds[k]))
            of_nodes[rows, 6 * node : 6 * node + 6] = np.column_stack(
                [np.cross(clouds[k], normal), np.tile(normal, (len(clouds[k]), 1))]
            )
            row += len(clouds[k])
        weighted = (shares / (values[0] + FLOOR_M**2))[:, None] * of_nodes
        across = weighted.T @ of_plane
        planes = of_plane.T @ ((shares / (values[0] + FLOOR_M**2))[:, None] * of_plane)
        hessian += weighted.T @ of_nodes - across @ np.linalg.solve(planes, across.T)
        gradient += weighted.T @ distances

    assert found.cost == pytest.approx(cost, rel=1e-10)
    np.testing.assert_allclose(found.gradient.ravel(), gradient, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(
        hessian_of(surfaces, found, 3), hessian, rtol=1e-6, atol=1e-9 * np.abs(hessian).max()
    )
