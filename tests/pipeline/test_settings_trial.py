"""Verdict of whole builds, and the trial of other settings behind it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.odometry.factory import odometry_for
from mapper.pipeline import settings_trial, track
from mapper.pipeline.build import build
from mapper.pipeline.fuse import fuse
from mapper.run.folder import open_run
from mapper.sources import open_source
from tests.support.command_line import mapper
from tests.support.desk import REPEATABLE
from tests.support.doubting_odometry import DoubtingOdometry, doubt_frames

SETTINGS = (REPEATABLE, "octree.resolution_m=0.1")
DOUBTED = dict.fromkeys((13, 14, 15, 17, 18, 19, 20), np.eye(4))


def only_with_few_features(monkeypatch):
    """Frames are doubted unless there are 2000 features."""

    def built(config, *rest):
        odometry = odometry_for(config, *rest)
        many = getattr(config, "detector", None) and config.detector.max_features >= 2000
        return odometry if many else DoubtingOdometry(odometry, DOUBTED)

    monkeypatch.setattr(track, "odometry_for", built)


def test_a_build_tells_what_helped_in_a_trial(desk_log, tmp_path, monkeypatch):
    only_with_few_features(monkeypatch)
    config = load_config(None, SETTINGS)
    run = build(open_source(desk_log, config.source), config, tmp_path / "run")

    manifest = run.manifest
    assert manifest.verdict.state == "doubtful"
    assert manifest.trial.tried["odometry.detector.max_features=2000"] == 0
    assert manifest.trial.unplaced == 7
    assert manifest.trial.frames == 31
    (sentence,) = manifest.verdict.sentences
    assert sentence.startswith("7 of 31 placed frames are doubtful, 22.6%")
    assert "try: --set odometry.detector.max_features=2000 (of 31 frames" in sentence

    def fails(*_, **__):
        raise AssertionError("the trial of the build is still good")

    monkeypatch.setattr("mapper.pipeline.fuse.try_settings", fails)
    again = fuse(run.open_log(), run, run.config)
    assert again.manifest.verdict == manifest.verdict
    assert again.manifest.warnings == manifest.warnings


def test_strict_builds_end_with_status_1_and_are_whole(desk_log, tmp_path, monkeypatch):
    doubt_frames(monkeypatch, DOUBTED)
    monkeypatch.setattr(settings_trial, "_FACTORS", {})
    arguments = ["build", desk_log, "--out", tmp_path / "run", "--set", SETTINGS[1], "--strict"]
    result = mapper(*arguments, status=1)
    run = open_run(tmp_path / "run")
    assert run.manifest.status == "complete"
    assert "mapper: " in result.stderr
    assert "run: doubtful: 7 of 31 placed frames are doubtful" in result.stderr.splitlines()[-1]
    printed = result.stdout
    assert "\nverdict " in printed
    assert "24 tracked, 7 doubtful, 0 lost" in printed
    assert evaluate(run.trajectory, run.truth)

    said = mapper("eval", run.path).stdout
    assert "verdict  doubtful\n" in said
    told = json.loads(mapper("eval", run.path, "--json").stdout)
    assert {"name", "value", "unit"} == told["metrics"][0].keys()
    assert told["verdict"]["state"] == "doubtful"
    page = tmp_path / "report.html"
    mapper("report", run.path, "--out", page)
    text = page.read_text()
    assert '<h3>run: doubtful</h3><ul><li class="heavy">7 of 31 placed frames' in text
    assert "<tr><th>frames doubtful</th>" in text


def test_a_trusted_run_passes_strictly(desk_run):
    assert desk_run.manifest.verdict.state == "trusted"
    assert desk_run.manifest.trial is None
    old = replace(desk_run, manifest=desk_run.manifest.model_copy(update={"verdict": None, "warnings": ()}))
    assert old.verdict == desk_run.manifest.verdict


def test_a_trial_looks_where_most_went_wrong():
    is_unplaced = np.zeros(1000, np.bool_)
    is_unplaced[[100, 103, 500, 501, 505, 507]] = True
    frames = settings_trial.worst_stretch(is_unplaced, 40)
    assert len(frames) == 40
    assert frames[0] + 10 <= 500 < 507 < frames[-1] + 1
    assert settings_trial.worst_stretch(is_unplaced[:30], 40).tolist() == list(range(30))


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ([], {"odometry.detector.max_features=2000", "odometry.search_px=30", "odometry.kind=pnp"}),
        (["odometry.kind=isvd"], {"odometry.previous_frames=8", "odometry.max_depth_m=10"}),
        (["odometry.kind=gicp"], {"odometry.coarse_cell_m=4", "odometry.kind=hough-ndt"}),
        (["odometry.kind=wheels"], set()),
    ],
)
def test_settings_to_try_are_settings(overrides, expected):
    found = dict(settings_trial.candidate_settings(load_config(None, overrides)))
    assert expected <= found.keys()
    assert bool(found) == bool(expected)
    for setting, config in found.items():
        assert config.odometry != load_config(None, overrides).odometry, setting
