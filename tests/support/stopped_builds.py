"""Builds that are stopped, and what they have to end in."""

import pytest

from mapper.config.loading import load_config
from mapper.pipeline.build import build
from mapper.run.file_checks import check_run
from mapper.run.observers import Observers
from mapper.runtime.atomic import partial_of
from mapper.runtime.journal import StateFile
from mapper.sources import open_source
from tests.support.desk import REPEATABLE
from tests.support.files import files_of
from tests.support.progress import Stopped

CHECKPOINTS = ".checkpoints.part"
MEASURED = {"manifest.json", "frame_ms.csv", "summary.png", "cloud.png"}
"""What is not compared: measured times, and pictures, which these builds do not draw."""


class StopAt(Observers):
    """Stops a build when it has tracked so many frames."""

    def __init__(self, frames, stop=None):
        self.left, self.stop = frames, stop

    def on_frame(self, _step):
        self.left -= 1
        if not self.left:
            if self.stop is not None:
                self.stop()
            raise Stopped


def start(log, out, *overrides, checkpoint_s=0.0, **arguments):
    config = load_config(None, [REPEATABLE, *overrides], sensor=open_source(log).sensor)
    return build(open_source(log, config.source), config, out, checkpoint_s=checkpoint_s, **arguments)


def stopped(log, out, *overrides, **arguments):
    """Begin or go on with a build, and stop it."""
    with pytest.raises(Stopped):
        start(log, out, *overrides, **arguments)
    return partial_of(out) / CHECKPOINTS


def assert_same(run, wanted):
    ours, theirs = files_of(run.path), files_of(wanted.path)
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - MEASURED:
        assert ours[name] == theirs[name], name
    measured = {"timing": wanted.manifest.timing, "files": wanted.manifest.files}
    assert run.manifest.model_copy(update=measured) == wanted.manifest
    assert not any(finding.verdict == "failed" for finding in check_run(run.path))


def resumed(run):
    return [(resumption.step, resumption.frame) for resumption in run.manifest.timing.resumed]


def newest(folder):
    return next(iter(StateFile(folder, "odometry").versions()[0].values()))
