"""A build whose voxels are in a file, beyond a limit, makes the map that it would have made in memory."""

import pytest

from mapper.octree import sparse_grid
from mapper.octree.sparse_grid import FileArray
from mapper.pipeline.fuse import fuse
from mapper.run.folder import open_run
from mapper.sources import open_source
from tests.support.files import files_of
from tests.support.progress import Observer
from tests.support.stopped_builds import MEASURED, resumed, start, stopped


@pytest.fixture
def grown(monkeypatch):
    """Numbers of rows to which arrays in files have grown."""
    rows = []

    class Watched(FileArray):
        def grown(self, count):
            rows.append(count)
            return super().grown(count)

    monkeypatch.setattr(sparse_grid, "FileArray", Watched)
    return rows


def assert_same_map(run, wanted):
    ours, theirs = files_of(run.path), files_of(wanted.path)
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - MEASURED - {"config.json"}:
        assert ours[name] == theirs[name], name


@pytest.mark.parametrize("limit_mb", [0.001, 0.15, 0.17])
def test_a_build_that_was_stopped_while_fusing_makes_the_same_map(
    short_log, short_run, tmp_path, grown, limit_mb
):
    limit = f"octree.max_memory_mb={limit_mb}"
    stopped(short_log, tmp_path / "run", limit, progress=Observer("fuse", 14))
    run = start(short_log, tmp_path / "run", limit)

    assert max(grown) * sparse_grid.BLOCK_BYTES > 1e6 * limit_mb
    assert [step for step, _ in resumed(run)] == ["fuse"]
    assert_same_map(run, short_run)


@pytest.mark.parametrize("limits", [[], ["octree.max_memory_mb=0.1"]])
def test_a_build_goes_on_with_another_limit(short_log, short_run, tmp_path, grown, limits):
    stopped(short_log, tmp_path / "run", *limits, progress=Observer("fuse", 14))
    grown.clear()

    run = start(short_log, tmp_path / "run", "octree.max_memory_mb=0.15")

    assert grown
    assert resumed(run)
    assert run.config.octree.max_memory_mb == 0.15
    assert_same_map(run, short_run)


def test_a_run_is_fused_again_within_a_limit(short_log, short_run, street, street_run, tmp_path, grown):
    for log, wanted in ((short_log, short_run), (street, street_run)):
        grown.clear()
        run = start(log, tmp_path / log.name)
        octree = run.config.octree.model_copy(update={"max_memory_mb": 0.1})
        fuse(open_source(log), run, run.config.model_copy(update={"octree": octree}))
        assert grown
        assert_same_map(open_run(run.path), wanted)


def test_a_map_below_the_limit_is_in_memory(short_log, tmp_path, grown):
    start(short_log, tmp_path / "run", "octree.max_memory_mb=1000")
    assert not grown
