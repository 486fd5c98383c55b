import errno
import json
import sys
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pye57
import pyoctomap
import pytest
from plyfile import PlyData
from pypcd4 import PointCloud

from mapper.core.errors import ConfigError, DependencyError, MapSizeError, RunError, WriteError
from mapper.export.exporters import EXPORTERS, export
from mapper.graph.g2o import read_g2o
from mapper.octree.grid import OCCUPIED, UNKNOWN, read_grid
from mapper.octree.map import read_octree
from mapper.run.file_checks import check_run
from mapper.run.folder import moved_log, open_run
from mapper.sources.trajectory_files import read_kitti, read_tum
from tests.support.files import digest_of, files_of

KINDS = [kind for kind, exporter in EXPORTERS.items() if exporter.file_name]
FOLDERS = [kind for kind in EXPORTERS if kind not in KINDS]


@pytest.fixture(params=KINDS)
def kind(request):
    if request.param == "mesh":
        pytest.importorskip("open3d", reason="the mesh extra is not installed", exc_type=ImportError)
    return request.param


@pytest.fixture
def untouched(run):
    """Fail whoever writes into the shared run."""
    before = files_of(run.path)
    yield run
    assert files_of(run.path) == before


def positions_and_faces(path):
    ply = PlyData.read(path)
    vertices = np.column_stack([ply["vertex"][axis] for axis in "xyz"])
    assert all(ply["vertex"][channel].dtype == np.uint8 for channel in ("red", "green", "blue"))
    faces = np.vstack(ply["face"]["vertex_indices"]) if "face" in ply else None
    return vertices, faces


def occupied_centres(run):
    return read_octree(run.path / "map.ot", run.config.octree).occupied()


def check_octomap(run, path):
    tree = pyoctomap.OcTree(1.0)
    assert tree.readBinary(str(path))
    assert tree.getResolution() == run.config.octree.resolution_m
    for centre in occupied_centres(run)[::10]:
        assert tree.isNodeOccupied(tree.search(centre))


def check_ply(run, path):
    points, faces = positions_and_faces(path)
    assert len(points) == run.manifest.counts.cloud_points
    assert faces is None
    seen_s, length_s = PlyData.read(path)["vertex"]["time"], np.ptp(run.trajectory.stamps_ns) / 1e9
    assert seen_s[0] == 0.0
    assert (np.diff(seen_s) >= 0.0).all()
    assert 0.0 < seen_s[-1] <= length_s


def check_attributes(run, hits, times_s):
    at = run.octree.attributes.at(run.cloud.points.astype(np.float64))
    np.testing.assert_array_equal(hits, at.hits)
    assert hits.min() >= 1
    stamps_ns = run.trajectory.stamps_ns
    np.testing.assert_allclose(times_s, (at.last_seen_ns - stamps_ns[0]) / 1e9)
    assert 0.0 <= times_s.min() < times_s.max() <= (stamps_ns[-1] - stamps_ns[0]) / 1e9


