"""What a new user types, as typed: text for paths, attributes for parts, numpy everywhere."""

import re
import shutil
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

import mapper
from mapper.core.frames import RgbdFrame
from mapper.sources.trajectory_files import read_tum

mpl.use("Agg")


@pytest.fixture(scope="module")
def run(desk_run):
    return mapper.open_run(str(desk_run.path))


def test_a_log_is_built(desk_log, desk_run, tmp_path):
    run = mapper.build(str(desk_log), out=str(tmp_path / "run"), settings={"mcap.frame_times": False})
    assert isinstance(run, mapper.Run)
    for name in ("trajectory.tum", "map.octree", "slice.pgm"):
        assert (run.path / name).read_bytes() == (desk_run.path / name).read_bytes()


def test_a_log_opened_before_is_built_with_a_configuration_loaded_before(desk_log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # without a name, a run's is the log's
    lines = []
    run = mapper.build(
        mapper.open_log(desk_log)[:12],
        config=mapper.load_config(overrides=["octree.resolution_m=0.1"]),
        settings={"min_tracked_frames": 5},
        progress=lines.append,
    )
    again = mapper.build(
        mapper.open_log(desk_log)[:12], config={"octree.resolution_m": 0.1, "min_tracked_frames": 5}
    )
    assert again.config == run.config
    assert run.path == Path("runs", desk_log.name)
    assert run.octree.resolution_m == 0.1
    assert len(run.trajectory) == 12
    assert "track" in lines
    assert "track 12/12" in lines


def test_the_trajectory_is_arrays(run):
    path = run.trajectory
    assert path.positions.shape == (31, 3)
    assert path.poses.shape == (31, 4, 4)
    np.testing.assert_array_equal(path.poses[:, :3, 3], path.positions)
    np.testing.assert_allclose(np.diff(path.stamps), 1.0 / 15.0, atol=1e-3)
    assert run.trajectory is path


def test_the_trajectory_is_a_sequence_of_poses(run):
    path = run.trajectory
    np.testing.assert_array_equal(path[-1], path.poses[30])
    np.testing.assert_array_equal(list(path), path.poses)
    assert [len(path[2:9]), len(path[::5]), len(path[path.positions[:, 2] > -1e9])] == [7, 7, 31]
    np.testing.assert_array_equal(path[2:9].stamps_ns, path.stamps_ns[2:9])
    assert re.fullmatch(r"Trajectory of 31 poses over 2\.0 s and [\d.]+ m", repr(path))
    assert repr(path[:0]) == "Trajectory of no poses"
    with pytest.raises(IndexError):
        path[31]
    with pytest.raises(mapper.MapperError, match="stamps must increase"):
        path[::-1]


def test_the_octree_answers(run):
    octree = run.octree
    states = octree.query(run.trajectory.positions)
    assert set(states.tolist()) <= {0, -1}
    assert (states == 0).mean() > 0.5
    occupied = octree.occupied()
    assert occupied.shape[1] == 3
    assert (octree.query(occupied) == 100).all()
    assert (octree.probability(occupied) >= 0.5).all()
    assert octree.slice(0.1, 1.2).grid.shape[0] > 10
    assert mapper.read_octree(str(run.path / "map.ot")).occupied().shape == occupied.shape
    assert isinstance(mapper.read_octree(run.path / "map.bt"), mapper.OctreeMap)


def test_an_octree_is_made_filled_shown_and_written(run, tmp_path):
    octree = mapper.OctreeMap(0.1)
    octree.insert_points(np.float32([[1.0, 0.0, 0.0], [1.0, 0.5, 0.0]]), np.zeros(3))
    assert octree.count_occupied() == len(octree.occupied()) == 2
    free = len(octree) - 2
    assert repr(octree) == f"OctreeMap of 0.1 m voxels: {len(octree)} known, 2 occupied and {free} free"
    for ending in ("octree", "ot", "bt"):
        octree.write(str(tmp_path / f"two.{ending}"))
        back = mapper.read_octree(tmp_path / f"two.{ending}")
        np.testing.assert_array_equal(back.occupied(), octree.occupied())
    with pytest.raises(mapper.MapperError, match=r"two\.txt: want a name that ends in \.octree"):
        octree.write(tmp_path / "two.txt")

    counts = run.manifest.counts
    assert repr(mapper.read_octree(str(run.path))) == repr(run.octree)
    assert run.octree.count_occupied() == counts.occupied == len(run.octree.occupied())
    free = len(run.octree.free())
    assert counts.voxels_text == f"{counts.occupied} occupied and {free} free voxels"


def test_the_cloud_is_points_and_colours(run):
    assert run.cloud.points.shape == run.cloud.colors.shape == (run.manifest.counts.cloud_points, 3)
    np.testing.assert_array_equal(np.asarray(run.cloud), run.cloud.points)
    assert np.asarray(run.cloud, dtype=np.float64).dtype == np.float64


def test_the_slice_is_a_grid(run):
    grid = run.slice
    assert np.asarray(grid).dtype == np.int8
    np.testing.assert_array_equal(np.asarray(grid), grid.grid)
    assert grid.resolution == run.config.octree.resolution_m
    x, y = run.trajectory.positions[0, :2]
    column, row = np.floor((np.array([x, y]) - grid.origin) / grid.resolution).astype(int)
    assert 0 <= row < grid.grid.shape[0]
    assert 0 <= column < grid.grid.shape[1]


def test_the_parts_of_a_run_are_drawn_by_themselves(run):
    import matplotlib.pyplot as plt

    axes = run.slice.plot()
    assert run.trajectory.plot(axes) is axes
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), run.trajectory.positions[:, :2])
    left, right, low, high = axes.images[0].get_extent()
    assert run.slice.shape == run.slice.grid.shape
    np.testing.assert_allclose([left, low], run.slice.origin)
    np.testing.assert_allclose([high - low, right - left], np.array(run.slice.shape) * run.slice.resolution)
    plt.close(axes.figure)
    alone = run.trajectory[:0].plot()
    assert alone.get_xlabel() == "x (m)"
    plt.close(alone.figure)


