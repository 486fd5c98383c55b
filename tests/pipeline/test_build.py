import json
import shutil

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from mapper.config.loading import load_config, overridden
from mapper.core.errors import ConfigError, RunError, TrackingError
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.export.run_maps import maps_of
from mapper.octree.grid import read_grid
from mapper.octree.map import read_octree
from mapper.pipeline.build import build
from mapper.pipeline.fuse import fuse
from mapper.run.folder import open_run
from mapper.run.manifest import read_manifest
from mapper.sensing.depth import depth_sigma_m
from mapper.sources import open_source
from mapper.sources.cloud_files import read_cloud
from tests.support.desk import REPEATABLE
from tests.support.files import files_of
from tests.support.progress import Observer


def build_run(log, out, *overrides, **options):
    config = load_config(None, overrides)
    return build(open_source(log, config.source), config, out, **options)


@pytest.fixture
def run(desk_run):
    return desk_run


@pytest.fixture
def damaged_log(desk_log, tmp_path):
    return shutil.copytree(desk_log, tmp_path / "damaged")


def test_every_frame_is_tracked_close_to_the_truth(run):
    counts = run.manifest.counts
    assert counts.listed == counts.tracked == len(run.trajectory) == 31
    assert counts.nodes == len(run.graph.T_world_node) >= 2

    assert ate_rmse_m(run.trajectory, run.truth) < 0.02


def test_the_world_is_levelled_with_the_floor_at_zero(run):
    T_world_body = run.trajectory.T_world_body
    assert run.manifest.levelling.method == "planes"
    assert (T_world_body[:, 2, 3] > 0.5).all()
    assert (T_world_body[:, 2, 3] < 2.0).all()

    truth = run.truth  # the synthetic world's z is up and its floor at 0, so heights agree without alignment
    np.testing.assert_allclose(T_world_body[:, 2, 3], truth.T_world_body[:, 2, 3], atol=0.05)


def test_the_graph_is_the_trajectory_s(run):
    T_by_stamp = dict(zip(run.trajectory.stamps_ns.tolist(), run.trajectory.T_world_body, strict=True))
    graph = run.graph
    for node, stamp_ns in graph.stamps_ns.items():
        np.testing.assert_allclose(graph.T_world_node[node], T_by_stamp[stamp_ns], atol=1e-9)


def test_poses_are_less_certain_the_farther_they_are(run):
    poses = run.poses
    np.testing.assert_allclose(poses.trajectory.T_world_body, run.trajectory.T_world_body, atol=1e-12)
    assert not poses.is_doubtful.any()
    np.testing.assert_array_equal(poses.covariances[0], np.zeros((6, 6)))
    sigmas_m = poses.position_sigmas_m
    assert 0.0 < sigmas_m[10] < sigmas_m[-1] < 0.2


def test_the_maps_agree_with_each_other(run):
    octree = read_octree(run.path / "map.ot")
    grid = read_grid(run.path / "slice.yaml")
    assert len(octree) == run.manifest.counts.leaves > 1000
    assert grid.resolution_m == octree.resolution_m == run.config.octree.resolution_m
    assert {0, 100} <= set(np.unique(grid.cells))

    row, column = np.argwhere(grid.cells == 100)[0]
    x, y = grid.origin_world_m + (np.array([column, row]) + 0.5) * grid.resolution_m
    heights_m = np.arange(0.1, 1.2, 0.05) + 0.025
    column_log_odds = octree.log_odds_at(np.array([[x, y, z] for z in heights_m]))
    assert (column_log_odds >= octree.occupied_log_odds).any()


def test_every_point_of_the_cloud_lies_in_an_occupied_voxel(run):
    cloud = read_cloud(run.path / "cloud.ply", scale=1.0).points
    assert len(cloud) == run.manifest.counts.cloud_points > 1000
    for name in ("map.ot", "map.octree"):
        assert read_octree(run.path / name).are_occupied(cloud).all()


