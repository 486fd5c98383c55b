"""States that come back to the bit, with their arrays' layout, and without what need not be written."""

import json
import os
import pickle
import struct

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera, Scan
from mapper.loops.scan_context_proposer import ScanPlace
from mapper.odometry.keyframes.focal_length import FocalLengthCheck
from mapper.runtime.archived import Archivable, archived
from mapper.runtime.state_file import dumps, fixed_parts, loads

BASE = np.arange(60.0).reshape(5, 12)


@pytest.mark.parametrize(
    "array",
    [
        BASE,
        BASE.T,
        BASE[:, :2],
        BASE[::2, 1::3],
        BASE[::-1, ::-2],
        BASE[1:1],
        np.broadcast_to(BASE[0], (3, 12)),
        BASE.astype(np.float32)[:, 3],
        np.array(2.5),
    ],
    ids=["C", "F", "columns", "steps", "backwards", "empty", "broadcast", "float32", "scalar"],
)
def test_arrays_keep_their_values_and_their_layout(array):
    copy = loads(dumps({"array": array}))["array"]
    np.testing.assert_array_equal(copy, array)
    assert (copy.dtype, copy.shape) == (array.dtype, array.shape)
    assert array.size < 2 or copy.strides == array.strides
    assert copy.flags.writeable == array.flags.writeable
    assert copy.flags.aligned
    assert not np.shares_memory(copy, array)


def test_what_was_one_object_is_one_again():
    array = np.zeros(3)
    first, second = loads(dumps([array, {"same": array}]))
    assert first is second["same"]


def test_fixed_parts_are_not_written_but_taken_from_the_new_object():
    camera = PinholeCamera(4, 3, 1.0, 1.0, 2.0, 1.5)
    state = FocalLengthCheck()
    state.camera = camera
    parts = fixed_parts(state, (PinholeCamera,))
    assert parts == {".camera": camera}
    data = dumps(state, fixed=parts)
    other = PinholeCamera(8, 6, 1.0, 1.0, 2.0, 1.5)
    assert loads(data, fixed={".camera": other}).camera is other
    with pytest.raises(DataError, match=r"a part '\.camera' that is not there"):
        loads(data)


class Clouds(Archivable):
    """Something that never changes."""


def place(stamp_ns):
    return ScanPlace(stamp_ns, np.zeros((2, 3), np.float32), np.eye(4))


def test_archived_data_is_referred_to_and_other_data_is_a_part_of_the_state():
    known, new, reference = Clouds(), place(3), archived(Clouds())
    archived(known)
    places = {id(archived(known)): 42, id(reference): 7}

    data = dumps([known, known, reference, new], archive=lambda asked: places[id(asked)])
    again = {42: archived(Clouds()), 7: archived(Clouds())}
    first, second, third, fourth = loads(data, archived=again.__getitem__)
    assert first is second is again[42].data
    assert third is again[7]
    assert fourth.stamp_ns == 3


def test_data_of_mapper_comes_back_and_without_an_archive_a_reference_with_its_data():
    scan = Scan(5, np.zeros((2, 3), np.float32), times_s=np.zeros(2, np.float32))
    for copy in (loads(dumps(scan)), loads(dumps(archived(scan))).data):
        assert copy.stamp_ns == 5
        np.testing.assert_array_equal(copy.points_body, scan.points_body)


class _Command:
    def __reduce__(self):
        return os.system, ("exit 3",)


def state_of(node):
    text = json.dumps(node).encode()
    return struct.pack("<8sQ", b"mapstat2", len(text)) + text


@pytest.mark.parametrize(
    "foreign",
    [
        pickle.dumps(_Command()),
        b"\x80\x04",
        state_of({"object": ["os.system", {"dict": []}]}),
        state_of({"object": ["mapper.runtime.atomic.write_text", {"dict": []}]}),
        state_of({"object": ["mapper.core.frames.np", {"dict": []}]}),
        state_of({"object": ["mapper.core.frames.ray_table", {"dict": []}]}),
        state_of({"model": ["mapper.core.frames.Scan", {}]}),
        state_of({"named": ["builtins.eval", ["1"]]}),
        state_of({"call": ["os.system", "exit 3"]}),
        state_of({"same": 5}),
        state_of({"array": [[0, 8], "|O", [1], [8], 0, True]}) + bytes(8),
        state_of({"array": [[0, 8], "<f8", [9], [8], 0, True]}) + bytes(8),
    ],
)
def test_a_foreign_state_runs_nothing(foreign, monkeypatch):
    monkeypatch.setattr(os, "system", lambda _: pytest.fail("it ran a command"))
    with pytest.raises(DataError):
        loads(foreign)


def test_what_cannot_be_written_is_told():
    with pytest.raises(DataError, match=r"a state that cannot be written: .*function"):
        dumps([BASE, lambda: None])


@pytest.mark.parametrize("cut", [0, 1, 20, -1])
def test_half_a_state_is_refused(cut):
    with pytest.raises(DataError, match="a state that cannot be read"):
        loads(dumps(BASE[:, :2])[:cut])


def test_an_array_larger_than_its_bytes_is_refused():
    for count in (0, 2):
        state = dumps({"array": np.zeros(count)})
        larger = state.replace(f"[{count}],[".encode(), b"[9],[")
        assert larger != state
        with pytest.raises(DataError):
            loads(larger)
