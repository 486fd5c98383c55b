import csv
import json
import re

import numpy as np
import pytest
from pyarrow import parquet

from mapper.core.errors import ConfigError, RunError, SourceError
from mapper.evaluators.study.engine import SameVersions, versions
from mapper.evaluators.sweep.page import write_sweep
from mapper.evaluators.sweep.plan import plan_sweep, run_sweep
from mapper.evaluators.sweep.tables import QUANTITIES, best_of, grouped, summary_text, sweep_records
from mapper.runtime.resumable_jobs import Job, JobResult
from tests.support.chromium import CHROMIUM, MISSING, Page
from tests.support.command_line import mapper
from tests.support.counted_jobs import run_elsewhere
from tests.support.progress import Observer

FEW = "source.last_frame=11"
TIMES = {"cell_s", "track_s", "solve_s", "level_s", "fuse_s", "write_s", "total_s", "frames_per_s"}
TIMES |= {"real_time_factor", "peak_memory_mb", "host"}


@pytest.fixture
def swept(tmp_path):
    """Write a sweep's file and return where it is."""

    def write(*lines, name="sweep.toml"):
        path = tmp_path / name
        path.write_text("\n".join(lines))
        return path

    return write


def scan_log(folder):
    """Write a LiDAR log of two clouds, good enough to be opened."""
    (folder / "velodyne").mkdir(parents=True)
    for number in range(2):
        np.ones((30, 4), np.float32).tofile(folder / "velodyne" / f"{number:06d}.bin")
    return folder


@pytest.fixture
def scans(tmp_path):
    return scan_log(tmp_path / "scans")


def method(name, *overrides):
    return f"[[method]]\nname = '{name}'\nset = {json.dumps(overrides)}"


def configs_of(plan):
    return {place: cell.run.config for place, cell in plan.jobs.items()}


def test_every_method_meets_every_configuration(swept, desk_log, tmp_path):
    file = swept(
        f"logs = ['{desk_log}']",
        method("ISVD", "odometry.kind=isvd", "octree.resolution_m=0.3"),
        method("PnP", "odometry.kind=pnp"),
        "[[configuration]]\nname = 'coarse'\nset = {octree.resolution_m = 0.2, source = {stride = 3}}",
        "[[configuration]]\nname = 'fine'\nset = ['octree.resolution_m=0.1']",
    )
    found = {
        (place.method, place.configuration): (
            c.odometry.kind,
            c.octree.resolution_m,
            c.source.stride,
            c.workers,
        )
        for place, c in configs_of(plan_sweep(file, tmp_path / "out")).items()
    }
    assert found == {
        ("ISVD", "coarse"): ("isvd", 0.2, 3, 0),
        ("ISVD", "fine"): ("isvd", 0.1, 1, 0),
        ("PnP", "coarse"): ("pnp", 0.2, 3, 0),
        ("PnP", "fine"): ("pnp", 0.1, 1, 0),
    }


def test_a_method_s_file_lies_beside_the_sweep_s(swept, desk_log, tmp_path, monkeypatch):
    (tmp_path / "isvd.toml").write_text("[odometry]\nkind = 'isvd'\nprevious_frames = 2\n")
    file = swept(f"logs = ['{desk_log}']", "[[method]]\nname = 'a'\nconfig = 'isvd.toml'")
    monkeypatch.chdir("/")
    (config,) = configs_of(plan_sweep(file, tmp_path / "out")).values()
    assert (config.odometry.kind, config.odometry.previous_frames) == ("isvd", 2)


def test_logs_are_found_by_globs_and_told_apart(swept, tiny_tum_log, tmp_path):
    for folder in ("b/desk", "a/desk", "a/room"):
        tiny_tum_log(2, folder=folder)
    plan = plan_sweep(swept("logs = ['a/room', '*/*']", method("a")), tmp_path / "out")
    assert [place.log for place in plan.jobs] == ["room", str(tmp_path / "a/desk"), str(tmp_path / "b/desk")]