def test_depth_counts_as_far_as_its_noise_is_below_a_voxel(run, desk_log, tmp_path):
    reach = run.manifest.depth
    sigma_m = depth_sigma_m(reach.noise, np.array([reach.limit_m]))[0]
    assert sigma_m == pytest.approx(run.config.octree.resolution_m)
    assert reach.detail.startswith("measured on planes")
    assert 3.0 < reach.limit_m < 8.0, "the camera is simulated after a Kinect"

    copy = open_run(shutil.copytree(run.path, tmp_path / "run"))
    again = fuse(
        open_source(desk_log, run.config.source), copy, overridden(run.config, ["octree.max_range_m=1"])
    )
    assert again.manifest.depth is None
    assert again.manifest.counts.leaves < run.manifest.counts.leaves


def test_a_desk_where_nothing_moves_loses_nothing(run):
    maps = maps_of(run)

    assert len(maps.dynamic) == run.manifest.counts.dynamic_points
    assert len(maps.dynamic) < 0.005 * len(maps.cloud)
    assert not maps.octree.are_occupied(maps.dynamic.points).any()


def test_the_log_holds_the_whole_story(run):
    with (run.path / "run.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    topics = {
        summary.channels[channel].topic: count
        for channel, count in summary.statistics.channel_message_counts.items()
    }
    assert topics["/tf"] == 31
    assert topics["/pose"] == 31
    assert topics["/diagnostics"] == 31
    assert topics["/camera/image"] == 4
    assert {"/trajectory/estimate", "/trajectory/truth", "/graph/factors"} <= set(topics)
    assert {"/map/octree", "/map/cloud", "/map/slice"} <= set(topics)
    stamps = run.trajectory.stamps_ns
    assert summary.statistics.message_start_time == stamps[0]
    assert summary.statistics.message_end_time == stamps[-1]


@pytest.mark.usefixtures("drawn_builds")
def test_the_same_log_gives_the_same_bytes(run, desk_log, tmp_path):
    again = build_run(desk_log, tmp_path / "again", REPEATABLE, "workers=1")

    ours, theirs = files_of(again.path), files_of(run.path)
    assert ours.keys() == theirs.keys()
    assert overridden(again.config, ["workers=2"]) == run.config
    elsewhere = {"timing": run.manifest.timing, "files": run.manifest.files}
    assert again.manifest.model_copy(update=elsewhere) == run.manifest
    assert again.manifest.files.keys() == run.manifest.files.keys() == ours.keys() - {"manifest.json"}
    for name in ours.keys() - {"config.json", "manifest.json", "frame_ms.csv"}:
        assert ours[name] == theirs[name], name


def test_fusing_again_changes_the_maps_alone(run, desk_log, tmp_path):
    fine = open_run(shutil.copytree(run.path, tmp_path / "fine"))
    config = overridden(fine.config, ["octree.resolution_m=0.1", "slice.max_height_m=0.8"])

    fused = fuse(open_source(desk_log), fine, config)

    direct = build_run(
        desk_log, tmp_path / "direct", REPEATABLE, "octree.resolution_m=0.1", "slice.max_height_m=0.8"
    )
    ours, theirs = files_of(fused.path), files_of(direct.path)
    for name in ours.keys() - {"manifest.json", "frame_ms.csv"}:
        assert ours[name] == theirs[name], name
    assert fused.manifest.counts == direct.manifest.counts
    before, after = run.manifest.timing, fused.manifest.timing
    assert after.stage_s.keys() == before.stage_s.keys()
    assert after.stage_s["track"] == before.stage_s["track"]
    assert after.total_s == pytest.approx(sum(after.stage_s.values()))


def test_fusing_spares_a_user_s_files_and_learns_where_the_log_is(run, desk_log, tmp_path):
    own = open_run(shutil.copytree(run.path, tmp_path / "own"))
    (own.path / "notes").mkdir()
    (own.path / "notes" / "monday.txt").write_text("the door was open")
    (own.path / "mesh.ply").write_bytes(b"of the same trajectory")
    (own.path / "voxels.ply").write_bytes(b"of the old map")
    moved = shutil.copytree(desk_log, tmp_path / "moved")

    fused = fuse(open_source(moved), own, overridden(own.config, ["octree.resolution_m=0.2"]))

    assert (own.path / "notes" / "monday.txt").read_text() == "the door was open"
    assert (own.path / "mesh.ply").exists()
    assert not (own.path / "voxels.ply").exists()
    assert fused.manifest.input == run.manifest.input.model_copy(update={"path": str(moved)})


