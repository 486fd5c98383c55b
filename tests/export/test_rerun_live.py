import numpy as np
import pytest

import mapper
from mapper.cli.build import Stepping
from mapper.config.build import RerunConfig
from mapper.core.frames import Scan
from mapper.export.rerun.live import LiveRerun
from mapper.export.rerun.recording import recorded
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.run.folder import open_run
from mapper.run.observers import Step
from tests.support.command_line import invoke
from tests.support.rerun_log import Told


class Log:
    """Standard input with some lines to come."""

    def __init__(self, lines):
        self.lines = list(lines)

    def isatty(self):
        return True

    def readline(self):
        return self.lines.pop(0)


def build_verb(log, out, *arguments):
    return invoke("build", log, "--out", out, "--quiet", *arguments)


@pytest.fixture(scope="module")
def live(desk_log, tmp_path_factory):
    folder = tmp_path_factory.mktemp("live")
    result = build_verb(
        desk_log, folder / "run", "--rerun", folder / "live.rrd", "--set", "rerun.image_stride=5"
    )
    assert (result.exit_code, result.output) == (0, "")
    return open_run(folder / "run"), Told(folder / "live.rrd")


def test_looking_on_changes_nothing(desk_run, live):
    assert (live[0].path / "trajectory.tum").read_bytes() == (desk_run.path / "trajectory.tum").read_bytes()


def test_a_build_is_told_frame_by_frame(live):
    run, told = live
    assert {name for chunks in told.chunks.values() for c in chunks for name in c.timeline_names} == {"stamp"}
    records, trajectory = run.records, run.trajectory
    inliers = told.values("/diagnostics/inliers", "Scalars:scalars")
    assert [(stamp, value[0]) for stamp, value in inliers] == [
        (record.stamp_ns, record.diagnostics.inliers) for record in records
    ]
    body = told.values("/world/live/body", "Transform3D:translation")
    assert [stamp for stamp, _ in body] == trajectory.stamps_ns.tolist()
    assert len(told.values("/diagnostics/ms", "Scalars:scalars")) == len(records)


def test_images_come_with_the_features_that_were_found_and_those_that_agreed(live):
    run, told = live
    records = run.records[::5]
    images = told.values("/world/live/body/camera", "EncodedImage:blob")
    assert [stamp for stamp, _ in images] == [record.stamp_ns for record in records]
    assert bytes(images[0][1][0])[:2] == b"\xff\xd8"
    dots = told.values("/world/live/body/camera/features", "Points2D:positions")
    colors = told.values("/world/live/body/camera/features", "Points2D:colors")
    for record, (_, positions), (_, values) in zip(records, dots, colors, strict=True):
        assert len(positions) == record.diagnostics.features
        _, counts = np.unique(values, return_counts=True)
        assert record.diagnostics.inliers in counts or (record is records[0] and len(counts) == 1)
        assert np.min(positions) >= 0
        assert np.max(positions) <= 320
    ways = told.values("/world/live/body/camera/matches", "LineStrips2D:strips")
    assert [stamp for stamp, _ in ways] == [record.stamp_ns for record in records]
    for record, (_, positions), (_, lines) in zip(records, dots, ways, strict=True):
        assert (record is records[0]) == (len(lines) == 0)
        assert len(lines) <= record.diagnostics.inliers
        assert {tuple(end) for _, end in lines} <= {tuple(position) for position in positions}
    assert len(told.values("/world/live/body/cloud", "Points3D:positions")) == len(records)


def test_estimates_end_up_in_the_levelled_world(live):
    run, told = live
    T = np.eye(4)
    T[:3, :3] = told.one("/world/live", "Transform3D:mat3x3").reshape(3, 3).T
    T[:3, 3] = told.one("/world/live", "Transform3D:translation")[0]
    positions = np.array(
        [value[0] for _, value in told.values("/world/live/body", "Transform3D:translation")]
    )
    on_levelled = positions @ T[:3, :3].T + T[:3, 3]
    assert np.abs(on_levelled - run.trajectory.positions_world).max() < 0.03  # what loops have moved

    paths = [value for _, value in told.values("/world/live/estimates", "LineStrips3D:strips") if value]
    assert len(paths[-1][0]) > 0.9 * run.manifest.counts.nodes
    graph = [value for _, value in told.values("/world/live/factors", "LineStrips3D:strips") if value]
    assert len(graph[-1]) >= len(paths[-1][0]) - 1


