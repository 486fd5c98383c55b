import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, DataError, ViewerError
from mapper.export.rerun.finished import show_run
from mapper.export.rerun.recording import recorded
from mapper.export.rerun.target import check_target, streaming
from mapper.export.run_maps import maps_of, snapshots_of
from mapper.mapping import cloud
from mapper.pipeline.build import build
from mapper.run.folder import open_run
from mapper.sources import open_source
from tests.support.command_line import invoke
from tests.support.rerun_log import Told

RERUN = Path(sys.executable).with_name("rerun")


@pytest.fixture(scope="module")
def run(desk_run, tmp_path_factory):
    """A copy, for recordings to lie in."""
    return open_run(shutil.copytree(desk_run.path, tmp_path_factory.mktemp("rerun") / "desk"))


@pytest.fixture(scope="module")
def told(run):
    path = run.path / "told.rrd"
    show_run(run, str(path))
    return Told(path)


def test_two_recordings_of_a_run_say_the_same(run, tmp_path):
    paths = [tmp_path / "one.rrd", tmp_path / "other.rrd"]
    for path in paths:
        show_run(run, str(path))
    compared = subprocess.run(
        [RERUN, "rrd", "compare", "--unordered", *paths], capture_output=True, text=True
    )
    assert compared.returncode == 0, compared.stderr