def test_fusing_refuses_what_it_cannot_change(run, desk_log):
    before = files_of(run.path)
    with pytest.raises(ConfigError, match="odometry: fuse keeps what was tracked"):
        fuse(open_source(desk_log), run, overridden(run.config, ["odometry.max_depth_m=3"]))
    assert files_of(run.path) == before


def test_fusing_refuses_another_log(run, damaged_log):
    (damaged_log / "rgb.txt").write_text((damaged_log / "rgb.txt").read_text() + "\n")
    with pytest.raises(RunError, match="changed since"):
        fuse(open_source(damaged_log), run, run.config)


def test_bad_frames_are_skipped_counted_and_reported(damaged_log, tmp_path):
    images = sorted((damaged_log / "rgb").iterdir())
    images[5].write_bytes(images[5].read_bytes()[:500])
    depths = sorted((damaged_log / "depth").iterdir())
    depths[9].write_bytes(b"")
    observer = Observer()

    run = build_run(damaged_log, tmp_path / "run", progress=observer)

    assert run.manifest.counts.skipped == len(run.manifest.skipped) == 2
    assert run.manifest.counts.tracked == 29
    assert images[5].name in run.manifest.skipped[0].reason
    assert [record.outcome for record in run.records].count("skipped") == 2
    assert sum(note.startswith("skipped: ") for note in observer.notes) == 2
    assert observer.reached == {"track": (31, 31), "fuse": (29, 29), "cloud": (3, 3)}


def test_a_log_of_few_frames_is_told_from_one_that_is_hard_to_track(damaged_log, tmp_path):
    images = sorted((damaged_log / "rgb").iterdir())
    images[5].write_bytes(b"")
    for last, message in (
        (3, "^only 4 frames were read, want at least 10 "),
        (6, rf"; 1 .*{images[5].name}"),
    ):
        with pytest.raises(TrackingError, match=message):
            build_run(damaged_log, tmp_path / "run", f"source.last_frame={last}")


def test_a_log_with_almost_no_texture_and_depth_ends_in_an_error(damaged_log, tmp_path):
    for image in (damaged_log / "rgb").iterdir():
        image.write_bytes(_black_png())
    for depth in (damaged_log / "depth").iterdir():
        recorded = np.zeros_like(cv2.imread(str(depth), cv2.IMREAD_UNCHANGED))
        recorded[0, 0] = 5000
        cv2.imwrite(str(depth), recorded)

    with pytest.raises(TrackingError, match="only 0 of 31 frames read could be tracked, want at least 10"):
        build_run(damaged_log, tmp_path / "run")

    partial = tmp_path / "run.partial"
    assert read_manifest(partial / "manifest.json").status == "failed"
    assert (partial / "frames.csv").read_text().count("lost") >= 31
    assert not (tmp_path / "run").exists()


def test_a_log_of_which_nothing_can_be_read_names_the_first_reason(damaged_log, tmp_path):
    for depth in (damaged_log / "depth").iterdir():
        depth.write_bytes(b"")

    with pytest.raises(TrackingError, match=r"none of 31 frames could be read; the first: .*depth"):
        build_run(damaged_log, tmp_path / "run")


@pytest.mark.parametrize("stage", ["track", "fuse"])
def test_an_interrupted_build_says_so_and_spares_the_old_run(run, desk_log, tmp_path, stage):
    old = shutil.copytree(run.path, tmp_path / "run")
    before = files_of(old)

    with pytest.raises(KeyboardInterrupt):
        build_run(desk_log, old, progress=Observer(stage, 12), overwrite=True)

    assert files_of(old) == before
    assert json.loads((tmp_path / "run.partial" / "manifest.json").read_text())["status"] == "interrupted"
    hidden = sorted(path.name for path in (tmp_path / "run.partial").glob(".*"))
    assert hidden == [".checkpoints.part", ".mapper.part"]


def test_a_scan_alone_is_the_frame_s(desk_log):
    entry = next(iter(open_source(desk_log).entries()))
    np.testing.assert_array_equal(entry.scan().points_body, entry.load().scan().points_body)


def _black_png():
    return cv2.imencode(".png", np.zeros((240, 320, 3), np.uint8))[1].tobytes()
