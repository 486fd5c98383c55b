"""Preview of a build: there after 5 s, refreshed, cheap, and gone once the run is whole."""

import cv2
import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import WriteError
from mapper.export import preview as module
from mapper.export.figures import ESTIMATE, OCCUPIED_CELL
from mapper.export.preview import PREVIEW, Preview, drawn
from mapper.pipeline.build import build
from mapper.run.observers import Observers
from mapper.runtime.atomic import partial_of
from mapper.sources import open_source
from tests.support.files import files_of


class Clock:
    """Two seconds a frame."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        return self.now_s


class Looker:
    """Observer that moves the clock on, and notes what the picture was by then."""

    def __init__(self, clock, path):
        self.clock, self.path = clock, path
        self.seen = []
        self.at_end = None

    def on_frame(self, _step):
        self.seen.append(self.path.read_bytes() if self.path.exists() else None)
        self.clock.now_s += 2.0

    def on_levelled(self, _T_level_world):
        self.at_end = self.path.exists()

    def on_mapped(self, _run, _results, _maps):
        assert not self.path.exists()


@pytest.fixture
def build_with_preview(desk_log, tmp_path):
    def built(out=tmp_path / "run"):
        config = load_config(None, ["source.last_frame=15"])
        source = open_source(desk_log, config.source)
        path, clock, told = partial_of(out) / PREVIEW, Clock(), []
        preview = Preview(path, source, on_first=lambda: told.append(path.exists()), clock=clock)
        looker = Looker(clock, path)
        run = build(source, config, out, observer=Observers(preview, looker))
        return run, looker, told

    return built


def test_the_first_picture_comes_after_five_seconds_and_the_run_is_as_without(
    build_with_preview, desk_log, tmp_path, monkeypatch
):
    monkeypatch.setattr(module, "_CPU_SHARE", 1.0)
    run, looker, told = build_with_preview()
    first = next(index for index, picture in enumerate(looker.seen) if picture is not None)
    assert first == 3, "frames are 2 s apart"
    assert told == [True]
    assert looker.at_end
    assert len(set(looker.seen[first:])) == len(looker.seen) - first, "drawn anew every time it is due"
    picture = cv2.imdecode(np.frombuffer(looker.seen[-1], np.uint8), cv2.IMREAD_COLOR)
    assert (picture == ESTIMATE[::-1]).all(axis=2).any()
    assert (picture == OCCUPIED_CELL[::-1]).all(axis=2).sum() > 200, "points of keyframes"
    assert PREVIEW not in run.manifest.files

    config = load_config(None, ["source.last_frame=15"])
    without = build(open_source(desk_log, config.source), config, tmp_path / "without")
    timed = {"manifest.json", "frame_ms.csv", "run.mcap"}
    mine, theirs = (
        {name: data for name, data in files_of(each.path).items() if name not in timed}
        for each in (run, without)
    )
    assert mine == theirs


def test_pictures_and_points_cost_no_more_than_their_share(build_with_preview, monkeypatch):
    monkeypatch.setattr(module, "_CPU_SHARE", -1.0)
    _, looker, _ = build_with_preview()
    pictures = {picture for picture in looker.seen if picture is not None}
    assert len(pictures) == 1, "the first alone"


def test_a_picture_that_cannot_be_written_ends_no_build(build_with_preview, monkeypatch):
    def refuse(_path):
        raise WriteError("disk is full")

    monkeypatch.setattr(module, "atomic_file", refuse)
    run, looker, told = build_with_preview()
    assert run.manifest.status == "complete"
    assert not any(looker.seen)
    assert told == []


@pytest.mark.parametrize("points", [np.empty((0, 2)), np.full((3, 2), 1e3), np.zeros((5, 2))])
def test_any_path_can_be_drawn(points):
    for path in (
        np.zeros((1, 2)),
        np.array([[0.0, 0.0], [0.0, 500.0]]),
        np.array([[-1e-9, 0.0], [3.0, 0.0]]),
    ):
        assert drawn(path, points, text="0 of 1").shape == (480, 640, 3)