def test_one_height_of_the_octree_is_the_voxels_there(run):
    octree = run.octree
    heights = octree.occupied()[:, 2]
    centre = heights[len(heights) // 2]
    layer = octree.slice(float(centre))
    at = octree.occupied()[np.isclose(heights, centre)]
    cells = np.floor((at[:, :2] - layer.origin) / layer.resolution).astype(int)
    assert (layer.grid[cells[:, 1], cells[:, 0]] == 100).all()
    assert (layer.grid == 100).sum() == len(at)


def test_what_a_prompt_shows_is_short(run, desk_log):
    assert repr(run) == f"Run({str(run.path)!r})"
    assert run.verdict.state == "trusted"
    loops = sum(factor.origin == "loop" for factor in run.graph.factors)
    nodes, factors = len(run.graph.nodes), len(run.graph.factors)
    assert repr(run.graph) == f"PoseGraph of {nodes} nodes and {factors} factors, {loops} of them loops"
    rows, columns = run.slice.shape
    assert repr(run.slice) == f"OccupancyGrid of {rows} × {columns} cells of 0.05 m"
    assert repr(run.cloud) == f"Cloud of {len(run.cloud)} points with colours, times_s"
    log = mapper.open_log(desk_log)
    for shown in (run.graph.factors[0], *run.loops[:1], mapper.register(log[1], log[0], method="isvd")):
        assert "information" not in repr(shown)


def test_the_graph_is_gtsam_s_too(run):
    graph = run.graph
    assert len(graph.nodes) == len(graph.positions) == run.manifest.counts.nodes
    factors, values = graph.to_gtsam()
    assert factors.size() == len(graph.factors) + 1
    assert sorted(values.keys()) == graph.nodes.tolist()
    second = int(graph.nodes[1])
    np.testing.assert_allclose(values.atPose3(second).matrix(), graph.T_world_node[second], atol=1e-9)
    assert factors.error(values) < 1.0  # it is the solution


def test_a_log_is_iterated(desk_log):
    log = mapper.open_log(str(desk_log))
    stamps = []
    for frame in log[5:8]:
        assert isinstance(frame, RgbdFrame)
        assert frame.image.shape == (240, 320, 3)
        assert frame.scan().points.shape[1] == 3
        stamps.append(frame.stamp)
    np.testing.assert_allclose(stamps, log.stamps_ns[5:8] / 1e9, atol=1e-6)
    assert log[-1].stamp_ns == log.stamps_ns[-1]
    assert sum(1 for _ in log) == len(log) == 31
    with mapper.open_log(desk_log) as same:
        assert len(list(same[:2])) == 2
    with pytest.raises(IndexError):
        log[31]
    with pytest.raises(mapper.MapperError, match="no backward order"):
        log[::-1]


def test_a_run_is_evaluated(run, desk_log):
    found = mapper.evaluate(str(run.path))
    assert found.ate_m == found["ATE RMSE"] == found["ATE RMSE, SE(3)-aligned"] < 0.02
    assert "ATE RMSE" in str(found)
    assert "<td>ATE RMSE" in found._repr_html_()
    by_files = mapper.evaluate(str(run.path / "trajectory.tum"), desk_log / "groundtruth.txt")
    assert by_files.ate_m == pytest.approx(found.ate_m)
    assert mapper.evaluate(run.trajectory, run.truth).ate_m == pytest.approx(found.ate_m)
    assert mapper.evaluate(run.trajectory).ate_m is None
    with pytest.raises(KeyError, match="want one of"):
        found["ATE"]


def test_a_trajectory_is_asked_for_other_times_and_written(run, tmp_path):
    path = run.trajectory
    begin_ns, end_ns = path.stamps_ns[:2].tolist()
    np.testing.assert_array_equal(path.at(begin_ns), path[0])
    middle = path.at((begin_ns + end_ns) // 2)
    np.testing.assert_allclose(middle[:3, 3], path.positions[:2].mean(axis=0), atol=1e-9)
    turned = [path[0][:3, :3].T @ middle[:3, :3], middle[:3, :3].T @ path[1][:3, :3]]
    np.testing.assert_allclose(turned[0], turned[1], atol=1e-6)  # half of the turn each
    other = path.interpolate([begin_ns + 1000, end_ns])
    assert other.stamps_ns.tolist() == [begin_ns + 1000, end_ns]
    np.testing.assert_array_equal(other[1], path[1])
    for outside in (begin_ns - 1, int(path.stamps_ns[-1]) + 1):
        with pytest.raises(mapper.MapperError, match="no pose at"):
            path.at(outside)
    with pytest.raises(mapper.MapperError, match="no pose at"):
        path[:0].at(begin_ns)
    path.write(str(tmp_path / "path.tum"))
    again = read_tum(tmp_path / "path.tum")
    np.testing.assert_array_equal(again.stamps_ns, path.stamps_ns)
    np.testing.assert_allclose(again.poses, path.poses, atol=1e-12)
    with pytest.raises(mapper.MapperError, match=r"path\.csv: want a name that ends in \.tum"):
        path.write(tmp_path / "path.csv")
    path.write(tmp_path / "path.kitti")
    assert len((tmp_path / "path.kitti").read_text().splitlines()) == 31


def test_the_octree_is_asked_by_coordinates(run):
    octree = run.octree
    assert octree.resolution == 0.05
    x, y, z = octree.occupied()[0]
    assert octree[x, y, z] == 100
    assert octree.is_occupied([x, y, z]) is True
    assert octree.is_occupied((1e4, 0.0, 0.0)) is False
    assert octree[octree.free()].max() == 0
    rays = octree.cast_rays(run.trajectory.positions[0], [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    assert rays.hits.shape == (2,)
    above = [[float(x), float(y), float(z) + 100.0]]
    assert octree.nearest_obstacles(above).distances_m < 110.0
    assert octree.nearest_obstacles(above[0]).distances_m == octree.nearest_obstacles(above).distances_m
    assert octree.cast_rays(run.trajectory.positions[0], [0.0, 0.0, -1.0]).hits == rays.hits[:1]


def test_settings_are_given_by_name():
    assert mapper.load_config({"octree.resolution_m": 0.1}).octree.resolution_m == 0.1
    nested = {"octree": {"resolution_m": 0.1}}
    assert mapper.load_config(nested, settings={"octree.resolution_m": 0.2}).octree.resolution_m == 0.2
    assert "resolution_m=0.1" in repr(mapper.load_config(nested))
    with pytest.raises(mapper.MapperError, match="did you mean octree"):
        mapper.load_config({"octre.resolution_m": 0.1})


def test_poses_become_a_table(run):
    pandas = pytest.importorskip("pandas")
    table, written = pandas.DataFrame(run.poses), pandas.read_csv(run.file("poses.csv"))
    assert list(table.columns) == list(written.columns)
    pandas.testing.assert_frame_equal(table, written, rtol=1e-8)


def test_what_is_printed_fits_a_screen(run, desk_log):
    parts = (
        run,
        run.poses,
        run.results,
        run.cloud,
        run.slice,
        run.graph,
        run.verdict,
        run.config,
        run.octree,
    )
    log = mapper.open_log(desk_log)
    lengths = {type(part).__name__: len(repr(part)) for part in (*parts, log, log[0])}
    assert max(lengths.values()) <= 25 * 80, lengths


def copy_of(run, folder):
    return mapper.open_run(shutil.copytree(run.path, folder))


def test_a_run_makes_what_the_verbs_make(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = copy_of(run, tmp_path / "own")
    assert own.export("las", "cloud.laz") == Path("cloud.laz")
    assert own.export("octomap", "wide.bt", settings={"octomap.level": 1}) == Path("wide.bt")
    assert mapper.read_octree("wide.bt").resolution == 0.1
    with pytest.raises(mapper.MapperError, match="no exporter 'laz'"):
        own.export("laz")
    assert (own.view(), own.report()) == (Path("own.html"), Path("report.html"))
    assert own.report() == Path("report-2.html")
    for page in ("own.html", "report.html"):
        assert Path(page).read_text().startswith("<!DOCTYPE html>")
    lines = []
    fused = own.fuse(settings={"slice.max_height_m": 0.6}, progress=lines.append)
    assert (fused.path, fused.config.slice.max_height_m) == (own.path, 0.6)
    assert "fuse" in lines
    with pytest.raises(mapper.MapperError, match="did you mean"):
        own.fuse(settings={"slice.max_hight_m": 0.6})


def test_the_verbs_are_functions(run, desk_log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = mapper.inspect(desk_log)
    assert (found.problem, found.log.frames.count) == (None, 31)

    own = copy_of(run, tmp_path / "own")
    free = np.argwhere(own.slice.cells == 0)
    goal = own.slice.origin + (free[len(free) // 2, ::-1] + 0.5) * own.slice.resolution
    plan = mapper.plan(own, goal, goal, settings={"radius_m": 0.0})
    np.testing.assert_allclose(plan.waypoints_world[-1], goal)
    assert (own.path / "plan.json").exists()
    with pytest.raises(mapper.MapperError, match=r"want \(2,\) metres"):
        mapper.plan(own, [0.0, 0.0, 0.0], goal)

    changes = mapper.diff(run, own.path, place="built")
    assert (changes.appeared, changes.vanished) == ([], [])
    assert len(list((tmp_path / "diffs").iterdir())) == 1
    merged = mapper.merge([run, own.path], out="both")
    assert merged.map.path == Path("both")
    assert len(merged.map.manifest.runs) == 2
    with pytest.raises(mapper.MapperError, match="no runs"):
        mapper.merge([])
