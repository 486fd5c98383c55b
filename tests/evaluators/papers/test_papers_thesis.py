"""The thesis's tables: their settings, the log followed by all of them at once, and what comes of it."""

import tomllib

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError
from mapper.core.geometry import exp
from mapper.core.trajectory import trajectory_from
from mapper.evaluators.papers.model import PaperCell
from mapper.evaluators.papers.paper import CONFIGS, Cut, cells_of, job_for
from mapper.evaluators.papers.thesis import PAPER, ThesisJob, follow, table_of
from mapper.evaluators.papers.thesis_tables import tables
from mapper.odometry.config import IsvdOdometryConfig
from mapper.pipeline.solve import solve
from mapper.pipeline.track import track_log
from mapper.pipeline.tracking_result import TrackingResult
from mapper.runtime.progress import SILENT
from mapper.runtime.resumable_jobs import JobResult
from mapper.sources import open_source
from mapper.sources.trajectory_files import read_tum
from tests.support.paths import FR1_XYZ, ROOT

THESIS = sorted((CONFIGS / "thesis").glob("*.toml"))
ORB = ["odometry.detector.kind=orb", "odometry.detector.max_features=300"]  # faster than SURF


@pytest.mark.parametrize("path", THESIS, ids=lambda path: path.stem)
def test_settings_load_and_only_override(path):
    config = load_config(path)

    assert isinstance(config.odometry, IsvdOdometryConfig)
    assert config.odometry.detector.kind == "surf"
    assert config.odometry.match.filter == "homography"
    loops = ("thesis", "proportional") if "LC" in path.stem else ("none", "none")
    assert (config.loops.kind, config.graph.solve) == loops
    odometry = tomllib.loads(path.read_text())["odometry"]
    defaults = IsvdOdometryConfig()
    named_by_file_name = {"kind", "previous_frames"}
    assert all(
        value != getattr(defaults, key) for key, value in odometry.items() if key not in named_by_file_name
    )


def test_the_repository_shows_the_files_that_are_shipped():
    shown = ROOT / "configs"

    assert {path.name for path in (shown / "thesis").glob("*.toml")} == {path.name for path in THESIS}
    assert (shown / "zhao.toml").resolve() == (CONFIGS / "zhao.toml").resolve()


def test_tables_compare_what_they_say():
    iterations = {name: setting.config().odometry.registration for name, setting in settings("5.1")}
    assert list(iterations) == ["1", "3", "4", "5", "7", "9", "11", "13", "15", "20", "25", "auto"]
    assert all(config.max_iterations == int(name) for name, config in iterations.items() if name != "auto")
    assert [name for name, config in iterations.items() if config.min_error_mm > 0] == ["auto"]
    previous = {name: setting.config().odometry.previous_frames for name, setting in settings("5.2")}
    assert previous == {"MP1": 1, "MP2": 2, "MP3": 3, "MP4": 4, "MP6": 6}
    steps = {name: setting.config().odometry.registration.step for name, setting in settings("4.1")}
    assert steps == {"ICP": "icp", "SVD": "svd"}
    loops = {name: setting.config() for name, setting in settings("5.5")}
    assert [(c.loops.kind, c.graph.solve, c.odometry.depth_filter) for c in loops.values()] == [
        ("none", "none", False),
        ("thesis", "proportional", False),
        ("thesis", "proportional", True),
        ("thesis", "batch", False),
        ("thesis", "batch", True),
    ]
    detectors = {name: setting.config().odometry for name, setting in settings("detectors")}
    assert {name: c.detector.kind for name, c in detectors.items() if c.detector.kind != "surf"} == {
        "orb2": "orb",
        "sift2": "sift",
    }
    assert detectors["surf8-avg"].previous_frames == 8
    assert detectors["surf8-avg"].average == "mean"


def settings(table):
    return tables()[table].settings.items()


def test_settings_followed_together_are_as_each_alone(desk_log):
    cut = ["source.last_frame=9"]
    variants = {
        "MP4": load_config(CONFIGS / "thesis/MP4.toml", [*ORB, *cut]),
        "MP2": load_config(CONFIGS / "thesis/MP2.toml", [*ORB, *cut]),
        "unfiltered": load_config(CONFIGS / "thesis/MP2.toml", [*ORB, *cut, "odometry.match.filter=none"]),
        "loops": load_config(
            CONFIGS / "thesis/ISVD+LC+DIF.toml",
            [*ORB, *cut, "loops.min_gap_s=0.3", "loops.sharp_ratio=0.9", "loops.keyframe_interval=2"],
        ),
        "fewer features": load_config(
            CONFIGS / "thesis/MP2.toml", [*ORB, *cut, "odometry.detector.max_features=200"]
        ),
        "MP4 again": load_config(CONFIGS / "thesis/ISVD.toml", [*ORB, *cut]),
    }
    source = open_source(desk_log, variants["MP4"].source)

    together = follow(source, variants)

    for name, config in variants.items():
        tracking = track_log(source, config, progress=SILENT)
        solved = solve(tracking.graph, tracking.loops, config.graph)
        alone = TrackingResult(tracking.tracks, (), solved.graph, solved.loops, {}).trajectory()
        assert together[name].estimate.T_world_body.tobytes() == alone.T_world_body.tobytes(), name
        assert together[name].frames == 10
        assert together[name].lost == 0
        if name == "loops":
            assert any(loop.verdict == "accepted" for loop in solved.loops)
    assert len({result.estimate.T_world_body.tobytes() for result in together.values()}) == 5


