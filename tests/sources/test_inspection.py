import json
import re

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.export.mcap_log import McapLog
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.decoded import encode_depth
from mapper.sources.inspection import inspect_log, timing_of
from mapper.sources.ros.encode_ros import cloud_message
from tests.support.command_line import invoke
from tests.support.recordings import CAMERA, COLOR, DEPTH, shots, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS

MS = 1_000_000


def printed(*arguments, status=0):
    result = invoke("inspect", *arguments)
    assert result.exit_code == status, result.output
    return result.stdout


def test_timing_tells_rates_and_gaps():
    timing = timing_of(np.array([300, 0, 100, 200, 900, 1000], np.int64) * MS)
    assert (timing.count, timing.first_ns, timing.duration_s) == (6, 0, 1.0)
    assert (timing.rate_hz, timing.gaps, timing.longest_gap_s) == (10.0, 1, 0.6)
    alone = timing_of(np.array([5], np.int64))
    assert (alone.rate_hz, alone.gaps, alone.longest_gap_s) == (0.0, 0, 0.0)


@pytest.mark.parametrize("name", ["log.mcap", "log.bag", "log"])
def test_a_recording_tells_its_topics_and_its_frames(tmp_path, name):
    found = inspect_log(write(tmp_path / name, shots(6)), SourceConfig())
    assert [(topic.name, topic.timing.count) for topic in found.topics] == [
        (DEPTH, 6), ("/cam/color/camera_info", 6), (COLOR, 6)
    ]  # fmt: skip
    assert {topic.encoding for topic in found.topics} == {"ros1" if name == "log.bag" else "cdr"}
    assert found.topics[2].timing.first_ns == FIRST_NS
    assert found.topics[2].timing.duration_s == pytest.approx(5 * PERIOD_NS / 1e9)
    assert (found.log.sensor, found.log.frames.count, found.log.truth) == ("rgbd", 6, None)
    assert found.log.content.startswith("colour and depth of 64×48 px, the first 94% measured")
    assert f"{CAMERA.fx_px:g}" in found.log.calibration
    assert found.problem is None


@pytest.mark.parametrize(("first_ms", "at"), [(0.0, "first"), (-99.0, "last"), (-50.0, None)])
def test_the_point_that_was_measured_at_the_stamp_is_named(tmp_path, first_ms, at):
    points = np.random.default_rng(0).uniform(1.0, 9.0, (100, 3)).astype(np.float32)
    times_s = np.linspace(first_ms, first_ms + 99.0, 100).astype(np.float32) / 1e3
    scans = [Scan(FIRST_NS + k * 100 * MS, points, times_s=times_s) for k in range(2)]
    path = write(tmp_path / "log.mcap", [cloud_message("/points", scan, frame="lidar") for scan in scans])
    told = inspect_log(path, SourceConfig()).log.point_times
    assert told.startswith(f"{first_ms:.1f} … {first_ms + 99.0:.1f} ms")
    assert [name for name in ("first", "last") if name in told] == ([] if at is None else [at])


def test_a_folder_tells_its_frames_truth_both_sizes_and_what_is_resized(tiny_tum_log):
    log = tiny_tum_log(5)
    for path in (log / "depth").iterdir():
        path.write_bytes(encode_depth(np.full((24, 32), 1.0, np.float32), 5000.0))
    found = inspect_log(log, SourceConfig())
    assert (found.log.kind, found.log.frames.count, list(found.topics)) == ("tum", 5, [])
    assert found.log.truth == "5 poses over 0.0 m, within 20 ms of 5 of 5 frames"
    assert found.log.content.startswith("colour and depth of 64×48 px")
    assert any("colour of 64×48 and depth of 32×24 px" in note for note in found.log.notes)


def test_a_run_of_our_own_is_recognised(tmp_path):
    with McapLog(tmp_path / "run.mcap") as log:
        for i in range(3):
            log.transform(FIRST_NS + i, np.eye(4), parent="world", child="body")
            log.diagnostics(FIRST_NS + i, {"inliers": i})
            log.cloud(FIRST_NS + i, np.zeros((2, 3)), colors=np.zeros((2, 3), np.uint8), name="cloud")
    found = inspect_log(tmp_path / "run.mcap", SourceConfig())
    assert "a run that mapper wrote" in found.problem
    assert {topic.name: topic.timing.count for topic in found.topics} == {
        "/diagnostics": 3,
        "/map/cloud": 3,
        "/tf": 3,
    }


def test_the_verb_prints_a_table_and_json(tmp_path):
    log = write(tmp_path / "log.mcap", shots(10))
    text = printed(log)
    for words in (
        "mcap, called log",
        "10: 0.3 s at 30.0 Hz, no gaps",
        "rgbd frames, odometry local-map",
        "sensor_msgs/msg/Image",
    ):
        assert words in text
    facts = json.loads(printed(log, "--json"))
    assert facts["log"]["frames"]["count"] == 10
    assert facts["topics"][2]["name"] == COLOR
    assert facts["build"].startswith("rgbd frames, odometry local-map")
    assert "choose others" not in printed(
        log, "--set", f"source.topics.color={COLOR}", "--set", f"source.topics.depth={DEPTH}"
    )