def test_what_does_not_fit_a_sensor_is_left_out(swept, desk_log, scans, tmp_path):
    file = swept(
        f"logs = ['{desk_log}', '{scans}']",
        method("default"),
        method("ISVD", "odometry.kind=isvd"),
        method("GICP", "odometry.kind=gicp"),
        method("words", "odometry.kind=gicp", "loops.kind=places"),
        method("wheels", "odometry.kind=wheels"),
        method("scans", "loops.kind=scans"),
    )
    entries = plan_sweep(file, tmp_path / "out").entries
    found = {(p.log, p.method): "" if isinstance(e, Job) else e for p, e in entries.items()}
    blind = "loops.kind=places needs images, odometry.kind=gicp takes scans"
    assert found == {
        ("desk", "default"): "",
        ("desk", "ISVD"): "",
        ("desk", "GICP"): blind,
        ("desk", "words"): blind,
        ("desk", "wheels"): "odometry.kind=wheels needs wheels",
        ("desk", "scans"): "loops.kind=scans needs scans, odometry.kind=local-map takes images",
        ("scans", "default"): "",
        ("scans", "ISVD"): "odometry.kind=isvd needs images",
        ("scans", "GICP"): "",
        ("scans", "words"): blind,
        ("scans", "wheels"): "odometry.kind=wheels needs wheels",
        ("scans", "scans"): "",
    }


def test_seeds_repeat_what_draws_by_chance(swept, desk_log, tmp_path):
    file = swept(f"logs = ['{desk_log}']", "seeds = [4, 7, 4]", method("ISVD", "odometry.kind=isvd"))
    found = {place.seed: c for place, c in configs_of(plan_sweep(file, tmp_path / "out")).items()}
    assert {seed: (c.odometry.match.seed, c.loops.verification.match.seed) for seed, c in found.items()} == {
        4: (4, 4),
        7: (7, 7),
    }
    (tmp_path / "seedless.json").write_text(
        json.dumps({"odometry": {"kind": "gicp", "rescue": None}, "loops": {"kind": "none"}})
    )
    file = swept(
        f"logs = ['{desk_log}']", "seeds = [4, 7]", "[[method]]\nname = 'a'\nconfig = 'seedless.json'"
    )
    assert [place.seed for place in plan_sweep(file, tmp_path / "out").jobs] == [None]


def test_a_key_tells_what_is_built_and_not_what_it_is_called(swept, desk_log, tiny_tum_log, tmp_path):
    def keys(*lines, log=desk_log):
        plan = plan_sweep(swept(f"logs = ['{log}']", *lines), tmp_path / "out")
        return [cell.key for cell in plan.jobs.values()]

    plain = keys(method("a"))
    assert keys(method("b"), "[[configuration]]\nname = 'c'") == plain
    assert keys(method("a", "odometry.kind=local-map", "workers=5")) == plain
    for other in (
        keys(method("a", "octree.resolution_m=0.2")),
        keys(method("a", FEW)),
        keys("keep = 'nothing'", method("a")),
        keys(method("a"), log=tiny_tum_log(3)),
    ):
        assert other != plain

    words = tmp_path / "mine.words"
    words.write_bytes(b"one")
    trained = keys(method("a", f"loops.places.path={words}"))
    words.write_bytes(b"other")
    assert keys(method("a", f"loops.places.path={words}")) != trained


@pytest.mark.parametrize(
    ("lines", "error", "message"),
    [
        (["logs = 3"], ConfigError, "sweep.toml: logs: want a list"),
        (["logs = []", method("a")], ConfigError, "sweep.toml: logs: want 1 or more"),
        (["logs = ['LOG']"], ConfigError, "sweep.toml: method: want a value, which is missing"),
        (["logs = ['LOG'"], ConfigError, "sweep.toml: not valid TOML: "),
        (["logs = ['LOG']", "[[method]]\nnam = 'a'"], ConfigError, "sweep.toml: method.0.name: want"),
        (["log = ['LOG']", method("a")], ConfigError, "sweep.toml: logs: want a value, which is missing"),
        (["logs = ['LOG']", method("a"), method("a")], ConfigError, "two of [[method]] are called 'a'"),
        (["logs = ['no*where']", method("a")], ConfigError, "sweep.toml: logs: nothing fits 'no*where'"),
        (["logs = ['nowhere']", method("a")], SourceError, "nowhere: no such file or folder"),
        (["logs = ['LOG']", method("a", "odometry.kind=zip")], ConfigError, "odometry: no kind 'zip'"),
        (
            ["logs = ['LOG']", "[[method]]\nname = 'a'\nconfig = 'no.toml'"],
            ConfigError,
            "no.toml: cannot be read: No such file or directory",
        ),
        (
            ["logs = ['LOG']", "[[method]]\nname = 'a'\nset = {source.camera.distortion = [0, 0]}"],
            ConfigError,
            "method.0.set: source.camera.distortion is a list; write it into a config file",
        ),
    ],
)
def test_a_mistake_is_told_before_anything_is_built(swept, desk_log, tmp_path, lines, error, message):
    with pytest.raises(error) as told:
        plan_sweep(swept(*(line.replace("LOG", str(desk_log)) for line in lines)), tmp_path / "out")
    assert message in str(told.value)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def interrupted(desk_log, tmp_path_factory):
    """A sweep that was ended after its first cell; its file, its folder and the cell."""
    folder = tmp_path_factory.mktemp("interrupted")
    scan_log(folder / "scans")
    file, out = folder / "sweep.toml", folder / "out"
    orb = ("odometry.detector.kind=orb", "odometry.detector.max_features=300", "min_tracked_frames=3")
    cheap = ("octree.resolution_m=0.2", "cloud.voxel_m=0.1", "mcap.image_stride=0", "source.last_frame=5")
    file.write_text(
        "\n".join(
            [
                f"logs = ['{desk_log}', 'scans']",
                method("ISVD", "odometry.kind=isvd", "loops.kind=none", *orb, *cheap),
                method("lost", "odometry.kind=pnp", "min_tracked_frames=99", "source.last_frame=1"),
            ]
        )
    )
    with pytest.raises(KeyboardInterrupt):
        run_sweep(plan_sweep(file, out), progress=Observer("cells", 1))
    (out / "scratch/tmp1/run.partial").mkdir(parents=True)  # as a killed one leaves it
    (cell,) = out.glob("cells/*.json")
    return file, out, cell


