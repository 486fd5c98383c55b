"""What each verb that looks or judges answers to a run, a merged map, a log, and to what is none of them."""

import shutil

import numpy as np
import pytest

from mapper.merging.world_poses import as_built
from mapper.navigation.distance import distance_field, layer
from mapper.octree.grid import read_grid
from mapper.run.folder import open_run
from tests.support.command_line import invoke
from tests.support.merged_runs import merged_map_of

KINDS = ("run", "merged map", "log", "file of a run", "foreign folder", "nothing")
NO_RUN = ("is a log, not a run", "is a file of a run", "is no run folder", "no such run folder")
MERGED = "is a merged map, not a run; mapper eval, view --html, export and plan take it"
UNKNOWN = "not a log of a known format"

ANSWERS = {
    "eval": ("ATE RMSE", "walls agree there", NO_RUN[0], "want poses as TUM or KITTI text", *NO_RUN[2:]),
    "view": ("page.html", "page.html", *NO_RUN),
    "report": ("page.html", MERGED, *NO_RUN),
    "export": ("made.ot", "made.ot", *NO_RUN),
    "plan": ("plan.png", "plan.png", *NO_RUN),
    "diff": ("appeared", MERGED, *NO_RUN),
    "doctor": ("octree", MERGED, *NO_RUN),
    "inspect": (
        "a run that mapper wrote",
        "holds what mapper made, not a log",
        "tum, called",
        *(UNKNOWN, UNKNOWN, "no such file or folder"),
    ),
}
"""Words of the answer to each kind of input, in the order of ``KINDS``."""
ANSWERED = {(verb, "run") for verb in ANSWERS if verb != "inspect"} | {
    ("eval", "merged map"),
    ("view", "merged map"),
    ("export", "merged map"),
    ("plan", "merged map"),
    ("inspect", "log"),
}
"""What is no mistake; all else ends with one line and status 1."""


@pytest.fixture(scope="module")
def inputs(desk_run, desk_log, tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    run = shutil.copytree(desk_run.path, folder / "run")
    again = shutil.copytree(desk_run.path, folder / "again")
    merged = merged_map_of(as_built([open_run(run), open_run(again)]), folder / "merged").map
    (folder / "foreign").mkdir()
    (folder / "foreign" / "notes.txt").write_text("nothing of ours\n")
    paths = (run, merged.path, desk_log, run / "map.ot", folder / "foreign", folder / "absent")
    return dict(zip(KINDS, paths, strict=True))


@pytest.fixture(scope="module")
def options(inputs, tmp_path_factory):
    out = tmp_path_factory.mktemp("made")
    grid = read_grid(inputs["run"] / "slice.yaml")
    clearance_m = distance_field(layer(grid), unknown_blocks=True).distances_m[0, 1:-1, 1:-1]
    row, column = np.unravel_index(np.argmax(clearance_m), clearance_m.shape)
    point = np.asarray(grid.origin_world_m) + (np.array([column, row]) + 0.5) * grid.resolution_m
    return {
        "view": ("--html", "--out", out / "page.html", "--overwrite"),
        "report": ("--out", out / "page.html", "--overwrite"),
        "export": ("--as", "octomap", "--out", out / "made.ot", "--overwrite"),
        "plan": ("--from", *point, "--to", *point, "--radius", 0.05),
        "diff": (inputs["run"], "--place", "built", "--out", out / "diff", "--overwrite"),
    }


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("verb", ANSWERS)
def test_a_verb_answers_to_each_kind_of_input(verb, kind, inputs, options):
    result = invoke(verb, inputs[kind], *options.get(verb, ()))
    words = ANSWERS[verb][KINDS.index(kind)]
    if (verb, kind) in ANSWERED:
        assert result.exit_code == 0, result.output
        assert words in result.stdout
    else:
        assert result.exit_code == 1
        assert words in result.stderr
        assert result.stderr.startswith("mapper: ")
        assert str(inputs[kind]) in result.stderr
        assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("verb", ANSWERS)
def test_a_name_longer_than_any_is_a_line(verb, options):
    result = invoke(verb, "a" * 300, *options.get(verb, ()))
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1)


@pytest.mark.parametrize(("metres", "status"), [(1.0, 0), (0.001, 1), (0.05, 1)])
def test_inspect_and_build_refuse_scans_without_returns_in_range(metres, status, tmp_path):
    rng = np.random.default_rng(3)
    for k in range(12):
        points = rng.uniform(-9.0, 9.0, (3000, 3)) * [1.0, 1.0, 0.2]
        np.save(tmp_path / f"{k:04}.npy", metres * points)
    assert invoke("inspect", tmp_path).exit_code == status
    if status:
        built = invoke("build", tmp_path, "--out", tmp_path / "run", "--quiet")
        assert (built.exit_code, "source.cloud_scale" in built.stderr) == (1, True)


def test_data_that_are_no_logs_are_named(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    for name in ("a.jpg", "b.jpg"):
        (images / name).write_bytes(b"")
    named = {images: "depth", images / "a.jpg": "one image"}
    others = [("a.svo2", "ZED"), ("a.lvx", "Livox"), ("a.oni", "OpenNI")]
    for name, what in (("walk.mp4", "video"), ("log.zip", "archive"), ("log.tar.gz", "archive"), *others):
        (tmp_path / name).write_bytes(b"")
        named[tmp_path / name] = what
    named[(tmp_path / "arrays")] = "NumPy"
    (tmp_path / "arrays").mkdir()
    for name in ("0.npz", "1.npz"):
        (tmp_path / "arrays" / name).write_bytes(b"")
    named["https://example.org/log.bag"] = "download"
    for path, what in named.items():
        said = invoke("inspect", path)
        assert (said.exit_code, what in said.stderr, UNKNOWN in said.stderr) == (1, True, False), said.stderr


@pytest.mark.parametrize("within", ["rgb", "rgb.txt", "calibration.toml"])
def test_of_a_part_of_a_log_the_log_is_named(tiny_tum_log, within):
    log = tiny_tum_log(3)
    said = invoke("inspect", log / within)
    assert (said.exit_code, f"the folder it is in, {log}, is one" in said.stderr) == (1, True)
