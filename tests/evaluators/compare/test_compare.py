"""`mapper compare` on a small RGB-D log and a small LiDAR log, and with methods that break down."""

import csv
import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from mapper.config.loading import load_config
from mapper.core.errors import ConfigError, DataError, FrameError
from mapper.core.geometry import inverse
from mapper.evaluators.compare import comparison as compare_module
from mapper.evaluators.compare.catalogue import methods_for
from mapper.evaluators.compare.comparison import compare
from mapper.evaluators.compare.config import CompareConfig, LidarCompareConfig
from mapper.evaluators.compare.files import compare as compare_into
from mapper.evaluators.compare.files import tables_of, tables_text, write_comparison
from mapper.evaluators.compare.methods import registration_method
from mapper.evaluators.compare.pairwise import registration_records
from mapper.evaluators.metrics.odometry import PathErrors
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.simulation.config import STREET, LidarSensorConfig, SynthImuConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.trajectory_files import read_tum
from tests.support.command_line import mapper
from tests.support.logs import changed_frames
from tests.support.paths import KITTI

RGBD = CompareConfig(methods=("pnp", "rgbd", "gicp", "kiss-icp"), pairs=3)
LIDAR = CompareConfig(
    methods=("gicp", "hough-gicp", "kiss-icp"), pairs=3, lidar=LidarCompareConfig(frames_apart=(1, 2, 4))
)
TIMES = {"frames_per_s", "prepare_ms", "align_ms"}


def without_times(records):
    return [{key: value for key, value in record.items() if key not in TIMES} for record in records]


@pytest.fixture(scope="module")
def desk(desk_log):
    return open_source(desk_log, SourceConfig(last_frame=7))


@pytest.fixture(scope="module")
def on_desk(desk, tmp_path_factory):
    return compare(desk, RGBD, tmp_path_factory.mktemp("desk"))


@pytest.fixture(scope="module")
def street():
    sensor = LidarSensorConfig(rings=32, azimuth_steps=450, motion_distortion=False)
    return LidarSimulator(STREET.model_copy(update={"sensor": sensor, "duration_s": 0.6})).log()


@pytest.fixture(scope="module")
def on_street(street, tmp_path_factory):
    return compare(street, LIDAR, tmp_path_factory.mktemp("street"))


def test_every_method_follows_a_short_path(on_desk, on_street):
    assert [run.method for run in on_desk.runs] == list(RGBD.methods)
    for run in on_desk.runs:
        assert (run.frames, run.failures, run.coverage, run.broke) == (8, 0, 1.0, "")
        assert run.errors.ate_m < 0.02, run.method
        # A scan stands upright and a camera does not; aligned positions would not tell the two apart.
        assert run.errors.rpe_rad < math.radians(1.0), run.method
        assert run.errors.rpe_m < 0.02, run.method
    assert [run.method for run in on_street.runs] == list(LIDAR.methods)
    for run in on_street.runs:
        assert (run.failures, run.coverage) == (0, 1.0)
        # KISS-ICP takes some scans to learn how fast it moves.
        assert run.errors.ate_m < (1.0 if run.method == "kiss-icp" else 0.05), run.method


def test_registration_is_right_from_good_guesses(on_desk, on_street):
    for comparison in (on_desk, on_street):
        for row in registration_records(comparison.trials):
            assert row["trials"] == row["right"] + row["wrong"] + row["no_answer"] == 3
    near = comparison_rows(on_desk, "0.05 m, 3°") | comparison_rows(on_street, "0.5 m, 5°")
    assert {"rgbd", "gicp", "kiss-icp"} <= set(near)
    right = {name: row["right"] for name, row in near.items()}
    assert right.pop("kiss-icp") >= 2  # it begins at rest, and a sparse street holds it back
    assert right == dict.fromkeys(right, 3)
    blind = comparison_rows(on_desk, "not used") | comparison_rows(on_street, "not used")
    assert set(blind) == {"pnp", "hough-gicp"}
    assert {name: row["right"] for name, row in blind.items()} == dict.fromkeys(blind, 3)


