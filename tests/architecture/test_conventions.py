"""The conventions of docs/architecture.md, a test each: what a number means is nowhere a matter of taste."""

import gtsam
import numpy as np
import pytest

from mapper.core.back_projection import back_project
from mapper.core.deskew import Twist, deskewed
from mapper.core.frames import PinholeCamera, Scan, ray_table
from mapper.core.geometry import adjoint, apply, exp, inverse, log, rotation_exp, transform
from mapper.core.rotations import row_of_pose
from mapper.core.trajectory import Trajectory
from mapper.graph.g2o import write_g2o
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.octree.config import OctreeConfig
from mapper.octree.grid import OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.octree.map import OctreeMap
from mapper.sources.trajectory_files import write_tum

QUARTER_TURN = transform(rotation_exp(np.array([0.0, 0.0, np.pi / 2.0])), np.array([1.0, 2.0, 3.0]))


def test_a_transform_maps_points_of_its_second_frame_to_its_first():
    np.testing.assert_allclose(apply(QUARTER_TURN, np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]])


def test_quaternions_end_in_w(tmp_path):
    half = np.sqrt(0.5)
    np.testing.assert_allclose(row_of_pose(QUARTER_TURN), [1.0, 2.0, 3.0, 0.0, 0.0, half, half], atol=1e-12)
    path = tmp_path / "poses.tum"
    write_tum(path, Trajectory(np.array([1_500_000_000]), QUARTER_TURN[np.newaxis]))
    numbers = [float(word) for word in path.read_text().splitlines()[-1].split()]
    np.testing.assert_allclose(numbers, [1.5, 1.0, 2.0, 3.0, 0.0, 0.0, half, half], atol=1e-6)


def test_tangents_are_rotation_before_translation_on_the_right_as_gtsam_s():
    tangent = np.array([0.1, -0.2, 0.3, 1.0, 2.0, -1.0])
    T = exp(tangent[:3], tangent[3:])
    np.testing.assert_allclose(gtsam.Pose3.Expmap(tangent).matrix(), T, atol=1e-12)
    np.testing.assert_allclose(np.concatenate(log(T)), tangent)
    small = 1e-6 * tangent
    moved = QUARTER_TURN @ exp(small[:3], small[3:]) @ inverse(QUARTER_TURN)
    np.testing.assert_allclose(np.concatenate(log(moved)), adjoint(QUARTER_TURN) @ small, atol=1e-11)


def test_information_is_rotation_before_translation_but_in_g2o_files(tmp_path):
    information = np.diag([1.0, 2.0, 3.0, 40.0, 50.0, 60.0])
    graph = PoseGraph()
    for node in (0, 1):
        graph.add_node(node, node, np.eye(4))
    graph.add_factors([BetweenFactor(0, 1, np.eye(4), information)])
    write_g2o(tmp_path / "graph.g2o", graph)
    (edge,) = [line for line in (tmp_path / "graph.g2o").read_text().splitlines() if line.startswith("EDGE")]
    upper = [float(word) for word in edge.split("#")[0].split()[10:]]
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = upper
    np.testing.assert_allclose(np.diag(matrix), [40.0, 50.0, 60.0, 1.0, 2.0, 3.0])


def test_pixel_centres_are_integers_and_a_camera_looks_along_z():
    camera = PinholeCamera(4, 3, 2.0, 2.0, 1.0, 1.0)
    depth_m = np.zeros((3, 4), np.float32)
    depth_m[1, 1] = depth_m[2, 3] = 2.0
    points = back_project(depth_m, ray_table(camera), np.eye(4))
    np.testing.assert_allclose(points, [[0.0, 0.0, 2.0], [2.0, 1.0, 2.0]])  # x right, y down


def test_the_pose_of_a_sweep_is_that_of_the_body_at_the_scan_s_stamp():
    twist = Twist(np.zeros(3), np.array([2.0, 0.0, 0.0]))
    points, times_s = np.zeros((2, 3), np.float32), np.array([0.0, 0.5], np.float32)
    still = deskewed(Scan(10, points, times_s=times_s), twist)
    np.testing.assert_allclose(still.points_body, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])


def test_cells_of_a_grid_are_rows_of_y_and_columns_of_x_from_the_corner():
    cells = np.full((2, 3), UNKNOWN, np.int8)
    cells[1, 2] = OCCUPIED
    grid = OccupancyGrid(cells, np.array([10.0, 20.0]), 0.5)
    row, column = np.argwhere(grid.cells == OCCUPIED)[0]
    corner = grid.origin_world_m + grid.resolution_m * np.array([column, row])
    np.testing.assert_allclose(corner, [11.0, 20.5])


@pytest.mark.parametrize("point", [(0.26, -0.26, 0.26), (0.49, -0.01, 0.49)])
def test_a_voxel_contains_its_lower_faces(point):
    octree = OctreeMap(OctreeConfig(resolution_m=0.5))
    octree.insert_points(np.array([point]), np.zeros(3))
    inside = np.array([[0.0, -0.5, 0.0], [0.499, -0.001, 0.499], [0.5, -0.25, 0.25]])
    assert octree.query(inside).tolist() == [OCCUPIED, OCCUPIED, UNKNOWN]
