"""``mapper edit``, and edits that hold in later fuses, from the command line."""

import shutil

import numpy as np
import pytest

from mapper.core.errors import ConfigError
from mapper.octree.grid import FREE, OCCUPIED, read_grid
from mapper.octree.map import read_octree
from mapper.run.folder import open_run
from tests.support.command_line import mapper
from tests.support.files import files_of

TIMED = {"manifest.json"}


@pytest.fixture
def run_folder(desk_run, tmp_path):
    return shutil.copytree(desk_run.path, tmp_path / "desk")


def occupied(folder):
    octree = read_octree(folder / "map.ot")
    leaves = octree.leaves()
    return leaves.centres_world[leaves.log_odds >= octree.occupied_log_odds]


def maps_of(folder):
    return {name: data for name, data in files_of(folder).items() if name not in TIMED}


def test_a_run_is_edited_and_undone_from_python(run_folder):
    mapper("fuse", run_folder, "--quiet")
    before, points = maps_of(run_folder), occupied(run_folder)
    box = np.quantile(points, [0.3, 0.8], axis=0)
    inside = ((points >= box[0]) & (points <= box[1])).all(axis=1)
    run = open_run(run_folder).edit("erase", box_m=box.tolist())
    np.testing.assert_allclose(run.octree.occupied(), points[~inside])
    run.edit("undo")
    assert maps_of(run_folder) == before
    wrong = {"erase": {}, "remove": {"height_m": (0, 1)}, "keep": {"box": 1}, "undo": {}}
    for kind, region in wrong.items():
        with pytest.raises(ConfigError):
            run.edit(kind, **region)


def test_an_edit_holds_until_it_is_undone_and_then_all_bytes_are_back(run_folder):
    mapper("fuse", run_folder, "--quiet")  # the timings of frames are in run.mcap
    before, points = maps_of(run_folder), occupied(run_folder)
    low, high = np.quantile(points, 0.3, axis=0), np.quantile(points, 0.8, axis=0)
    inside = ((points >= low) & (points <= high)).all(axis=1).sum()
    assert inside > 10

    said = mapper("edit", run_folder, "--erase", "--box", *low, *high)

    assert f": {inside} voxels erased" in said.stdout
    assert f"{inside} voxels made free; 0 voxels and " in said.stderr
    left = occupied(run_folder)
    assert len(left) == len(points) - inside
    assert not ((left >= low) & (left <= high)).all(axis=1).any()
    assert (run_folder / "scan_updates.bin").read_bytes() == before["scan_updates.bin"]

    mapper("fuse", run_folder, "--quiet")
    np.testing.assert_array_equal(occupied(run_folder), left)
    assert f": {inside} voxels erased" in mapper("edit", run_folder).stdout

    mapper("edit", run_folder, "--undo", "--quiet")
    assert maps_of(run_folder) == before
    assert mapper("edit", run_folder, "--list").stdout == "no edits\n"


def test_a_file_that_was_written_by_hand_is_read_and_not_refused(run_folder):
    mapper("edit", run_folder, "--keep", "--height", -0.5, 1.0, "--quiet")
    text = (run_folder / "edits.toml").read_text()
    assert occupied(run_folder)[:, 2].max() < 1.0

    (run_folder / "edits.toml").write_text(f"# mine\n{text.replace('1.0', '0.8')}")
    listed = mapper("edit", run_folder).stdout
    assert "keep height_m = [-0.5, 0.8]: not in the maps yet; mapper fuse" in listed
    assert "keep height_m = [-0.5, 1.0]: " in listed
    assert "no longer in edits.toml" in listed

    mapper("doctor", run_folder)
    mapper("fuse", run_folder, "--quiet")
    assert 0.6 < occupied(run_folder)[:, 2].max() < 0.8
    assert (run_folder / "edits.toml").read_text().startswith("# mine\n")
    assert "not in the maps yet" not in mapper("edit", run_folder).stdout