def check_las(run, path):
    cloud = laspy.read(path)
    assert (cloud.header.version.major, cloud.header.version.minor, cloud.point_format.id) == (1, 2, 2)
    assert cloud.header.generating_software == "mapper"
    assert path.read_bytes()[90:94] == bytes(4)  # no date: the same run, the same bytes
    assert cloud.header.are_points_compressed == (path.suffix == ".laz")
    np.testing.assert_allclose(cloud.xyz, run.cloud.points, atol=0.51e-4)
    colors = np.column_stack([cloud.red, cloud.green, cloud.blue])
    np.testing.assert_array_equal(colors // 256, run.cloud.colors)
    assert colors.max() > 255
    assert list(cloud.point_format.extra_dimension_names) == ["time_s", "last_seen_s", "hits"]
    check_attributes(run, np.array(cloud.hits), np.array(cloud.last_seen_s))


def check_pcd(run, path):
    cloud = PointCloud.from_path(path)
    assert cloud.fields == ("x", "y", "z", "rgb", "time_s", "last_seen_s", "hits")
    np.testing.assert_array_equal(cloud.numpy(("x", "y", "z")), run.cloud.points)
    packed = np.ascontiguousarray(cloud.pc_data["rgb"]).view(np.uint32)
    channels = [packed >> 16, packed >> 8 & 255, packed & 255]
    np.testing.assert_array_equal(np.column_stack(channels), run.cloud.colors)
    check_attributes(run, cloud.pc_data["hits"], cloud.pc_data["last_seen_s"])


def check_e57(run, path):
    cloud = pye57.E57(str(path)).read_scan(0, colors=True, ignore_missing_fields=True)
    for axis, values in zip("XYZ", run.cloud.points.T, strict=True):
        np.testing.assert_array_equal(cloud[f"cartesian{axis}"], values)
    np.testing.assert_array_equal(cloud["colorGreen"], run.cloud.colors[:, 1])


def check_voxels(run, path):
    points, faces = positions_and_faces(path)
    np.testing.assert_allclose(points, occupied_centres(run), atol=1e-5)
    assert faces is None


def check_voxel_mesh(run, path):
    points, faces = positions_and_faces(path)
    resolution_m = run.config.octree.resolution_m
    np.testing.assert_allclose(points / resolution_m, np.rint(points / resolution_m), atol=1e-4)
    a, b, c = np.moveaxis(points[faces].astype(np.float64), 1, 0)
    volume_m3 = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    assert volume_m3 == pytest.approx(len(occupied_centres(run)) * resolution_m**3, rel=1e-4)


def check_mesh(run, path):
    points, faces = positions_and_faces(path)
    assert len(faces) > 1000
    gaps_m = np.linalg.norm(points[::50, None] - occupied_centres(run)[None], axis=2).min(axis=1)
    assert np.percentile(gaps_m, 95) < run.config.octree.resolution_m


def check_grid(run, path):
    ours, theirs = read_grid(path), read_grid(run.path / "slice.yaml")
    np.testing.assert_array_equal(ours.cells, theirs.cells)
    np.testing.assert_array_equal(ours.origin_world_m, theirs.origin_world_m)
    assert path.with_suffix(".png").is_file()


def check_native(run, path):
    ours, theirs = read_octree(path), read_octree(run.path / "map.ot", run.config.octree)
    assert ours.config.model_copy(update={"depth_noise": None}) == run.config.octree
    np.testing.assert_array_equal(ours.leaves().keys, theirs.leaves().keys)
    np.testing.assert_array_equal(ours.leaves().log_odds, theirs.leaves().log_odds)


def check_costmap(run, path):
    grid = read_grid(run.path / "slice.yaml")
    magic, _, size, _, pixels = path.with_suffix(".pgm").read_bytes().split(b"\n", 4)
    assert (magic, size) == (b"P5", b"%d %d" % grid.cells.shape[::-1])
    values = np.frombuffer(pixels, np.uint8).reshape(grid.cells.shape)[::-1]
    np.testing.assert_array_equal(values == 100, grid.cells == OCCUPIED)
    assert set(np.unique(values)) <= {*range(101), 255}
    assert (values[grid.cells == UNKNOWN] >= 99).all()  # unknown, or too near to an obstacle anyway
    assert "mode: raw" in path.read_text()
    assert path.with_suffix(".png").is_file()


def check_tum(run, path):
    np.testing.assert_array_equal(read_tum(path).T_world_body, run.trajectory.T_world_body)


def check_kitti(run, path):
    np.testing.assert_allclose(read_kitti(path).T_world_body, run.trajectory.T_world_body, atol=1e-12)


def check_g2o(run, path):
    assert read_g2o(path).T_world_node.keys() == run.graph.T_world_node.keys()


def check_layout(run, path):
    panels = json.loads(path.read_text())["content"]["items"]
    assert (
        panels[0]["content"]["config"]["topics"]["/map/octree"]["cubeSize"] == run.config.octree.resolution_m
    )


CHECKS = {
    "octomap": check_octomap,
    "ply": check_ply,
    "las": check_las,
    "pcd": check_pcd,
    "e57": check_e57,
    "voxels": check_voxels,
    "voxel-mesh": check_voxel_mesh,
    "mesh": check_mesh,
    "grid": check_grid,
    "native": check_native,
    "costmap": check_costmap,
    "tum": check_tum,
    "kitti": check_kitti,
    "foxglove-layout": check_layout,
    "g2o": check_g2o,
}


def out_of(folder, kind):
    return (folder / "taken").with_suffix("".join(EXPORTERS[kind].endings[:1]))


@pytest.mark.parametrize("ending", [".bt", ".ot"])
@pytest.mark.parametrize("level", [0, 2])
def test_an_octree_of_wider_voxels_is_one_that_octomap_reads(untouched, tmp_path, ending, level):
    settings = {"octomap.level": level}
    path = export(untouched, "octomap", tmp_path / f"coarse{ending}", settings=settings)
    tree = pyoctomap.OcTree(1.0)
    if ending == ".bt":
        assert tree.readBinary(str(path))
    else:
        tree = tree.read(str(path))
    assert tree.getResolution() == pytest.approx(0.1 * 2**level)
    mean = read_octree(untouched.path / "map.octree").leaves(depth=16 - level, parent="mean")
    for centre, log_odds in zip(mean.centres_world, mean.log_odds, strict=True):
        assert tree.isNodeOccupied(tree.search(centre)) == (log_odds >= 0.0)


def test_what_is_written_is_read_by_others(untouched, kind, tmp_path):
    out = out_of(tmp_path / "new" / "folder", kind)
    assert export(untouched, kind, out) == out

    CHECKS[kind](untouched, out)
    beside = {out.with_suffix(ending) for ending in EXPORTERS[kind].sidecars}
    assert set(out.parent.iterdir()) == {out, *beside}


def test_las_may_be_uncompressed(untouched, tmp_path):
    check_las(untouched, export(untouched, "las", tmp_path / "cloud.las"))


@pytest.mark.parametrize(
    "kind", sorted(EXPORTERS.keys() - {"e57"})
)  # whose files have a GUID, as its standard wants
def test_the_same_run_gives_the_same_bytes(untouched, kind, tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        export(untouched, kind, out_of(tmp_path / folder, kind))
    assert digest_of(tmp_path / "one") == digest_of(tmp_path / "two")


@pytest.mark.parametrize("kind", FOLDERS)
def test_a_folder_is_named_and_only_an_earlier_one_is_replaced(untouched, kind, tmp_path):
    with pytest.raises(ConfigError, match="name it with --out"):
        export(untouched, kind)
    out = export(untouched, kind, tmp_path / "results")
    with pytest.raises(RunError, match="exists already"):
        export(untouched, kind, out)
    assert export(untouched, kind, out, overwrite=True) == out
    (out / "notes.txt").touch()
    with pytest.raises(RunError, match=r"notes\.txt"):
        export(untouched, kind, out, overwrite=True)


def test_without_a_name_it_stays_in_the_run(run, kind, tmp_path):
    own = replace(run, path=copy_of(run, tmp_path / "own"))
    for _ in range(2):  # what is ours may be written again
        path = export(own, kind)
    assert path == own.path / EXPORTERS[kind].file_name
    CHECKS[kind](run, path)
    before, after = files_of(run.path), files_of(own.path)
    del before["manifest.json"]  # which records what was written
    assert {name: after[name] for name in before} == before
    assert not [finding for finding in check_run(own.path) if finding.verdict == "failed"]


def test_a_file_that_is_there_is_spared_unless_told(untouched, kind, tmp_path):
    out = out_of(tmp_path, kind)
    for ending in (out.suffix, *EXPORTERS[kind].sidecars):
        file = out.with_suffix(ending)
        file.write_bytes(b"precious")
        with pytest.raises(RunError, match=r"taken.* exists already; .*--overwrite"):
            export(untouched, kind, out)
        assert files_of(tmp_path) == {file.name: b"precious"}
        file.unlink()

    out.write_bytes(b"worthless")
    export(untouched, kind, out, overwrite=True)
    CHECKS[kind](untouched, out)


def test_a_full_disk_leaves_nothing_behind(untouched, kind, tmp_path, monkeypatch):
    def refuse(_self, _target):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(WriteError, match="No space left"):
        export(untouched, kind, out_of(tmp_path, kind))
    assert list(tmp_path.iterdir()) == []


def test_another_ending_is_refused(untouched, kind, tmp_path):
    with pytest.raises(ConfigError, match=f"taken.doc: {kind} files end with .*; choose such a name"):
        export(untouched, kind, tmp_path / "taken.doc")


def test_a_folder_is_not_a_file(untouched, kind, tmp_path):
    out = out_of(tmp_path, kind)
    out.mkdir()
    with pytest.raises(RunError, match="is a folder; name a file"):
        export(untouched, kind, out, overwrite=True)


def test_an_unknown_kind_names_the_known():
    with pytest.raises(ConfigError, match="no exporter 'jpeg'; want one of octomap, native, ply, las"):
        export(None, "jpeg")
    with pytest.raises(ConfigError, match="did you mean costmap"):
        export(None, "costmaps")


@pytest.mark.parametrize("name", ["cloud.ply", "map.bt", "map.octree", "slice.yaml", "trajectory.tum"])
def test_a_run_with_a_hole_says_which_file(run, tmp_path, name):
    kind = {"cloud.ply": "ply", "map.bt": "octomap", "map.octree": "voxels", "slice.yaml": "grid"}.get(
        name, "kitti"
    )
    broken = replace(run, path=copy_of(run, tmp_path / "run"))
    (broken.path / name).unlink()
    with pytest.raises(Exception, match=name) as caught:
        export(broken, kind, out_of(tmp_path / "out", kind))
    assert type(caught.value).__module__ == "mapper.core.errors"


def test_settings_that_a_kind_does_not_read_are_refused(untouched):
    with pytest.raises(ConfigError, match="mesh: export --as ply has no settings"):
        export(untouched, "ply", settings={"mesh.voxel_m": 0.1})
    with pytest.raises(ConfigError, match="octree: export --as mesh reads mesh settings only"):
        export(untouched, "mesh", settings={"octree.resolution_m": 0.2})
    with pytest.raises(RunError, match="name another file"):  # than the run's own
        export(untouched, "octomap", settings={"octomap.level": 2})


class Missing:
    """Makes Open3D fail to load in one way or another."""

    def __init__(self, error):
        self.error = error

    def find_spec(self, name, *_arguments):
        if name.partition(".")[0] == "open3d":
            raise self.error


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            ModuleNotFoundError("not there", name="open3d"),
            r"pip install 'octree-mapper\[mesh\]'",
        ),
        (
            OSError("libGL.so.1: cannot open shared object file"),
            r"libGL\.so\.1 is missing; apt-get install libgl1",
        ),
        (
            ImportError("libusb-1.0.so.0: cannot open"),
            r"libusb-1\.0\.so\.0 is missing; apt-get install .*libusb-1",
        ),
    ],
)
def test_a_mesh_without_open3d_says_how_to_get_it(untouched, tmp_path, monkeypatch, error, message):
    for name in [name for name in sys.modules if name.partition(".")[0] == "open3d"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Missing(error), *sys.meta_path])
    with pytest.raises(DependencyError, match=message):
        export(untouched, "mesh", tmp_path / "mesh.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_mesh_refuses_what_it_cannot_make(untouched, desk_log, tmp_path):
    pytest.importorskip("open3d", reason="the mesh extra is not installed", exc_type=ImportError)
    gone = moved_log(untouched, tmp_path / "gone")
    with pytest.raises(RunError, match=r"gone: the log of .* is no longer there; .* --log"):
        export(gone, "mesh", tmp_path / "mesh.ply")

    another = moved_log(untouched, desk_log / "rgb.txt")
    with pytest.raises(Exception, match=r"rgb.txt"):
        export(another, "mesh", tmp_path / "mesh.ply")

    tiny = {"mesh.voxel_m": 1e-6}
    with pytest.raises(MapSizeError, match=r"needs .* GiB and this machine has .*; raise mesh.voxel_m"):
        export(untouched, "mesh", tmp_path / "mesh.ply", settings=tiny)

    shy = {"mesh.min_observations": 100}
    with pytest.raises(RunError, match=r"no surface within [\d.]+ m was seen in 100 fused frames"):
        export(untouched, "mesh", tmp_path / "mesh.ply", settings=shy)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", EXPORTERS["voxel-mesh"].endings)
def test_open3d_reads_every_ending_of_a_mesh(untouched, tmp_path, ending):
    o3d = pytest.importorskip("open3d", reason="the mesh extra is not installed", exc_type=ImportError)
    export(untouched, "voxel-mesh", tmp_path / "cubes.ply")
    points, faces = positions_and_faces(tmp_path / "cubes.ply")
    out = export(untouched, "voxel-mesh", tmp_path / f"taken{ending}")

    theirs = o3d.io.read_triangle_mesh(str(out))
    vertices = np.asarray(theirs.vertices)
    if ending == ".glb":
        vertices = vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]  # glTF's y is up
    np.testing.assert_allclose(vertices[np.asarray(theirs.triangles)], points[faces], atol=1e-6)


def copy_of(run, folder):
    folder.mkdir()
    for name, data in files_of(run.path).items():
        (folder / name).write_bytes(data)
    return open_run(folder).path