@pytest.fixture(scope="module")
def resumable_folder(interrupted):
    """The same sweep, begun again: what it said, and whether the finished cell was left as it was."""
    file, out, cell = interrupted
    before = cell.read_bytes(), cell.stat().st_mtime_ns
    result = mapper("sweep", file, "--out", out, "--processes", 1)
    return result, (cell.read_bytes(), cell.stat().st_mtime_ns) == before


@pytest.mark.slow
def test_a_sweep_goes_on_where_it_was_ended(interrupted, resumable_folder):
    _, out, _ = interrupted
    result, is_as_it_was = resumable_folder
    assert is_as_it_was
    assert "1 of 2 cells were finished before" in result.stderr
    assert not (out / "scratch").exists()
    assert "failed: desk, lost (default): only 2 frames were read" in result.stdout
    assert "does not apply: scans, ISVD (default): odometry.kind=isvd needs images" in result.stdout

    with (out / "results.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    table = parquet.read_table(out / "results.parquet").to_pylist()
    assert [(row["log"], row["method"], row["status"]) for row in rows] == [
        ("desk", "ISVD", "finished"),
        ("desk", "lost", "failed"),
        ("scans", "ISVD", "does not apply"),
        ("scans", "lost", "does not apply"),
    ]
    assert [row["status"] for row in table] == [row["status"] for row in rows]
    assert 0.0 < table[0]["ate_m"] == float(rows[0]["ate_m"]) < 0.02
    assert (rows[1]["ate_m"], table[1]["ate_m"]) == ("", None)
    assert table[0]["tracked_frames"] == 6
    assert isinstance(table[0]["tracked_frames"], int)
    kept = {"config.json", "manifest.json", "summary.png", "trajectory.tum", "truth.tum"}
    assert {child.name for child in (out / table[0]["run"]).iterdir()} == kept


@pytest.mark.slow
def test_builds_in_other_processes_come_to_the_same(interrupted, resumable_folder, tmp_path, monkeypatch):
    assert resumable_folder
    file, out, _ = interrupted
    plan = plan_sweep(file, tmp_path / "out")
    monkeypatch.setattr("mapper.runtime.resumable_jobs.run_jobs", run_elsewhere)
    write_sweep(plan, run_sweep(plan), title="again")

    theirs, ours = (
        parquet.read_table(folder / "results.parquet").drop_columns(sorted(TIMES)).to_pylist()
        for folder in (plan.out, out)
    )
    assert theirs == ours
    assert not (plan.out / "scratch").exists()
    for name in ("trajectory.tum", "truth.tum"):
        assert (plan.out / ours[0]["run"] / name).read_bytes() == (out / ours[0]["run"] / name).read_bytes()


def test_another_folder_is_not_filled(swept, desk_log, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    plan = plan_sweep(swept(f"logs = ['{desk_log}']", method("a")), tmp_path / "out")
    with pytest.raises(RunError, match="holds something else"):
        run_sweep(plan)


def test_a_worker_with_other_libraries_refuses(swept, desk_log, tmp_path):
    plan = plan_sweep(swept(f"logs = ['{desk_log}']", method("a")), tmp_path / "out")
    (cell,) = plan.jobs.values()
    elsewhere = SameVersions(cell.run, {**versions(), "numpy": "1.0"})
    with pytest.raises(ConfigError, match=r"numpy .*, where the work was planned with 1\.0"):
        elsewhere()


def invented(plan, **values):
    """Return results for a plan; a build without values has failed."""
    return {
        place: JobResult(
            cell.key, cell.label, ({**known},) if known else (), 1.0, "" if known else "it was dark"
        )
        for place, cell in plan.jobs.items()
        for known in (values.get(f"{place.method}{'' if place.seed is None else place.seed}"),)
    }


def numbers(ate_m, coverage_ratio=1.0):
    return {"ate_m": ate_m, "rpe_1s_m": None, "coverage_ratio": coverage_ratio, "frames_per_s": 10.0}


def test_medians_ranges_and_failures_are_told(swept, desk_log, tmp_path):
    file = swept(
        f"logs = ['{desk_log}']",
        "seeds = [0, 1, 2]",
        *(
            method(name, f"odometry.kind={kind}")
            for name, kind in (("a", "isvd"), ("b", "pnp"), ("c", "local-map"))
        ),
    )
    plan = plan_sweep(file, tmp_path / "out")
    results = invented(
        plan,
        **{f"a{seed}": numbers(ate_m) for seed, ate_m in enumerate((0.3, 0.1, 0.2))},
        **{f"b{seed}": numbers(0.01, 0.5) for seed in range(2)},
    )
    records = sweep_records(plan, results)
    ((_, groups),) = grouped(records).items()
    ate = QUANTITIES[0]
    texts = [group.text(ate) for group in groups.values()]
    assert texts == ["0.2000 (0.1000–0.3000)", "0.0100 at 50 %, 1 failed", "–"]
    assert best_of(groups, ate) == set()  # nobody covers as much as a
    text = summary_text(records)
    assert re.search(r"desk, a, default +0\.2000 \(0\.1000–0\.3000\) +– +100 +– +10\.0 +–\n", text)
    assert "failed: desk, b (default, seed 2): it was dark" in text
    assert "failed: desk, c (default, seed 0; default, seed 1; default, seed 2): it was dark" in text


def test_the_best_is_marked_for_those_who_cover_alike(swept, desk_log, tmp_path):
    names = {"a": "isvd", "b": "pnp", "c": "local-map"}
    methods = [method(name, f"odometry.kind={kind}") for name, kind in names.items()]
    plan = plan_sweep(swept(f"logs = ['{desk_log}']", *methods), tmp_path / "out")
    results = invented(plan, a=numbers(0.2), b=numbers(0.1, 0.5), c=numbers(0.3, 0.97))
    groups = grouped(sweep_records(plan, results))["desk"]
    best = {quantity.key: best_of(groups, quantity) for quantity in QUANTITIES}
    assert best["ate_m"] == {("a", "default")}
    assert best["coverage_ratio"] == {("a", "default")}
    assert best["rpe_1s_m"] == best["loops"] == set()
    assert best["frames_per_s"] == {(name, "default") for name in names}


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_the_page_opens_offline_and_shows_what_there_is(swept, desk_log, scans, tmp_path):
    hostile = "<i>a</i> & 'b'"
    file = swept(
        f"logs = ['{desk_log}', '{scans}']",
        f'[[method]]\nname = "{hostile}"\nset = ["odometry.kind=isvd"]',
        method("PnP", "odometry.kind=pnp"),
    )
    plan = plan_sweep(file, tmp_path / "out")
    (tmp_path / "out").mkdir()
    write_sweep(plan, invented(plan, **{hostile: numbers(0.0123), "PnP": numbers(0.0456)}), title="first")
    with Page(tmp_path / "out" / "summary.html") as page:
        text = page.run("document.body.innerText")
        assert page.complaints == []
        assert page.asked_for == [(tmp_path / "out" / "summary.html").as_uri()[:80]]
        assert (
            page.run("document.querySelectorAll('figure img, p img').length") == 2
        )  # of errors and of speed
        assert page.run("document.querySelector('#ate-rmse-m td b').innerText") == "0.0123"
        assert page.run("document.querySelectorAll('i').length") == 0
        assert page.run("document.documentElement.scrollWidth") <= 1400
    assert hostile in text
    assert "2 finished, 2 does not apply" in text
    assert f"does not apply: scans, {hostile} (default): odometry.kind=isvd needs images" in text
