"""Stamps that drivers leave unset, and frames of a topic's clouds, as the index of a recording has them."""

import struct

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.timebase import NS_PER_S
from mapper.sources import open_source
from mapper.sources.ros.encode_ros import cloud_message
from tests.support.recordings import transforms, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS

RECORDED_NS = [FIRST_NS + k * PERIOD_NS for k in range(25)]
POINTS = np.random.default_rng(3).uniform(-9.0, 9.0, (40, 3)).astype(np.float32)


def cloud(stamp_ns, recorded_ns, *, frame="lidar"):
    return cloud_message("/points", Scan(stamp_ns, POINTS), frame=frame)._replace(stamp_ns=recorded_ns)


def restamped(log):
    return sum("stamp of their own" in note for note in log.notes)


@pytest.mark.parametrize(
    "stamps_ns",
    [
        pytest.param([0] * 25, id="all 0"),
        pytest.param([FIRST_NS] * 25, id="all the same"),
        pytest.param([ns if k % 2 else 0 for k, ns in enumerate(RECORDED_NS)], id="every second 0"),
        pytest.param([0, *RECORDED_NS[1:]], id="the first 0"),
        pytest.param([ns // NS_PER_S * NS_PER_S for ns in RECORDED_NS], id="whole seconds"),
    ],
)
@pytest.mark.parametrize("ending", [".mcap", ".bag"])
def test_stamps_that_a_driver_leaves_unset_are_the_times_of_recording(tmp_path, stamps_ns, ending):
    messages = [cloud(*both) for both in zip(stamps_ns, RECORDED_NS, strict=True)]
    log = open_source(write(tmp_path / f"a{ending}", messages))
    assert log.stamps_ns.tolist() == RECORDED_NS
    assert restamped(log) == 1


def test_nanoseconds_beyond_a_second_are_no_time(tmp_path):
    messages = []
    for ns in RECORDED_NS:
        message = cloud(0, ns)
        swapped = struct.pack("<II", ns % NS_PER_S, ns // NS_PER_S)
        messages.append(message._replace(cdr=message.cdr[:4] + swapped + message.cdr[12:]))
    assert open_source(write(tmp_path / "a.mcap", messages)).stamps_ns.tolist() == RECORDED_NS


def test_stamps_of_a_clock_that_begins_at_0_are_kept(tmp_path):
    messages = [cloud(k * PERIOD_NS, ns) for k, ns in enumerate(RECORDED_NS)]
    log = open_source(write(tmp_path / "a.mcap", messages))
    assert log.stamps_ns.tolist() == [k * PERIOD_NS for k in range(25)]
    assert restamped(log) == 0


@pytest.mark.parametrize("ending", [".mcap", ".bag"])
def test_clouds_of_a_frame_that_tf_does_not_connect_are_named_and_left_out(tmp_path, ending):
    frames = ["front", "left", "right"]
    tf = transforms(("base", "front", np.eye(4)), ("base", "left", np.eye(4)))
    clouds = [cloud(ns, ns, frame=frames[k % 3]) for k, ns in enumerate(RECORDED_NS)]
    log = open_source(write(tmp_path / f"a{ending}", [tf, *clouds]))
    assert log.stamps_ns.tolist() == [ns for k, ns in enumerate(RECORDED_NS) if k % 3 < 2]
    assert sum("right" in note and "left," not in note for note in log.notes) == 1


def test_clouds_of_another_frame_after_the_others_are_frames_that_cannot_be_read(tmp_path):
    """A driver that was started again with another name of its frame: the rest of the path is missing."""
    clouds = [cloud(ns, ns, frame="old" if k < 15 else "new") for k, ns in enumerate(RECORDED_NS)]
    log = open_source(write(tmp_path / "a.mcap", clouds))
    assert log.stamps_ns.tolist() == RECORDED_NS
    assert len(log[14].points_body)
    with pytest.raises(FrameError, match="new"):
        log[15]