def test_a_setting_that_places_too_little_says_so_and_the_others_go_on(desk_log):
    good = load_config(CONFIGS / "thesis/MP2.toml", [*ORB, "source.last_frame=9"])
    bad = load_config(CONFIGS / "thesis/MP2.toml", [*ORB, "odometry.registration.min_agreeing=10000"])

    together = follow(open_source(desk_log, good.source), {"bad": bad, "good": good})

    assert together["bad"].estimate is None
    assert together["bad"].failure.startswith("only 1 of 10 frames read could be tracked")
    assert together["good"].lost == 0


def test_only_isvd_is_followed(desk_log):
    with pytest.raises(ConfigError, match=r"odometry\.kind is local-map, want isvd"):
        follow(open_source(desk_log), {"other": load_config()})


@pytest.fixture
def job(desk_log, tmp_path):
    return ThesisJob("fr1/xyz", desk_log, 0, Cut(0, 9), ("5.5",), tmp_path / "trajectories")


def test_a_job_gives_every_figure_and_keeps_the_paths(job):
    records = job()

    assert [(r["row"], r["column"]) for r in records] == [(p.row, p.column) for p in job.places]
    assert all(0.0 < r["value"] < 0.02 and r["failure"] is None and r["note"] == "" for r in records)
    drawn = job.drawn()
    assert [path.method for path in drawn] == [r["column"] for r in records]
    assert [path.ate_m for path in drawn] == pytest.approx([r["value"] for r in records], rel=1e-3)
    estimate, truth = read_tum(drawn[0].estimate), read_tum(drawn[0].truth)
    assert len(estimate) == 10
    assert truth.stamps_ns[0] >= estimate.stamps_ns[0]
    assert truth.stamps_ns[-1] <= estimate.stamps_ns[-1]


def test_another_log_seed_or_part_is_another_cell_and_another_place_is_not(job, desk_log, tmp_path):
    (tmp_path / "moved").symlink_to(desk_log)
    others = [
        ThesisJob(job.sequence, job.log, 0, job.cut, ("5.2",), job.paths),
        ThesisJob("fr1/rpy", job.log, 0, job.cut, ("5.5",), job.paths),
        ThesisJob(job.sequence, job.log, 1, job.cut, ("5.5",), job.paths),
        ThesisJob(job.sequence, job.log, 0, Cut(0, 12), ("5.5",), job.paths),
        ThesisJob(job.sequence, tmp_path, 0, job.cut, ("5.5",), job.paths),
    ]
    moved = ThesisJob(job.sequence, tmp_path / "moved", 0, job.cut, ("5.5",), tmp_path)

    assert len({job_for(each).key for each in [job, *others]}) == 6
    assert job_for(moved).key == job_for(job).key


def test_tables_of_the_same_frames_are_measured_together(job):
    def groups(sequence):
        jobs = PAPER.measurements(list(tables()), sequence, job.log, 0, Cut(), job.paths)
        return [each.tables for each in jobs]

    assert groups("fr1/xyz") == [("4.1", "5.1", "5.2", "5.5"), ("detectors",)]
    assert groups("fr3/long_office") == [("4.2",), ("5.5",)]
    assert groups("fr1/plant") == [("5.2", "5.5")]


def test_a_long_log_is_cut_where_the_thesis_cuts_it(job):
    def last(cut):
        long_job = ThesisJob("fr3/long_office", job.log, 0, cut, ("4.2",), job.paths)
        return {config.source.last_frame for config in long_job.configs().values()}

    assert last(Cut()) == {2099}
    assert last(Cut(0, 99)) == {99}
    assert last(Cut(0, 5000)) == {2099}
    assert {config.source.last_frame for config in job.configs().values()} == {9}
    assert Cut(0, 0).overrides() == ["source.first_frame=0", "source.last_frame=0"]
    assert Cut().overrides() == ["source.first_frame=0"]


