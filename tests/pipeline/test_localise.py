"""A later log localised in a finished map, which stays as it is."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config, overridden
from mapper.core.errors import ConfigError, RunError
from mapper.core.geometry import exp, fit_rigid
from mapper.core.timebase import nearest
from mapper.odometry.keyframes.odometry import KeyframeOdometry
from mapper.pipeline.build import build
from mapper.pipeline.known_map import load_known_map
from mapper.pipeline.localise import localise
from mapper.run.file_checks import check_run
from mapper.run.folder import Run, open_run
from mapper.run.frame_records import read_records
from mapper.run.pose_covariances import read_poses
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import chained
from mapper.sources.trajectory_files import read_tum
from tests.support.command_line import mapper
from tests.support.files import files_of


@pytest.fixture(scope="module")
def localised(first, desk_log):
    """The second half in it, by the command line."""
    before = files_of(first.path)
    out = first.path.with_name("localised")
    mapper("localise", desk_log, "--in", first.path, "--first", 16, "--out", out)
    assert files_of(first.path) == before
    return out


def in_map(first, log, out, *overrides):
    known = load_known_map(first.path)
    config = overridden(known.config, ["source.first_frame=16", "source.last_frame=30", *overrides])
    return localise(open_source(log, config.source), known, config, out)


def miss_m(first, log, trajectory):
    """Return how far poses are from the truth, brought into the map by what fits the map's own path best."""
    own, own_truth, truth = first.trajectory, first.truth, open_source(log).truth
    known = own_truth.positions_world[nearest(own_truth.stamps_ns, own.stamps_ns)[0]]
    T_map_truth, _ = fit_rigid(own.positions_world, known)
    true = truth.moved(T_map_truth).positions_world[nearest(truth.stamps_ns, trajectory.stamps_ns)[0]]
    return np.linalg.norm(true - trajectory.positions_world, axis=1)


def test_every_frame_lies_where_it_was_taken_in_the_map(first, localised, desk_log):
    trajectory = read_tum(localised / "trajectory.tum")
    assert len(trajectory) == 15
    assert miss_m(first, desk_log, trajectory).max() < 0.02


def test_what_contradicts_the_camera_is_warned_of(first, desk_log, tmp_path, monkeypatch):
    for check in ("calibration_warnings", "sensor_notes"):
        monkeypatch.setattr(KeyframeOdometry, check, lambda _: ["wrong"])

    manifest = in_map(first, desk_log, tmp_path / "out")

    assert {"camera", "shutter"} <= {warning.kind for warning in manifest.warnings}


def test_the_manifest_tells_the_map_the_stretches_and_a_verdict(first, localised):
    manifest = json.loads((localised / "manifest.json").read_text())
    assert manifest["kind"] == "localised log"
    assert manifest["map"] == str(first.path)
    assert manifest["status"] == "complete"
    (stretch,) = manifest["stretches"]
    assert (stretch["state"], stretch["frames"]) == ("localised", 15)
    assert 3 <= stretch["constraints"] == manifest["counts"]["loops"]
    assert 0.0 < stretch["sigma_m"] < 0.02
    assert manifest["verdict"]["state"] == "trusted"
    assert (localised / "summary.png").stat().st_size > 1000
    with pytest.raises(RunError, match="is a localised log, not a run"):
        open_run(localised)


def test_a_map_is_not_replaced_by_a_log_localised_in_it(first, desk_log, localised):
    known = load_known_map(first.path)
    with pytest.raises(RunError, match="is not a localised log"):
        localise(open_source(desk_log), known, known.config, first.path, overwrite=True)
    with pytest.raises(RunError, match="is not a run folder"):
        build(open_source(desk_log), known.config, localised, overwrite=True)


def test_the_files_of_a_localised_log_are_checked(localised, tmp_path):
    copy = shutil.copytree(localised, tmp_path / "copy")
    assert {finding.verdict for finding in check_run(copy)} == {"well"}
    (copy / "trajectory.tum").write_text("")
    (damaged,) = [finding for finding in check_run(copy) if finding.verdict != "well"]
    assert damaged.name == "trajectory.tum"
    assert "localise again in" in damaged.remedy


def test_covariances_are_given_the_map(localised):
    poses = read_poses(localised / "poses.csv")
    assert np.isfinite(poses.covariances).all()
    assert (np.linalg.eigvalsh(poses.covariances) > 0.0).all()  # no pose of the new log is held
    assert [record.outcome for record in read_records(localised / "frames.csv")] == ["tracked"] * 15