def test_rko_lio_follows_scans_with_inertial_readings(street, tmp_path, capfd):
    pytest.importorskip("rko_lio")
    assert "rko-lio" not in {method.name for method in methods_for(street, CompareConfig())[0]}
    with pytest.raises(ConfigError, match="accelerations"):
        methods_for(street, CompareConfig(methods=("rko-lio",)))
    readings = SynthImuConfig(mounting_rad=(0.0, 0.0, 0.0), offset_s=0.0)
    slow = {"imu": readings, "speed_mps": 2.0, "duration_s": 2.0, "sensor": LidarSensorConfig(rings=32)}
    log = LidarSimulator(STREET.model_copy(update=slow)).log()

    comparison = compare(log, CompareConfig(methods=("rko-lio", "icp"), pairs=2), tmp_path)

    ours, theirs = sorted(comparison.runs, key=lambda run: run.method)
    assert (theirs.frames, theirs.failures, theirs.coverage, theirs.broke) == (21, 0, 1.0, "")
    assert theirs.errors.ate_m < 0.6  # of 4 m: it slides along this street
    assert theirs.errors.rpe_rad < 0.005
    assert {trial["method"] for trial in comparison.trials} == {ours.method}
    assert capfd.readouterr().out == ""


def test_the_odometry_of_builds_is_compared_on_lidar_logs(desk, tmp_path):
    sensor = LidarSensorConfig(rings=32, azimuth_steps=450)
    log = LidarSimulator(STREET.model_copy(update={"duration_s": 1.0, "sensor": sensor})).log()
    assert "scan-to-map" not in {method.name for method in methods_for(desk, CompareConfig())[0]}

    comparison = compare(log, CompareConfig(methods=("gicp", "scan-to-map"), pairs=2), tmp_path)

    by_scans, by_map = comparison.runs
    assert (by_map.failures, by_map.coverage) == (0, 1.0)
    assert by_map.errors.ate_m < 0.5 * by_scans.errors.ate_m  # which has no times to deskew by
    tracked = track_log(
        log, load_config(None, ["loops.kind=none"], sensor="lidar"), progress=SILENT
    ).trajectory()
    T, T_tracked = by_map.trajectory.T_world_body, tracked.T_world_body  # the former moved to the truth
    np.testing.assert_allclose(inverse(T[0]) @ T, inverse(T_tracked[0]) @ T_tracked, atol=1e-6)
    assert {trial["method"] for trial in comparison.trials} == {"gicp"}


def odometry_records(comparison):
    return tables_of(comparison)[0].records


def trials_of(comparison):
    return comparison.trials


def comparison_rows(comparison, guess):
    return {
        row["method"]: row for row in registration_records(comparison.trials) if row["guess_off_by"] == guess
    }


@pytest.mark.parametrize("kind", ["desk", "street"])
def test_a_second_time_with_other_methods_gives_the_same_numbers(kind, request, tmp_path):
    before, config = request.getfixturevalue(f"on_{kind}"), RGBD if kind == "desk" else LIDAR
    alone = {"methods": ("gicp", "kiss-icp")}
    again = compare(request.getfixturevalue(kind), config.model_copy(update=alone), tmp_path)
    for records in (odometry_records, trials_of):
        expected = [row for row in without_times(records(before)) if row["method"] in alone["methods"]]
        assert without_times(records(again)) == expected


def test_methods_for_images_are_left_out_of_a_lidar_log(street):
    methods, notes = methods_for(street, CompareConfig())
    assert {"icp", "gicp", "ndt", "hough-ndt", "hough-gicp", "kiss-icp"} <= {
        method.name for method in methods
    }
    assert notes == ["local-map, isvd, pnp, rgbd: left out, for the log has no images"]
    with pytest.raises(ConfigError, match="isvd: left out, for the log has no images; choose others of"):
        methods_for(street, CompareConfig(methods=("isvd",)))


