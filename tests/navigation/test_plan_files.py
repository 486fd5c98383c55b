import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from mapper.config.build import BuildConfig
from mapper.core.errors import DataError, RunError
from mapper.core.trajectory import Trajectory
from mapper.export.mcap_log import McapLog
from mapper.export.plan import write_plan
from mapper.export.transforms import root_of
from mapper.navigation.config import PlanConfig
from mapper.navigation.planner import plan_2d
from mapper.octree.grid import FREE, OccupancyGrid
from mapper.run.folder import Run
from mapper.run.manifest import Manifest
from mapper.run.manifest_logs import Input
from mapper.sources.trajectory_files import write_tum

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def grid():
    return OccupancyGrid(np.full((40, 60), FREE, np.int8), np.array([-1.0, 0.5]), 0.05)


@pytest.fixture
def run(tmp_path, grid):
    """Return as much of a run as a plan needs, its log in two topics out of time order."""
    trajectory = Trajectory(START_NS + np.arange(3) * 10**8, np.tile(np.eye(4), (3, 1, 1)))
    write_tum(tmp_path / "trajectory.tum", trajectory)
    with McapLog(tmp_path / "run.mcap") as log:
        for stamp_ns in trajectory.stamps_ns[::-1]:
            log.transform(int(stamp_ns), np.eye(4), parent="world", child="body")
        log.grid(START_NS, grid)
        log.diagnostics(START_NS, {"inliers": 7})
    manifest = Manifest(status="complete", input=Input(path="log", kind="tum", fingerprint="none"))
    manifest.save(tmp_path / "manifest.json")
    return Run(tmp_path, BuildConfig(), manifest)


@pytest.fixture
def plan(grid):
    return plan_2d(grid, np.array([-0.5, 1.0]), np.array([1.5, 2.0]), config=PlanConfig())


def messages(path):
    with path.open("rb") as file:
        return [
            (
                channel.topic,
                channel.message_encoding,
                schema.name,
                schema.data,
                message.log_time,
                message.data,
            )
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(
                log_time_order=False
            )
        ]


def flipped(data):
    """Damage the middle of the first chunk."""
    return data[:600] + bytes(255 - value for value in data[600:640]) + data[640:]


def test_a_plan_joins_the_log_and_leaves_the_rest_alone(run, plan, grid):
    before = messages(run.path / "run.mcap")

    write_plan(run, plan, grid=grid)

    after = messages(run.path / "run.mcap")
    assert after[: len(before)] == before
    assert [(message[0], message[4]) for message in after[len(before) :]] == [
        ("/plan", START_NS),
        ("/plan/dots", START_NS),
    ]


def test_a_plan_is_in_the_frame_of_the_log_s_poses(run, plan, grid):
    """It was called world before it was called map."""
    write_plan(run, plan, grid=grid)
    assert root_of(run.path / "run.mcap") == ("world", "body")
    with (run.path / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        plans = [decoded for *_, decoded in reader.iter_decoded_messages(topics=["/plan", "/plan/dots"])]
    assert [one.frame_id for one in plans] == ["world", "world"]


def test_a_new_plan_replaces_the_old_one_and_the_same_plan_gives_the_same_bytes(run, plan, grid):
    write_plan(run, plan, grid=grid)
    first = (run.path / "run.mcap").read_bytes()
    write_plan(run, plan_2d(grid, np.array([0.0, 1.0]), np.array([0.0, 2.0]), config=PlanConfig()), grid=grid)
    assert sum(message[0] == "/plan" for message in messages(run.path / "run.mcap")) == 1
    write_plan(run, plan, grid=grid)
    assert (run.path / "run.mcap").read_bytes() == first


def test_the_json_contains_the_whole_plan(run, plan, grid):
    write_plan(run, plan, grid=grid)
    record = json.loads((run.path / "plan.json").read_text())
    assert record["waypoints_world_m"] == [[-0.5, 1.0], [1.5, 2.0]]
    assert record["length_m"] == pytest.approx(np.hypot(2.0, 1.0))
    assert (record["map"], record["radius_m"], record["unknown"]) == ("slice", 0.2, "blocked")
    assert (run.path / "plan.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "damage",
    [lambda data: data[:-200], lambda _: b"no log", lambda _: b"", flipped],
    ids=["cut", "foreign", "empty", "flipped"],
)
def test_a_damaged_log_is_refused_and_stays_as_it_is(run, plan, grid, damage):
    path = run.path / "run.mcap"
    path.write_bytes(damage(path.read_bytes()))
    damaged = path.read_bytes()
    with pytest.raises(DataError, match=r"run\.mcap: cannot be read as MCAP"):
        write_plan(run, plan, grid=grid)
    assert path.read_bytes() == damaged
    assert not list(run.path.glob(".run*"))


def test_a_run_without_a_log_is_named(run, plan, grid):
    (run.path / "run.mcap").unlink()
    with pytest.raises(RunError, match=r"run\.mcap: is missing from the run; make it again with mapper fuse"):
        write_plan(run, plan, grid=grid)
