"""Metrics of merged maps: how their runs agree, and whether they lie where the truth says."""

import shutil

import pytest

from mapper.core.errors import DataError
from mapper.core.geometry import exp
from mapper.evaluators.metrics.map_reference import Reference
from mapper.evaluators.metrics.merged_map import merged_map_metrics, merged_map_quality
from mapper.merging.world_poses import as_built, by_truth
from tests.support.merged_runs import make_run, merged_map_of
from tests.support.octree_maps import mapped

NAMES = ("a", "b")
TOGETHER = "ATE RMSE, 2 runs SE(3)-aligned as one, if their truths share a frame"


@pytest.fixture
def runs(tmp_path):
    """Two runs whose worlds lie a metre apart in the truth's."""
    octree = mapped(0)
    shift = exp([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    return [
        make_run(tmp_path / "a", octree, log="sha256:a", T_truth_world=exp([0.0] * 3, [0.0] * 3)),
        make_run(tmp_path / "bb", octree, log="sha256:b", T_truth_world=shift),
    ]


def metrics_of(merged, **settings):
    metrics, notes = merged_map_metrics(merged, NAMES, **settings)
    return {metric.name: metric.value for metric in metrics}, notes


def test_misplaced_runs_are_told_by_the_error_of_all_together(runs, tmp_path):
    found, notes = metrics_of(merged_map_of(as_built(runs), tmp_path / "map").map)
    assert notes == []
    assert found["runs"] == 2
    assert found["b: walls agree there"] == 100.0
    assert max(found[f"{name}: ATE RMSE, SE(3)-aligned"] for name in NAMES) < 1e-9
    assert 0.1 < found[TOGETHER] < 1.0

    found, _ = metrics_of(merged_map_of(by_truth(runs), tmp_path / "right").map)
    assert found[TOGETHER] < 1e-9
    assert found["b: walls agree there"] < 100.0


def test_a_run_whose_folder_is_gone_has_no_truth(runs, tmp_path):
    merged = merged_map_of(as_built(runs), tmp_path / "map").map
    shutil.rmtree(runs[1].path)
    found, (note,) = metrics_of(merged)
    assert "a: ATE RMSE, SE(3)-aligned" in found
    assert TOGETHER not in found
    assert note.startswith("b: no truth: ")


def test_the_map_is_held_against_a_reference_in_its_own_world(runs, tmp_path):
    merged = merged_map_of(as_built(runs), tmp_path / "map").map
    reference = Reference("cloud", points=merged.octree.occupied())
    (_, precision, *_) = merged_map_quality(merged, reference, voxels=0)
    assert precision.quantity == "occupied precision"
    assert precision.value == 1.0
    with pytest.raises(DataError, match="no truth of its own"):
        merged_map_quality(merged, Reference("synthetic world", in_truth=True), voxels=1)