class Stumbles:
    """Breaks down with the third frame, and with every pair."""

    def __init__(self, _target):
        pass

    def align(self, _source, _T_target_source):
        raise ZeroDivisionError("over\na stone")


def test_a_method_that_breaks_down_does_not_take_the_others_along(desk, on_desk, monkeypatch, tmp_path):
    def with_a_bad_one(source, config):
        methods, notes = methods_for(source, config)
        return [registration_method("bad", Stumbles, uses_guess=True), *methods], notes

    monkeypatch.setattr(compare_module, "methods_for", with_a_bad_one)
    comparison = compare(desk, RGBD.model_copy(update={"methods": ("gicp",)}), tmp_path)

    bad, good = comparison.runs
    assert bad.broke == "broke down at frame 1: ZeroDivisionError: over a stone"
    assert (bad.errors, len(bad.trajectory)) == (PathErrors(), 0)
    assert good.errors == on_desk.runs[2].errors
    rows = [row for row in registration_records(comparison.trials) if row["method"] == "bad"]
    assert [(row["right"], row["wrong"], row["no_answer"], row["median_m"]) for row in rows] == 3 * [
        (0, 0, 3, None)
    ]
    assert "bad broke down at frame 1: ZeroDivisionError: over a stone" in tables_text(comparison)


def damaged(log, bad):
    """A log of which some frames cannot be read."""

    def tear(index, frame):
        if index in bad:
            raise FrameError(f"frame {frame.stamp_ns}: torn")
        return frame

    return changed_frames(log, tear)


def test_frames_that_cannot_be_read_are_skipped_for_all(desk, tmp_path):
    config = RGBD.model_copy(update={"methods": ("gicp",), "pairs": 6})
    comparison = compare(damaged(desk, {3, 4}), config, tmp_path / "some")
    assert [skip.reason.endswith("torn") for skip in comparison.skipped] == [True, True]
    assert comparison.runs[0].frames == 6
    assert comparison.runs[0].errors.ate_m < 0.02
    with pytest.raises(DataError, match="none of 8 frames can be read; the first: frame"):
        compare(damaged(desk, set(range(8))), RGBD, tmp_path / "all")


def test_without_truth_there_is_speed_and_how_far_views_disagree(desk, tmp_path):
    config = RGBD.model_copy(update={"methods": ("gicp", "icp")})
    comparison = compare(replace(desk, truth=None), config, tmp_path / "cells")
    row, other = odometry_records(comparison)
    first, second = odometry_records(compare(desk, config, tmp_path / "with truth"))
    assert first["ate_rmse_m"] > 2.0 * second["ate_rmse_m"]
    assert row["disagreement_m"] > 2.0 * other["disagreement_m"]
    assert first["disagreement_m"] is None
    assert (row["ate_rmse_m"], row["rpe_rmse_m"], row["drift_ratio"]) == (None, None, None)
    assert row["frames_per_s"] > 0.0
    assert not comparison.trials
    assert "the log has no truth" in tables_text(comparison)
    write_comparison(tmp_path / "out", comparison)
    assert (tmp_path / "out/paths.png").is_file()
    assert not (tmp_path / "out/registration.csv").exists()


@pytest.fixture(scope="module")
def written(on_desk, tmp_path_factory):
    write_comparison(folder := tmp_path_factory.mktemp("written"), on_desk)
    return folder