@pytest.mark.parametrize("kind", ["given", "wheels"])
def test_poses_that_the_settings_want_and_the_log_lacks_are_refused(tmp_path, kind):
    text = printed(write(tmp_path / "log.mcap", shots(12)), "--set", f"odometry.kind={kind}", status=1)
    assert f"mapper build  nothing: odometry.kind={kind}: the log has n" in text


@pytest.mark.parametrize("left", [9, 10])
def test_scans_that_cannot_be_read_do_not_count(tmp_path, left):
    """Those of another frame that tf does not connect, among others, cannot be read."""
    points = np.random.default_rng(0).uniform(1.0, 9.0, (3000, 3)).astype(np.float32)
    frames = ["lidar"] * (left - 1) + ["other"] * 7 + ["lidar"]
    clouds = [
        cloud_message("/points", Scan(FIRST_NS + k * 100 * MS, points + np.float32(0.01 * k)), frame=frame)
        for k, frame in enumerate(frames)
    ]
    text = printed(write(tmp_path / "log.mcap", clouds), status=int(left < 10))
    assert ("7 of 16 clouds are in frames" in text) == (left == 9)
    assert ("want at least 10" in text) == (left == 9)


@pytest.mark.parametrize("still", [0, 11])
def test_scans_of_a_frozen_lidar_do_not_count(tmp_path, still):
    points = np.random.default_rng(0).uniform(1.0, 9.0, (3000, 3)).astype(np.float32)
    moved = [0.01 * max(k - still, 0) for k in range(14)]
    clouds = [
        cloud_message("/points", Scan(FIRST_NS + k * 100 * MS, points + np.float32(m)), frame="lidar")
        for k, m in enumerate(moved)
    ]
    text = printed(write(tmp_path / "log.mcap", clouds), status=int(still > 0))
    assert ("frozen? " in text or "frozen?\n" in text) == (still > 0)


def test_the_exit_status_is_1_where_nothing_can_be_mapped(tmp_path, tiny_tum_log):
    only_colour = [message for message in shots(3) if message.topic == COLOR]
    log = write(tmp_path / "log.mcap", only_colour)
    found = inspect_log(log, SourceConfig())
    assert (found.log, [topic.name for topic in found.topics]) == (None, [COLOR])
    text = printed(log, status=1)
    assert "mapper build  nothing: " in text
    assert COLOR in text
    assert json.loads(printed(log, "--json", status=1))["build"].startswith("nothing: ")

    damaged = tiny_tum_log(3)
    for path in (damaged / "depth").iterdir():
        path.write_bytes(b"")
    text = printed(damaged, status=1)
    assert "frames        3: " in text
    assert "mapper build  nothing: no frame can be read: " in text
    assert "empty file" in text


def test_a_log_of_too_few_frames_cannot_be_mapped(tiny_tum_log):
    log = tiny_tum_log(3)
    assert "nothing: only 3 frames were read, want at least 10 (min_tracked_frames)" in printed(log, status=1)
    assert printed(log, "--set", "min_tracked_frames=3").count("nothing") == 0
    assert json.loads(printed(log, "--json", status=1))["problem"].startswith("only 3 frames were read")


def test_the_box_of_the_vehicle_is_printed_with_the_setting_that_keeps_it(tmp_path):
    rng = np.random.default_rng(0)
    for k in range(10):
        vehicle = rng.uniform((-1.0, -0.5, -0.4), (-0.6, 0.5, -0.3), (300, 3))
        world = rng.uniform((-12.0, -12.0, 0.0), (12.0, 12.0, 3.0), (400, 3))
        ground = np.column_stack([rng.uniform(-12.0, 12.0, (400, 2)), np.full(400, -1.7)])
        cloud = np.concatenate([vehicle, world, ground]).astype(np.float32)
        np.save(tmp_path / f"{k:06d}.npy", cloud)

    told = invoke("inspect", tmp_path).stdout
    setting = re.search(r"source\.body\.find_box=false", told).group()
    assert "own vehicle" not in invoke("inspect", tmp_path, "--set", setting).stdout
    assert len(json.loads(invoke("inspect", tmp_path, "--json").stdout)["log"]["vehicle"]) == 6


def test_stamps_that_no_run_can_have_are_said_before_anything_is_tracked(tiny_tum_log, tmp_path):
    log = tiny_tum_log(12)
    for name in ("rgb", "depth"):
        lines = (log / f"{name}.txt").read_text().splitlines()[1:]
        (log / f"{name}.txt").write_text("".join(f"-{line[9:]}\n" for line in reversed(lines)))
    reason = "MCAP messages hold 0 … 2³¹ s (1970 to 2038); shift the log"
    assert reason in inspect_log(log, SourceConfig()).problem
    result = invoke("build", log, "--out", tmp_path / "run")
    assert result.exit_code == 1
    assert reason in result.stderr
    assert not list(tmp_path.glob("run*"))