def test_the_results_follow(live):
    run, told = live
    estimate = told.one("/world/path/estimate", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(estimate, run.trajectory.positions_world, atol=1e-6)
    assert {
        "/world/map/voxels",
        "/world/map/slice",
        "/slice",
        "/about",
        "/world/graph/nodes",
    } <= told.chunks.keys()


def test_a_scan_is_a_cloud_without_an_image(tmp_path):
    class FrameRef:
        def load(self):
            return Scan(7, np.zeros((50_000, 3), np.float32))

    class LoopDetector:
        def closures(self):
            return ()

        def current_estimate(self, _node):
            return np.eye(4)

    path = tmp_path / "scan.rrd"
    diagnostics = Diagnostics(50_000, 100, 90, 0.1, "m", "icp")
    with recorded(str(path), name="scan", has_images=False, body="world/live/body") as log:
        observer = LiveRerun(log, "lidar", RerunConfig(cloud_points=10_000))
        track = FrameResult(7, 0, np.eye(4), np.eye(4), True, diagnostics)
        observer.on_frame(Step(FrameRef(), track, lambda: None, lambda: None, LoopDetector()))
    told = Told(path)
    assert len(told.values("/world/live/body/cloud", "Points3D:positions")[0][1]) == 10_000
    assert "/world/live/body/camera" not in told.chunks


def test_a_build_that_fails_leaves_what_was_seen(desk_log, tmp_path):
    seen = tmp_path / "seen.rrd"
    result = build_verb(desk_log, tmp_path / "run", "--rerun", seen, "--last", 4)
    assert result.exit_code == 1
    assert f"what it recorded so far is in {seen}" in result.stderr
    assert len(Told(seen).values("/diagnostics/features", "Scalars:scalars")) == 5


def test_a_build_that_is_refused_leaves_no_recording(desk_log, desk_run, tmp_path):
    result = build_verb(desk_log, desk_run.path, "--rerun", tmp_path / "seen.rrd")
    assert "pass --overwrite to replace it" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_stepping_waits_after_each_frame_until_told_to_run_on(desk_log, tmp_path, monkeypatch):
    keys = Log(["\n", "\n", "c\n"])
    monkeypatch.setattr("mapper.cli.build.sys.stdin", keys)
    path = tmp_path / "stepped.rrd"
    mapper.build(
        desk_log,
        out=tmp_path / "run",
        settings={"source.last_frame": 11},
        rerun=str(path),
        observer=Stepping(),
    )
    assert keys.lines == []
    assert len(Told(path).values("/diagnostics/features", "Scalars:scalars")) == 12


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--step"], "--step: has no meaning without --rerun"),
        (["--step", "--onto", "RUN"], "--step: has no meaning without --rerun"),
        (["--rerun", "LIVE", "--step"], "--step: waits for Enter after each frame"),
        (["--rerun", "spam"], "rerun target 'spam': want FILE.rrd, spawn, connect or connect:rerun+http"),
        (["--rerun", "THERE"], "exists already; choose another --rerun, or pass --overwrite to replace it"),
        (["--rerun", "LIVE", "--onto", "RUN"], "has no meaning with --onto; look at the new run"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(desk_log, desk_run, tmp_path, arguments, message):
    there = tmp_path / "there.rrd"
    there.touch()
    names = {"LIVE": str(tmp_path / "live.rrd"), "THERE": str(there), "RUN": str(desk_run.path)}
    result = build_verb(desk_log, tmp_path / "run", *(names.get(word, word) for word in arguments))
    assert (result.exit_code, len(result.stderr.splitlines())) == (1, 1)
    assert message in result.stderr
    assert not (tmp_path / "live.rrd").exists()