def test_the_files_agree_with_each_other(on_desk, written):
    report = json.loads((written / "comparison.json").read_text())
    for name in ("odometry", "registration"):
        with (written / f"{name}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert [row["method"] for row in rows] == [row["method"] for row in report[name]]
    assert float(rows[0]["right_ratio"]) == report["registration"][0]["right_ratio"]
    assert json.loads((written / "manifest.json").read_text())["config"]["pairs"] == 3
    tables = (written / "tables.md").read_text()
    assert all(f"| {run.method} | {run.errors.ate_m:.4f} |" in tables for run in on_desk.runs)
    assert len(list(csv.DictReader((written / "trials.csv").open()))) == len(on_desk.trials)
    path = read_tum(written / "trajectories" / "gicp.tum")
    np.testing.assert_allclose(path.T_world_body, on_desk.runs[2].trajectory.T_world_body, atol=1e-12)
    for picture in ("paths.png", "path_errors.png", "registration_errors.png"):
        assert cv2.imread(str(written / picture)).std() > 5.0


def test_one_mcap_file_holds_all_of_it(on_desk, written, tmp_path):
    with (written / "compare.mcap").open("rb") as file:
        counts: dict[str, int] = {}
        for _, channel, _ in make_reader(file, validate_crcs=True).iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
    for run in on_desk.runs:
        assert counts[f"/trajectory/{run.method}"] == 1
        assert counts[f"/errors/{run.method}"] == 8
    assert counts["/trajectory/truth"] == 1
    assert counts["/trials/gicp"] == 9
    assert counts["/trials/pnp"] == 3

    write_comparison(tmp_path, on_desk)
    for name in ("compare.mcap", "paths.png", "tables.md", "comparison.json"):
        assert (tmp_path / name).read_bytes() == (written / name).read_bytes()


def test_the_verb_prints_both_tables_and_leaves_a_folder(desk_log, tmp_path):
    out = tmp_path / "compared"
    arguments = ("compare", desk_log, "--method", "gicp", "--last", 5, "--pairs", 2, "--out", out)
    shown = mapper(*arguments).stdout
    titles = [line.split("  ")[0] for line in shown.splitlines() if not line.startswith(" ")]
    assert titles == ["method", "gicp", "method", "gicp", "gicp", "gicp", "files", "in"]
    assert json.loads((out / "manifest.json").read_text())["config"]["source"]["last_frame"] == 5

    assert "exists already" in mapper(*arguments, status=1).stderr
    assert mapper(*arguments, "--overwrite", "--quiet").stdout == ""
    assert not (out / "cells").exists()
    refused = mapper("compare", desk_log, "--method", "magic", "--out", tmp_path / "other", status=1)
    assert "mapper: no method 'magic'; want one of local-map, isvd, pnp, rgbd, icp" in refused.stderr
    assert not (tmp_path / "other").exists()


def test_a_comparison_that_was_stopped_goes_on_where_it_was(desk, tmp_path, monkeypatch):
    chosen = {"methods": ("gicp", "kiss-icp"), "settings": {"pairs": 0}}
    once = compare_into(desk, out=tmp_path / "once", **chosen)
    with monkeypatch.context() as patch:
        patch.setattr("mapper.evaluators.compare.methods.OdometryTracker.add", interrupt)
        with pytest.raises(KeyboardInterrupt):
            compare_into(desk, out=tmp_path / "out", **chosen)
    followed = []
    monkeypatch.setattr(compare_module.MethodRun, "add", recording(followed, compare_module.MethodRun.add))

    comparison = compare_into(desk, out=tmp_path / "out", **chosen)

    assert followed == ["kiss-icp"] * 8
    assert without_times(odometry_records(comparison)) == without_times(odometry_records(once))
    assert (tmp_path / "out/compare.mcap").read_bytes() == (tmp_path / "once/compare.mcap").read_bytes()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        path.name for path in (tmp_path / "once").iterdir()
    }


def interrupt(*_):
    raise KeyboardInterrupt


def recording(followed, add):
    def recorded(run, frame):
        followed.append(run._method.name)
        add(run, frame)

    return recorded


@pytest.mark.skipif(not KITTI.is_dir(), reason=f"{KITTI} is not here")
def test_real_scans_are_followed_to_centimetres(tmp_path):
    source = open_source(KITTI, SourceConfig(last_frame=3))
    comparison = compare(source, CompareConfig(methods=("gicp", "hough-gicp"), pairs=0), tmp_path)
    for run in comparison.runs:
        assert run.failures == 0
        assert run.errors.ate_m < 0.03, run.method
