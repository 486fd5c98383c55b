"""A build survives what happens to recordings: it maps what was good and tells what was lost."""

import struct
from collections.abc import Sequence

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.timebase import NS_PER_S
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.ros.encode_ros import SerializedMessage
from mapper.sources.ros.log_writing import COLOR, DEPTH
from mapper.sources.ros.mcap_file import open_mcap
from mapper.sources.writers import write_log
from tests.support.recordings import write

Messages = Sequence[SerializedMessage]


@pytest.fixture(scope="module")
def messages(desk_log, tmp_path_factory) -> Messages:
    path = tmp_path_factory.mktemp("faulty") / "desk.mcap"
    write_log(open_source(desk_log), path, kind="mcap")
    return [
        SerializedMessage(log_ns, topic.name, topic.type, bytes(data))
        for topic, log_ns, _, data in open_mcap(path).messages()
    ]


def damaged(messages: Messages) -> list[SerializedMessage]:
    """Every eighth image is cut short or overwritten."""
    rng = np.random.default_rng(0)
    spoilt = []
    for i, message in enumerate(messages):
        cdr = message.cdr
        if "image" in message.topic and i % 8 == 0:
            cdr = cdr[: len(cdr) // 2] if i % 16 else rng.bytes(len(cdr))
        spoilt.append(message._replace(cdr=cdr))
    return spoilt


def missing(messages: Messages) -> list[SerializedMessage]:
    """One message in six is not there."""
    rng = np.random.default_rng(1)
    return [message for message in messages if rng.random() > 1 / 6]


def set_back(messages: Messages) -> list[SerializedMessage]:
    """After the first three quarters the clock is a second behind."""
    at = messages[len(messages) * 3 // 4].stamp_ns
    return [
        message if message.stamp_ns < at else _stamped(message, message.stamp_ns - NS_PER_S)
        for message in messages
    ]


def stopped(messages: Messages) -> list[SerializedMessage]:
    """Depth ends after two thirds."""
    at = messages[len(messages) * 2 // 3].stamp_ns
    return [
        message for message in messages if not (message.topic.startswith(DEPTH) and message.stamp_ns > at)
    ]


def _stamped(message: SerializedMessage, stamp_ns: int) -> SerializedMessage:
    stamp = struct.pack("<iI", *divmod(stamp_ns, NS_PER_S))
    return message._replace(cdr=message.cdr[:4] + stamp + message.cdr[12:])


ALONE = "have no depth image within 20 ms; left out"


@pytest.mark.parametrize(
    ("name", "fault", "least", "told"),
    [
        ("desk.mcap", damaged, 18, "have stamps that cannot be right"),
        ("desk.mcap", missing, 18, ALONE),
        ("desk.bag", missing, 18, ALONE),
        ("desk.mcap", set_back, 20, "the clock was set back while recording"),
        ("desk.bag", set_back, 20, "the clock was set back while recording"),
        ("desk.mcap", stopped, 18, ALONE),
        ("desk.bag", stopped, 18, ALONE),
    ],
)
def test_a_faulty_recording_is_tracked_as_far_as_it_is_good(tmp_path, messages, name, fault, least, told):
    source = open_source(write(tmp_path / name, fault(messages)))
    assert any(told in note for note in source.notes)
    tracking = track_log(source, load_config(None, ["loops.kind=none"]), progress=SILENT)
    stamps_ns = tracking.trajectory().stamps_ns
    assert least <= len(stamps_ns) < sum(message.topic == f"{COLOR}/camera_info" for message in messages)
    assert (np.diff(stamps_ns) > 0).all()