def test_the_map_s_log_is_not_needed(first, desk_log, localised, tmp_path, monkeypatch):
    def missing(_run):
        raise RunError("the map's log is gone")

    monkeypatch.setattr(Run, "open_log", missing)
    in_map(first, desk_log, tmp_path / "out", "workers=1")
    name = "trajectory.tum"
    assert (tmp_path / "out" / name).read_bytes() == (localised / name).read_bytes()


def test_a_run_without_stored_places_has_them_observed_again(first, desk_log, tmp_path):
    old = shutil.copytree(first.path, tmp_path / "old")
    (old / "places.bin").unlink()
    manifest = in_map(open_run(old), desk_log, tmp_path / "out")
    assert manifest.counts.tracked == 15
    assert miss_m(first, desk_log, read_tum(tmp_path / "out" / "trajectory.tum")).max() < 0.02


def test_a_merged_map_has_the_places_of_its_runs(first, desk_log, localised, tmp_path):
    mapper("merge", first.path, "--out", tmp_path / "map", "--place", "truth", "--quiet")
    manifest = tmp_path / "map" / "manifest.json"
    record = json.loads(manifest.read_text())
    T_map_world = exp(np.array([0.0, 0.0, 1.0]), np.array([3.0, -2.0, 0.5]))
    record["runs"][0]["T_map_world"] = T_map_world.tolist()
    manifest.write_text(json.dumps(record, indent=2))
    known = load_known_map(tmp_path / "map")
    config = overridden(known.config, ["source.first_frame=16", "source.last_frame=30"])
    localise(open_source(desk_log, config.source), known, config, tmp_path / "out")
    trajectory, in_run = (read_tum(path / "trajectory.tum") for path in (tmp_path / "out", localised))
    np.testing.assert_allclose(
        trajectory.positions_world, in_run.moved(T_map_world).positions_world, atol=1e-3
    )


def test_a_map_whose_slice_was_changed_is_refused_before_tracking(first, tmp_path):
    changed = shutil.copytree(first.path, tmp_path / "changed")
    with (changed / "slice.pgm").open("ab") as file:
        file.write(b"0")
    with pytest.raises(RunError, match=r"slice\.pgm: .*mapper doctor .* --accept slice"):
        load_known_map(changed)


def test_another_place_is_refused_in_a_line(first, elsewhere, tmp_path):
    result = mapper("localise", elsewhere, "--in", first.path, "--out", tmp_path / "out", "--quiet", status=1)
    assert f"mapper: {elsewhere}: cannot be placed in {first.path}" in result.stderr
    assert "is it the same place?" in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_two_places_in_one_log_are_placed_as_far_as_they_are_known(first, desk_log, elsewhere, tmp_path):
    known = load_known_map(first.path)
    both = chained(open_source(desk_log, SourceConfig(first_frame=16)), open_source(elsewhere))
    both = replace(both, sessions=())
    manifest = localise(both, known, known.config, tmp_path / "out")
    # The second place is a desk too, and odometry by depth finds its way from one to the other.
    assert manifest.counts.tracked == 15
    assert manifest.stretches[0].state == "localised"
    assert {stretch.state for stretch in manifest.stretches[1:]} <= {"doubtful", "not localised"}
    assert manifest.verdict.state != "trusted"


def test_a_log_of_another_sensor_is_refused(first, tmp_path):
    sensor = LidarSensorConfig(rings=8, azimuth_steps=90)
    write_lidar_log(tmp_path / "log", STREET.model_copy(update={"duration_s": 0.2, "sensor": sensor}))
    with pytest.raises(ConfigError, match=r"of sensor lidar, and the places of .* were seen by rgbd"):
        localise(
            open_source(tmp_path / "log"),
            load_known_map(first.path),
            load_config(None, [], sensor="lidar"),
            tmp_path / "out",
        )


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("odometry.detector.max_features=300", r"odometry\.detector: fixed by"),
        ("graph.solve=none", r"graph\.solve=none: cannot join"),
        ("loops.propose=nearby", "recognised by visual words"),
    ],
)
def test_settings_that_do_not_fit_the_map_are_refused(first, desk_log, tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        in_map(first, desk_log, tmp_path / "out", override)