def test_a_keepout_blocks_the_traversable_floor_and_plans_but_not_the_slice(run_folder):
    grid = read_grid(run_folder / "traversable.yaml")
    height, width = grid.cells.shape
    (x, y), edge_m = grid.origin_world_m, 0.05
    right, top = x + 10 * edge_m, y + height * edge_m
    slice_before = (run_folder / "slice.pgm").read_bytes()

    mapper("edit", run_folder, "--keepout", "--polygon", f"{x},{y} {right},{y} {right},{top} {x},{top}")

    after = read_grid(run_folder / "traversable.yaml").cells
    assert (grid.cells[:, :10] != OCCUPIED).any()
    assert (after[:, :10] == OCCUPIED).all()
    np.testing.assert_array_equal(after[:, 10:], grid.cells[:, 10:])
    assert width > 10
    assert (run_folder / "slice.pgm").read_bytes() == slice_before

    band, mask = read_grid(run_folder / "slice.yaml"), read_grid(run_folder / "keepout.yaml")
    np.testing.assert_array_equal(mask.origin_world_m, band.origin_world_m)
    columns = np.arange(band.cells.shape[1])
    kept_out = columns < 10 + round((x - band.origin_world_m[0]) / edge_m)
    kept_out &= columns >= round((x - band.origin_world_m[0]) / edge_m)
    inside = (mask.cells == OCCUPIED).any(axis=0)
    np.testing.assert_array_equal(inside, kept_out)
    lost = np.argwhere((band.cells == FREE) & (mask.cells == OCCUPIED))
    row, column = lost[0]
    point = [band.origin_world_m[0] + (column + 0.5) * edge_m, band.origin_world_m[1] + (row + 0.5) * edge_m]
    told = mapper("plan", run_folder, "--from", *point, "--to", *point, "--radius", 0.01, status=1).stderr
    assert "start" in told
    in_space = ("--from", *point, 0.4, "--to", *point, 0.4, "--radius", 0.01, "--unknown", "free")
    assert "start" in mapper("plan", run_folder, "--3d", *in_space, status=1).stderr

    mapper("edit", run_folder, "--undo", "--quiet")
    assert not list(run_folder.glob("keepout.*"))
    mapper("plan", run_folder, "--from", *point, "--to", *point, "--radius", 0.01)
    mapper("plan", run_folder, "--3d", *in_space)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--erase"], "--erase: want a region: --box, --height, --radius or --polygon"),
        (["--height", 0, 1], "a region alone changes nothing: want --erase, --keep or --keepout"),
        (["--erase", "--keep", "--radius", 1], "choose one"),
        (["--undo", "--keep", "--radius", 1], "choose one"),
        (["--undo", "--radius", 1], "a region alone changes nothing"),
        (["--undo"], "has no edits to undo"),
        (
            ["--erase", "--box", 1, 0, 0, 0, 1, 1],
            "region: box_m = [[1.0, 0.0, 0.0], ",
        ),
        (["--erase", "--polygon", "0,0 1,0 x,1"], "region: polygon_m.2.0: want a number"),
        (["--keep", "--height", 50, 60], "the map has no voxel in a region to keep"),
    ],
)
def test_a_mistake_is_one_line_and_changes_nothing(options, message, run_folder):
    before = files_of(run_folder)
    result = mapper("edit", run_folder, *options, "--quiet", status=1)
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert files_of(run_folder) == before


def test_a_mistake_in_the_file_ends_a_fuse_before_it_begins_and_no_build_replaces_edits(run_folder, desk_log):
    (run_folder / "edits.toml").write_text("[[erase]]\nheight = [0, 1]\n")
    result = mapper("fuse", run_folder, status=1)
    assert "edits.toml: erase.0.height: unknown; did you mean height_m?" in result.stderr
    assert not run_folder.with_name("desk.partial").exists()
    assert open_run(run_folder).manifest.status == "complete"
    result = mapper("build", desk_log, "--out", run_folder, "--overwrite", status=1)
    assert "holds files that are not of a run folder: edits.toml" in result.stderr
