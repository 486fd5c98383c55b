"""Many runs become one map: the same bytes whoever does the work, and those of a merge in memory."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapper.cli.main import app
from mapper.core.errors import ConfigError, DataError, RunError
from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory
from mapper.merging import jobs as merging_jobs
from mapper.merging.merged_map import open_map
from mapper.merging.world_poses import Placed, as_built, by_poses, by_truth, warnings_about
from mapper.octree.map import OctreeMap
from mapper.octree.octomap_file import write_bt, write_ot
from mapper.octree.resampling import blocks_reached, resample
from mapper.run.files import SUMMARY
from mapper.run.folder import open_run
from mapper.run.manifest import Verdict
from mapper.runtime import resumable_jobs
from mapper.runtime.executor import run_jobs
from mapper.sources.trajectory_files import write_tum
from tests.support.counted_jobs import run_elsewhere
from tests.support.merged_runs import make_run, merged_map_of
from tests.support.octree_maps import COLORED, CONFIG, as_dict, mapped, total


@pytest.fixture(scope="module")
def maps():
    return [mapped(seed, config=COLORED) for seed in range(8)]


@pytest.fixture(scope="module")
def runs(maps, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return [make_run(folder / f"run{i}", octree, log=f"sha256:{i}") for i, octree in enumerate(maps)]


@pytest.fixture(scope="module")
def merged(runs, tmp_path_factory):
    return merged_map_of(as_built(runs), tmp_path_factory.mktemp("merged") / "map").map


@pytest.fixture
def undrawn(monkeypatch):
    """Spare the picture, which takes half a second."""
    monkeypatch.setattr("mapper.merging.merge.draw", lambda *_: None)


def bytes_of(folder, *, but=""):
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != but)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_the_bytes_are_the_same_wherever_and_in_whichever_order_jobs_are_done(
    runs, merged, tmp_path, monkeypatch
):
    monkeypatch.setattr(resumable_jobs, "run_jobs", run_elsewhere)
    merged_map_of(as_built(runs), tmp_path / "elsewhere")
    assert bytes_of(tmp_path / "elsewhere") == bytes_of(merged.path)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("config", [CONFIG, COLORED], ids=["plain", "colours"])
def test_the_files_are_those_of_the_maps_added_up_in_memory(maps, tmp_path, config):
    maps = maps[:4]
    octree, overlaps = total(maps, config=config)
    write_bt(tmp_path / "whole.bt", octree)
    write_ot(tmp_path / "whole.ot", octree)
    plain = [total([each], config=config)[0] for each in maps]
    runs = [make_run(tmp_path / f"run{i}", each) for i, each in enumerate(plain)]

    found = merged_map_of(as_built(runs), tmp_path / "map", tile_m=2.4).map

    assert (found.path / "map.bt").read_bytes() == (tmp_path / "whole.bt").read_bytes()
    assert (found.path / "map.ot").read_bytes() == (tmp_path / "whole.ot").read_bytes()
    assert found.manifest.voxels == len(octree)
    assert [run.shared_voxels for run in found.manifest.runs] == [each.shared for each in overlaps]
    assert len(found.manifest.tiles) > 8
    whole = found.load(np.full(3, -100.0), np.full(3, 100.0))
    assert as_dict(whole) == as_dict(octree)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("config", [CONFIG, COLORED], ids=["plain", "colours"])
def test_leaves_larger_than_a_tile_are_pruned_across_tiles(tmp_path, config):
    octree = OctreeMap(config)
    codes = np.concatenate([np.arange(64) + (1 << 30), np.arange(8) + (1 << 31), [3]])
    values = np.full((len(codes), 512), octree.sensor.lowest)
    values[-2, 7] = octree.sensor.highest
    octree.restore_blocks(codes, np.ones(values.shape, bool), values[np.ones(values.shape, bool)])
    if octree.attributes is not None:
        arrays = octree.attributes.arrays._replace()
        rows = octree.attributes.claim(np.arange(0, len(codes), 2))
        arrays = octree.attributes.arrays
        arrays.color_weights[rows] = 1
        arrays.color_sums[rows] = np.random.default_rng(0).integers(0, 256, (len(rows), 512, 3))
    run = make_run(tmp_path / "run", octree)
    write_bt(tmp_path / "whole.bt", octree)
    write_ot(tmp_path / "whole.ot", octree)

    merged_map_of(as_built([run]), tmp_path / "map", tile_m=0.8)

    assert (tmp_path / "map/map.bt").read_bytes() == (tmp_path / "whole.bt").read_bytes()
    assert (tmp_path / "map/map.ot").read_bytes() == (tmp_path / "whole.ot").read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_a_merge_that_was_stopped_is_resumed(runs, merged, tmp_path, monkeypatch):
    out, joined = tmp_path / "map", []

    def join(workspace, tile, *arguments):
        joined.append(tile)
        if len(joined) in (4, 5):
            raise OSError("the disk is gone")
        return merging_jobs.join_tile(workspace, tile, *arguments)

    def jobs(some, executor, **_):
        return run_jobs(some, executor, attempts=1)

    monkeypatch.setattr("mapper.merging.merge.join_tile", join)
    monkeypatch.setattr(resumable_jobs, "run_jobs", jobs)
    with pytest.raises(RunError, match=r"join \d+: OSError: the disk is gone.*\(and 1 more\).*to resume"):
        merged_map_of(as_built(runs), out)
    assert not out.exists()
    with pytest.raises(RunError, match="not finished"):
        open_map(out)
    with pytest.raises(RunError, match="not finished; the mapper merge that began it resumes it"):
        open_run(out)
    lost = joined[3:5]
    joined.clear()
    joined.extend([0] * 5)
    monkeypatch.setattr("mapper.merging.merge.split_run", print)  # nothing is split again

    merged_map_of(as_built(runs), out)

    assert joined[5:] == lost
    assert bytes_of(out) == bytes_of(merged.path, but=SUMMARY)


@pytest.mark.usefixtures("undrawn")
def test_what_was_left_of_another_merge_is_not_gone_on_with(runs, merged, tmp_path, monkeypatch):
    out = tmp_path / "map"
    with monkeypatch.context() as patch:
        patch.setattr("mapper.merging.merge.write_whole_bt", None)
        with pytest.raises(TypeError):
            merged_map_of(as_built(runs[:2]), out)

    merged_map_of(as_built(runs), out)

    assert bytes_of(out) == bytes_of(merged.path, but=SUMMARY)


def test_a_part_of_the_map_is_opened_alone(maps, merged):
    octree, _ = total(maps, config=COLORED)
    lower_m, upper_m = np.array([0.1, 0.1, 0.1]), np.array([3.1, 3.1, 3.1])

    part = open_map(merged.path).load(lower_m, upper_m)

    leaves = part.leaves()
    assert 0 < len(leaves.keys) < len(octree)
    assert (leaves.centres_world > 0.0).all()
    assert (leaves.centres_world < 3.2).all()
    inside = (octree.leaves().centres_world > 0.0).all(axis=1) & (octree.leaves().centres_world < 3.2).all(
        axis=1
    )
    np.testing.assert_array_equal(
        part.log_odds_at(octree.leaves().centres_world[inside]), octree.leaves().log_odds[inside]
    )


@pytest.mark.usefixtures("undrawn")
def test_runs_are_brought_together_by_their_truths(maps, tmp_path):
    T_truth_first, T_truth_second = (
        exp(np.array([0.0, 0.0, 2.0]), np.ones(3)),
        exp(np.array([0, 0, 1.0]), -np.ones(3)),
    )
    first = make_run(tmp_path / "a", maps[0], T_truth_world=T_truth_first)
    second = make_run(tmp_path / "b", maps[1], T_truth_world=T_truth_second)

    placed = by_truth([first, second])

    T_map_second = inverse(T_truth_first) @ T_truth_second
    assert placed[0].stays
    np.testing.assert_allclose(placed[1].T_map_world, T_map_second, atol=1e-9)
    found = merged_map_of(placed, tmp_path / "map").map
    moved = resample(
        maps[1], inverse(placed[1].T_map_world), blocks_reached(maps[1], placed[1].T_map_world), COLORED
    )
    octree, _ = total([maps[0], moved], config=COLORED)
    write_ot(tmp_path / "whole.ot", octree)
    assert (found.path / "map.ot").read_bytes() == (tmp_path / "whole.ot").read_bytes()


def test_a_straight_path_tells_how_a_run_is_turned_about_it(maps, tmp_path):
    run = make_run(tmp_path / "a", maps[0])
    poses = np.array([np.eye(4) for _ in range(9)])
    poses[:, 0, 3] = np.arange(9)
    straight = Trajectory(np.arange(9) + 1, poses)
    T_truth_world = exp(np.array([1.0, 0.4, -2.0]), np.array([3.0, 2.0, 1.0]))
    with run.changing(["trajectory.tum", "truth.tum"]):
        write_tum(run.path / "trajectory.tum", straight)
        write_tum(run.path / "truth.tum", straight.moved(T_truth_world))
    still = make_run(tmp_path / "still", maps[0], T_truth_world=np.eye(4))

    placed = by_truth([still, run])

    np.testing.assert_allclose(placed[1].T_map_world, T_truth_world, atol=1e-9)


def test_poses_come_from_a_file(runs, tmp_path, monkeypatch):
    path = tmp_path / "poses.txt"
    path.write_text(
        "# name tx ty tz qx qy qz qw\nrun1,1,2,3,0,0,0,1\nrun0 0 0 0 0 0 0 1\nother 0 0 0 0 0 0 1\n"
    )

    placed = by_poses(runs[:2], path)

    assert placed[0].stays
    np.testing.assert_array_equal(placed[1].T_map_world[:3, 3], [1.0, 2.0, 3.0])
    monkeypatch.chdir(runs[1].path)
    np.testing.assert_array_equal(by_poses([open_run(Path())], path)[0].T_map_world, placed[1].T_map_world)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("run0 0 0 0 0 0 0 1\n", "no line for run1"),
        ("run0 0 0 0 0 0 1\n", "poses.txt:1: want RUN tx ty tz"),
        ("run0 0 0 0 0 0 0 nan\n", "poses.txt:1: want RUN tx ty tz"),
        ("run0 0 0 0 0 0 0 0\n", "poses.txt:1: want RUN tx ty tz"),
        ("run0 0 0 0 0 0 0 1\nrun0 0 0 0 0 0 0 1\n", "poses.txt:2: a second pose of run0"),
    ],
)
def test_a_bad_line_of_poses_is_named(runs, tmp_path, text, complaint):
    path = tmp_path / "poses.txt"
    path.write_text(text)

    with pytest.raises(DataError, match=complaint):
        by_poses(runs[:2], path)


def test_runs_that_do_not_fit_together_are_refused(runs, maps, tmp_path):
    coarse = OctreeMap(COLORED.model_copy(update={"resolution_m": 0.2}))
    unsure = OctreeMap(COLORED.model_copy(update={"hit_probability": 0.6}))

    with pytest.raises(ConfigError, match=r"octree\.resolution_m is 0\.2, but 0\.1 in .*run0.*mapper fuse"):
        merged_map_of(as_built([runs[0], make_run(tmp_path / "coarse", coarse)]), tmp_path / "map")
    with pytest.raises(ConfigError, match=r"octree\.hit_probability is 0\.6, but 0\.7"):
        merged_map_of(as_built([runs[0], make_run(tmp_path / "unsure", unsure)]), tmp_path / "map")
    with pytest.raises(RunError, match="given twice"):
        merged_map_of(as_built([runs[0], runs[0]]), tmp_path / "map")
    with pytest.raises(RunError, match="nothing is known"):
        merged_map_of(as_built([make_run(tmp_path / "empty", OctreeMap(COLORED))]), tmp_path / "map")
    with pytest.raises(RunError, match="has no truth to be placed by"):
        by_truth(runs[:2])
    bare = make_run(tmp_path / "bare", maps[0])
    (bare.path / "map.octree").unlink()
    with pytest.raises(RunError, match=r"has no map\.octree; make it with mapper fuse"):
        merged_map_of(as_built([bare]), tmp_path / "map")
    with pytest.raises(RunError, match="run0: is not a merged map, so --overwrite will not replace it"):
        merged_map_of(as_built(runs), runs[0].path, overwrite=True)
    with pytest.raises(ConfigError, match=r"tile edge 0\.1 m"):
        merged_map_of(as_built(runs), tmp_path / "map", tile_m=0.1)


def test_a_map_of_an_older_version_is_opened_and_a_damaged_one_refused(merged):
    path = merged.path / "manifest.json"
    before = path.read_text()
    tree = json.loads(before)
    tree["octree"]["seen_through_scans"] = 3
    try:
        path.write_text(json.dumps(tree, indent=2))
        assert open_map(merged.path).manifest == merged.manifest
        path.write_text(before[:-20])
        with pytest.raises(RunError, match="not valid JSON"):
            open_map(merged.path)
    finally:
        path.write_text(before)


@pytest.mark.usefixtures("undrawn")
def test_a_user_is_told_what_to_doubt(runs, maps, merged, tmp_path):
    assert merged.manifest.notes[0].startswith("every run's world was taken for the map's")
    again = make_run(tmp_path / "again", maps[0], log="sha256:1")
    (again.path / "edits.toml").write_text("[[keepout]]\nheight_m = [0, 1]\n")
    (told,) = warnings_about([Placed(again, np.eye(4), "by hand")])
    assert told.startswith(
        "again: its maps were made before edits.toml was changed and are merged as they are; "
    )
    (again.path / "edits.toml").unlink()
    verdict = Verdict(state="doubtful", sentences=("its loops are far off",))
    doubted = replace(again, manifest=again.manifest.model_copy(update={"verdict": verdict}))
    assert "again is doubtful: its loops are far off" in warnings_about(
        [Placed(doubted, np.eye(4), "by hand")]
    )
    upside_down = Placed(again, exp(np.array([np.pi, 0.0, 0.0]), np.zeros(3)), "by hand")

    found = merged_map_of([as_built(runs[1:2])[0], upside_down], tmp_path / "map").map

    assert found.manifest.notes[:2] == (
        "run1 and again were made from 9 frames that are the same; these count twice",
        "no slice: a run is tilted by more than 5°, so z is not up in the map",
    )
    assert found.manifest.notes[2].startswith(
        "again: 2% of its walls are where those of the runs before it are"
    )
    assert not (found.path / "slice.yaml").exists()
    with pytest.raises(RunError, match=r"has no traversable\.yaml; no slice: a run is tilted"):
        _ = found.traversable


def test_the_verb_says_what_it_made(runs, tmp_path, capsys):
    arguments = ["merge", str(runs[0].path), str(runs[1].path), "--out", str(tmp_path / "map")]

    app([*arguments, "--tile-m", "2.4"], standalone_mode=False)

    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["run", "placed", "bent", "voxels", "known", "in", "both", "walls", "agree"]
    assert lines[2].split()[:3] == ["run1", "as", "built"]
    assert lines[-1] == str(tmp_path / "map")
    assert open_map(tmp_path / "map").manifest.status == "complete"
    with pytest.raises(RunError, match=r"is a merged map, not a run"):
        open_run(tmp_path / "map")