def test_the_paths_are_the_run_s(run, told):
    estimate = told.one("/world/path/estimate", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(estimate, run.trajectory.positions_world, atol=1e-6)
    truth = told.one("/world/path/truth", "LineStrips3D:strips")[0]
    assert np.linalg.norm(truth[0] - estimate[0]) < 0.05  # laid over the estimate, in its own world


def test_a_cloud_too_large_to_view_is_thinned(run, tmp_path, monkeypatch):
    monkeypatch.setattr(cloud, "MOST_TO_VIEW", 1000)
    show_run(run, str(tmp_path / "few.rrd"))
    points = Told(tmp_path / "few.rrd").one("/world/map/cloud", "Points3D:positions")
    assert 500 < len(points) <= 1000 < len(run.cloud.points)


def test_the_body_has_a_pose_at_every_exact_stamp(run, told):
    trajectory = run.trajectory
    rows = told.values("/world/body", "Transform3D:translation")
    assert [stamp for stamp, _ in rows] == trajectory.stamps_ns.tolist()
    np.testing.assert_allclose([value[0] for _, value in rows], trajectory.positions_world, atol=1e-6)


def test_the_graph_is_nodes_and_lines_between_them(run, told):
    graph = run.graph
    nodes = told.one("/world/graph/nodes", "Points3D:positions")
    np.testing.assert_allclose(nodes, [T[:3, 3] for T in graph.T_world_node.values()], atol=1e-6)
    lines = told.one("/world/graph/odometry", "LineStrips3D:strips")
    assert len(lines) == sum(factor.origin == "odometry" for factor in graph.factors)


def test_every_loop_is_a_line_by_verdict_and_a_line_of_text(run, told):
    loops = run.loops
    for verdict in ("accepted", "rejected"):
        count = sum(loop.verdict == verdict for loop in loops)
        entity = f"/world/loops/{verdict}"
        assert (len(told.one(entity, "LineStrips3D:strips")) if entity in told.chunks else 0) == count
    said = told.values("/log/loops", "TextLog:text") if "/log/loops" in told.chunks else []
    assert [stamp for stamp, _ in said] == sorted(loop.stamp_j_ns for loop in loops)


def test_the_voxels_are_the_occupied_ones(run, told):
    occupied = maps_of(run).octree.occupied()
    indices = told.one("/world/map/voxels", "VoxelGridMap:voxel_indices")
    edge_m = told.one("/world/map/voxels", "VoxelGridMap:voxel_size")[0]
    np.testing.assert_allclose((indices + 0.5) * edge_m, occupied, atol=1e-5)
    assert len(told.one("/world/map/voxels", "VoxelGridMap:colors")) == len(occupied)


def test_the_slice_lies_as_rerun_s_own_importer_lays_the_one_in_the_mcap(run, told):
    ours = told.one("/world/map/slice", "GridMap:data")[0]
    imported = [
        chunk.to_record_batch()
        for chunk in rr.chunk.McapReader(run.path / "run.mcap").stream()
        if chunk.entity_path == "/map/slice" and chunk.timeline_names
    ]
    assert ours.tolist() == imported[0].column("GridMap:data")[0].as_py()[0]
    placed = imported[0].column("GridMap:translation")[0].as_py()[0]
    np.testing.assert_allclose(told.one("/world/map/slice", "GridMap:translation")[0], placed, atol=1e-6)


def test_images_come_from_the_run_s_own_log(run, told):
    snapshots = list(snapshots_of(run))
    rows = told.values("/world/body/camera", "EncodedImage:blob")
    assert len(rows) == len(snapshots) == -(-len(run.trajectory) // run.config.mcap.image_stride)
    assert [stamp for stamp, _ in rows] == [snapshot.stamp_ns for snapshot in snapshots]
    assert bytes(rows[0][1][0]) == snapshots[0].jpeg
    matrix = told.one("/world/body/camera", "Pinhole:image_from_camera")[0]
    np.testing.assert_allclose(matrix.reshape(3, 3).T, snapshots[0].camera.matrix, rtol=1e-6)


def test_diagnostics_are_curves(run, told):
    for name in ("features", "matches", "inliers", "residual"):
        rows = told.values(f"/diagnostics/{name}", "Scalars:scalars")
        wanted = [(record.stamp_ns, getattr(record.diagnostics, name)) for record in run.records]
        assert [(stamp, value[0]) for stamp, value in rows] == wanted
    assert len(told.values("/diagnostics/ms", "Scalars:scalars")) == len(run.records)


def test_a_run_without_images_loops_and_truth_can_be_told(desk_log, tmp_path):
    config = BuildConfig.model_validate({"mcap": {"image_stride": 0}, "loops": {"kind": "none"}})
    source = replace(open_source(desk_log), truth=None)
    run = build(source, config, tmp_path / "bare")
    show_run(run, str(tmp_path / "bare.rrd"))
    entities = Told(tmp_path / "bare.rrd").chunks
    assert not {"/world/path/truth", "/world/body/camera", "/log/loops"} & entities.keys()


def test_the_recording_verifies_and_brings_its_blueprint(run, told):  # noqa: ARG001  which writes it
    path = run.path / "told.rrd"
    subprocess.run([str(RERUN), "rrd", "verify", str(path)], check=True, capture_output=True)
    assert len(rr.chunk.RrdReader(path).blueprints()) == 1


def test_a_recording_that_fails_leaves_no_file(tmp_path):
    with pytest.raises(DataError), recorded(str(tmp_path / "x.rrd"), name="x", has_images=True):
        raise DataError("stop")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("target", ["run.mcap", "spam", "connect:nonsense", ""])
def test_a_target_is_refused_at_once(target):
    with pytest.raises(ConfigError, match=r"want FILE\.rrd, spawn, connect or connect:rerun\+http"):
        check_target(target)


def test_a_viewer_that_does_not_answer_is_one_line(run):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(ViewerError, match=f"no viewer answers at rerun.http://127.0.0.1:{port}/proxy"):
        show_run(run, f"connect:rerun+http://127.0.0.1:{port}/proxy")


def test_no_screen_is_one_line(run, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(ViewerError, match="there is no screen"):
        show_run(run, "spawn")


_VIEWER = """#!{python}
import socket, sys
options = dict(zip(sys.argv[1::2], sys.argv[2::2]))
open({told!r}, "w").write(options["--bind"])
with socket.create_server((options["--bind"], int(options["--port"]))) as server:
    server.settimeout(30)
    server.accept()
"""


def test_a_viewer_that_is_started_listens_on_this_machine_only(tmp_path, monkeypatch):
    viewer, told = tmp_path / "rerun", tmp_path / "told"
    viewer.write_text(_VIEWER.format(python=sys.executable, told=str(told)))
    viewer.chmod(0o755)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    connected = []

    class Recording:
        def connect_grpc(self, url, **_):
            connected.append(url)

        def flush(self, **_):
            pass

    with streaming(Recording(), "spawn", None, keeps=lambda: False):
        assert told.read_text() == "127.0.0.1"
        assert connected[0].startswith("rerun+http://127.0.0.1:")


def test_the_verb_keeps_the_recording_in_the_run(run, tmp_path):
    result = invoke("view", run.path)
    assert result.stdout == f"{run.path / 'run.rrd'}\n"
    assert "/world/path/estimate" in Told(run.path / "run.rrd").chunks

    other = tmp_path / "other.rrd"
    assert invoke("view", run.path, "--rrd", other, "--quiet").output == ""
    again = invoke("view", run.path, "--rrd", other)
    assert (again.exit_code, "pass --overwrite" in again.stderr) == (1, True)
    both = invoke("view", run.path, "--rrd", other, "--spawn")
    assert both.stderr == "mapper: --rrd, --spawn, --connect and --html: choose one\n"