def test_the_end_of_a_path_is_off_in_the_axes_of_its_start():
    stamps = range(0, 4_000_000_000, 1_000_000_000)
    T_start = exp(np.array([0.3, -0.2, 0.9]), np.array([5.0, 1.0, -2.0]))
    true = [T_start @ exp(np.array([0.0, 0.1 * i, 0.0]), np.array([0.5 * i, 0.0, 0.0])) for i in range(4)]
    end = true[-1].copy()
    end[:3, 3] += T_start[:3, :3] @ [0.01, -0.02, 0.03]
    end[:3, :3] = T_start[:3, :3] @ exp(np.array([0.002, -0.004, 0.006]), np.zeros(3))[:3, :3]
    end[:3, :3] = end[:3, :3] @ exp(np.array([0.0, 0.3, 0.0]), np.zeros(3))[:3, :3]
    truth = trajectory_from(zip(stamps, true, strict=True))
    estimate = trajectory_from(zip(stamps, [*true[:-1], end], strict=True))

    off = tables()["4.1"].measure(estimate, truth)

    assert off[:3] == pytest.approx([10.0, -20.0, 30.0])
    assert off[3:6] == pytest.approx([0.006, 0.002, -0.004])  # roll about z, pitch about x, yaw about y
    assert off[6:] == pytest.approx([20.0, 0.004])


def test_the_thesiss_own_log_stands_beside_ours_without_a_ratio(job):
    jobs = [ThesisJob("fr1/xyz", job.log, 0, job.cut, ("4.1",), job.paths)]
    results = {jobs[0]: JobResult("k", "l", tuple(figure(place, 1.0) for place in jobs[0].places), 1.0)}

    table = table_of("4.1", results)

    verdicts = {(cell.row.partition(",")[0], cell.published is None): cell.verdict for cell in table.cells}
    assert verdicts == {
        ("ICP", False): "not run",
        ("SVD", False): "not run",
        ("ICP", True): "not printed",
        ("SVD", True): "not printed",
    }
    assert [cell.published for cell in table.cells[:2]] == [-183.3, 617.4]


def figure(place, value, failure=None, note=""):
    return {**place._asdict(), "value": value, "failure": failure, "note": note}


def test_seeds_are_gathered_and_failures_told(job):
    jobs = [ThesisJob("fr1/xyz", job.log, seed, job.cut, ("5.2",), job.paths) for seed in range(3)]
    mp1, mp2, *_ = jobs[0].places
    outcomes = [
        JobResult("a", "a", (figure(mp1, 0.03), figure(mp2, 0.02, note="5 lost.")), 1.0),
        JobResult("b", "b", (figure(mp1, 0.01), figure(mp2, None, "too few frames")), 1.0),
        JobResult("c", "c", (), 0.0, "its worker was killed by SIGKILL"),
    ]
    results = dict(zip(jobs, outcomes, strict=True))

    cells = cells_of("5.2", results, {"fr1/xyz": {"MP1": 0.02}})
    table = table_of("5.2", results)

    assert cells[0] == PaperCell(
        "fr1/xyz", "MP1", 0.02, (0.03, 0.01), ("seed 2: its worker was killed by SIGKILL",)
    )
    assert cells[1].ours == (0.02,)
    assert cells[1].failures == ("seed 1: too few frames", "seed 2: its worker was killed by SIGKILL")
    assert cells[2].verdict == "failed"
    assert [cell.column for cell in cells] == ["MP1", "MP2", "MP3", "MP4", "MP6"]
    assert table.notes == ("5 lost.",)
    assert table.cells[0].published == 0.0216


@pytest.mark.parametrize(
    ("ours", "published", "in_part", "verdict"),
    [
        ((0.0189, 0.5, 0.01), 0.02, False, "better"),
        ((0.0191,), 0.02, False, "as published"),
        ((0.0219,), 0.02, False, "as published"),
        ((0.0221,), 0.02, False, "worse"),
        ((0.0221,), 0.02, True, "in part"),
        ((0.0221,), None, True, "not printed"),
        ((), 0.02, False, "not run"),
    ],
)
def test_verdicts_follow_the_median(ours, published, in_part, verdict):
    assert PaperCell("row", "column", published, ours, in_part=in_part).verdict == verdict


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"{FR1_XYZ} is not here")
def test_isvd_as_published_follows_the_first_second_of_a_real_log(tmp_path):
    records = ThesisJob("fr1/xyz", FR1_XYZ, 0, Cut(0, 11), ("5.1", "5.2"), tmp_path)()

    ours_m = {f"{record['table']} {record['column']}": record["value"] for record in records}
    assert len(ours_m) == 17
    assert ours_m["5.1 25"] == ours_m["5.2 MP4"] < 0.01
    assert ours_m["5.1 auto"] < 0.01
    assert ours_m["5.1 1"] > ours_m["5.1 7"]
