"""Exports that are cropped, or in another frame."""

import numpy as np
import pytest
from plyfile import PlyData
from pypcd4 import PointCloud

from mapper.core.errors import ConfigError, MapperError
from mapper.core.geometry import apply, inverse
from mapper.export.exporters import EXPORTERS, export
from mapper.graph.g2o import read_g2o
from mapper.octree.grid import read_grid
from mapper.octree.map import read_octree
from mapper.sources.trajectory_files import read_tum
from tests.support.files import files_of


@pytest.fixture(scope="module")
def box(run):
    """A box along voxels that holds some of the points."""
    low, high = np.quantile(run.cloud.points.astype(np.float64), [0.2, 0.7], axis=0)
    return np.round(np.concatenate([low, high]), 1).tolist()


def inside(points, box, slack_m=0.0):
    return ((points >= np.array(box[:3]) - slack_m) & (points <= np.array(box[3:]) + slack_m)).all(axis=1)


def test_a_cropped_cloud_has_the_points_in_the_box(run, box, tmp_path):
    cloud = PointCloud.from_path(export(run, "pcd", tmp_path / "part.pcd", box_m=box))
    kept = inside(run.cloud.points, box)
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(cloud.numpy(("x", "y", "z")), run.cloud.points[kept])
    np.testing.assert_array_equal(cloud.pc_data["time_s"], run.cloud.times_s[kept])
    hits = run.octree.attributes.at(run.cloud.points[kept].astype(np.float64)).hits
    np.testing.assert_array_equal(cloud.pc_data["hits"], hits)


@pytest.mark.parametrize("ending", [".bt", ".ot", ".octree"])
def test_a_cropped_octree_has_the_voxels_in_the_box(run, box, tmp_path, ending):
    kind = "native" if ending == ".octree" else "octomap"
    part = read_octree(export(run, kind, tmp_path / f"part{ending}", box_m=box))
    occupied = run.octree.occupied()
    kept = occupied[inside(occupied, box)]
    assert 0 < len(kept) < len(occupied)
    order, theirs = np.lexsort(kept.T), part.occupied()
    np.testing.assert_allclose(theirs[np.lexsort(theirs.T)], kept[order], atol=1e-9)


def test_a_cropped_slice_has_the_cells_in_the_box(run, box, tmp_path):
    part = read_grid(export(run, "grid", tmp_path / "part.yaml", box_m=box))
    rows, columns = (round((box[3 + axis] - box[axis]) / 0.1) for axis in (1, 0))
    assert part.shape == (rows, columns)
    np.testing.assert_allclose(part.origin_world_m, box[:2], atol=1e-9)
    column, row = np.rint((part.origin_world_m - run.slice.origin) / 0.1).astype(int)
    np.testing.assert_array_equal(part.cells, run.slice.cells[row : row + rows, column : column + columns])


def test_in_the_start_frame_the_first_pose_is_the_identity(run, tmp_path):
    T_start_map = inverse(run.trajectory[0])
    moved = read_tum(export(run, "tum", tmp_path / "start.tum", frame="start"))
    np.testing.assert_allclose(moved[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(moved.poses, T_start_map @ run.trajectory.poses, atol=1e-12)
    vertices = PlyData.read(export(run, "ply", tmp_path / "start.ply", frame="start"))["vertex"]
    points = np.column_stack([vertices[axis] for axis in "xyz"])
    np.testing.assert_allclose(points, apply(T_start_map, run.cloud.points), atol=1e-5)


def test_a_graph_is_moved_with_its_path(run, tmp_path):
    graph = read_g2o(export(run, "g2o", tmp_path / "start.g2o", frame="start"))
    node, T_map_node = next(iter(run.graph.T_world_node.items()))
    np.testing.assert_allclose(graph.T_world_node[node], inverse(run.trajectory[0]) @ T_map_node, atol=1e-9)
    assert [(f.i, f.j) for f in graph.factors] == [(f.i, f.j) for f in run.graph.factors]


def test_a_mesh_is_cropped_and_moved(run, box, tmp_path):
    o3d = pytest.importorskip("open3d", reason="the mesh extra is not installed", exc_type=ImportError)
    path = export(run, "mesh", tmp_path / "part.stl", frame="start", box_m=box)
    points = np.asarray(o3d.io.read_triangle_mesh(str(path)).vertices)
    assert len(points) > 100
    # depth counts up to a voxel's diagonal beside the occupied voxels that are left
    assert inside(apply(run.trajectory[0], points), box, slack_m=0.1 * 3**0.5 + 0.04).all()


@pytest.mark.parametrize("kind", [kind for kind, one in EXPORTERS.items() if one.crops and not one.file_name])
def test_folders_are_cropped(run, box, tmp_path, kind):
    whole, part = (export(run, kind, tmp_path / name, box_m=b) for name, b in (("a", None), ("b", box)))
    sizes = [sum(path.stat().st_size for path in out.rglob("*.*") if path.is_file()) for out in (part, whole)]
    assert sizes[0] < sizes[1]


@pytest.mark.parametrize(
    ("kind", "out", "wrong", "message"),
    [
        ("octomap", "a.bt", {"frame": "start"}, "no frame"),
        ("g2o", "a.g2o", {"box_m": [0, 0, 0, 1, 1, 1]}, "no crop"),
        ("ply", "a.ply", {"frame": "base"}, "frame base: .* known: body$"),
        ("tum", "a.tum", {"poses_of": "wheel"}, "frame wheel: .* known: body$"),
        ("tum", None, {"poses_of": "body"}, "--out"),
        ("ply", "a.ply", {"poses_of": "body"}, "tum, kitti have"),
        ("ply", "a.ply", {"frame": "odom"}, "want map, start or base"),
        ("ply", "a.ply", {"box_m": [1, 0, 0, 0, 1, 1]}, "lowest corner"),
        ("ply", "a.ply", {"box_m": [0, 0, 0]}, "crop"),
        ("ply", "a.ply", {"box_m": [90, 90, 90, 91, 91, 91]}, "the map reaches from"),
        ("grid", "a.yaml", {"box_m": [90, 90, 90, 91, 91, 91]}, "the map reaches from"),
        ("octomap", "a.bt", {"box_m": [90, 90, 90, 91, 91, 91]}, "no voxel"),
        ("ply", None, {"frame": "start"}, "--out"),
    ],
)
def test_parts_that_cannot_be_are_refused(run, tmp_path, kind, out, wrong, message):
    before = files_of(run.path)
    with pytest.raises(MapperError, match=message):
        export(run, kind, None if out is None else tmp_path / out, **wrong)
    with pytest.raises(ConfigError):
        export(run, kind, run.path / "other", **wrong)
    assert files_of(run.path) == before
    assert not list(tmp_path.iterdir())
