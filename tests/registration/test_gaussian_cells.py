"""Scans placed in a map of Gaussians: small_gicp's voxelised GICP finds the same; old cells are dropped."""

import numpy as np
import pytest
import small_gicp

from mapper.core.geometry import apply, exp, inverse
from mapper.registration.gaussian_cells import GaussianCells
from mapper.registration.surfaces import prepared

CELL_M, VOXEL_M = 0.5, 0.25
STEPS = {"max_iterations": 30, "step_rad": 1e-4, "step_m": 1e-4}
MOTION = exp(np.array([0.02, -0.01, 0.03]), np.array([0.15, -0.1, 0.05]))


def room(rng, T_room_body=None, n=20_000):
    """The floor and four walls of a room of 12 m by 8 m, as seen from a pose in it."""
    u, v = rng.uniform(0.0, 1.0, (2, n))
    zero, one = np.zeros(n), np.ones(n)
    sides = [(u, v, zero), (u, zero, v), (u, one, v), (zero, u, v), (one, u, v)]
    points = np.concatenate([np.column_stack(side) for side in sides]) * [12.0, 8.0, 3.0] - [6.3, 4.1, 1.2]
    points += rng.normal(scale=0.01, size=points.shape)
    return points if T_room_body is None else apply(inverse(T_room_body), points)


@pytest.mark.parametrize("far", [0.0, 3000.0])
def test_a_scan_is_placed_where_small_gicp_places_it(far):
    rng = np.random.default_rng(3)
    first, second = room(rng), room(rng, MOTION)
    T_world_first = exp(np.array([0.0, 0.0, 1.0]), np.array([far, -far, 0.0]))
    cells, theirs = GaussianCells(CELL_M, kept_clouds=5), small_gicp.GaussianVoxelMap(CELL_M)
    cells.insert(prepared(first, voxel_m=VOXEL_M), T_world_first)
    theirs.insert(small_gicp.preprocess_points(first, VOXEL_M, 10, 1)[0], T_world_first)

    found = cells.align(prepared(second, voxel_m=VOXEL_M), T_world_first, **STEPS)
    peer = small_gicp.align(
        theirs,
        small_gicp.preprocess_points(second, VOXEL_M, 10, 1)[0],
        T_world_first,
        max_correspondence_distance=CELL_M,
        num_threads=1,
        translation_epsilon=1e-4,
        rotation_epsilon=1e-4,
    )

    assert np.abs(found - peer.T_target_source).max() < 2e-3
    miss = inverse(T_world_first @ MOTION) @ found
    assert np.linalg.norm(miss[:3, 3]) < 0.01


def test_cells_that_no_cloud_touched_for_long_are_dropped():
    rng = np.random.default_rng(5)
    here = prepared(room(rng, n=4000), voxel_m=VOXEL_M)
    there = exp(np.zeros(3), np.array([100.0, 0.0, 0.0]))
    cells = GaussianCells(CELL_M, kept_clouds=3)
    cells.insert(here, np.eye(4))
    alone = len(cells)
    for _ in range(8):
        cells.insert(here, there)
    assert len(cells) > alone
    cells.insert(here, there)  # the tenth cloud: cells are cleared in tens
    assert len(cells) <= alone + 200
    assert cells.align(here, np.eye(4), **STEPS) is None
    assert np.allclose(cells.align(here, there, **STEPS), there, atol=1e-3)


def test_a_scan_beside_the_map_has_no_place():
    cells = GaussianCells(CELL_M, kept_clouds=3)
    cloud = prepared(room(np.random.default_rng(6), n=2000), voxel_m=VOXEL_M)
    assert cells.align(cloud, np.eye(4), **STEPS) is None
