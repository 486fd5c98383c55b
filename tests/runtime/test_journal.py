"""Journals and states that were torn or damaged are found out."""

import pytest

from mapper.core.errors import DataError, WriteError
from mapper.runtime.journal import Journal, StateFile, opened_state


def written(path, *records):
    journal = Journal(path)
    places = [journal.append(record) for record in records]
    journal.write(journal.take())
    return journal, places


def test_records_come_back_in_order_at_their_places(tmp_path):
    records = [b"first", b"", b"\0" * 1000]
    journal, places = written(tmp_path / "journal", *records)
    assert list(journal.records(journal.end)) == list(zip(places, records, strict=True))
    assert journal.path.stat().st_size == journal.end
    assert journal.append(b"more") == journal.end - len(b"more") - 24
    assert list(journal.records(places[1])) == [(0, b"first")]


def test_a_record_is_read_at_its_place_while_others_are_appended(tmp_path):
    journal, places = written(tmp_path / "journal", b"first", b"second" * 1000)
    assert journal.read(places[1]) == b"second" * 1000
    place = journal.append(b"third")
    with pytest.raises(DataError, match=f"damaged at byte {place}"):
        journal.read(place)  # it waits
    journal.write(journal.take())
    assert [journal.read(at) for at in (place, *places)] == [b"third", b"first", b"second" * 1000]


def test_a_journal_that_is_removed_begins_anew(tmp_path):
    journal, _ = written(tmp_path / "journal", b"first")
    assert journal.read(0) == b"first"
    journal.append(b"never written")
    journal.remove()
    assert not journal.path.exists()
    assert journal.append(b"new") == 0
    journal.write(journal.take())
    assert journal.read(0) == b"new"


def test_a_torn_tail_is_cut_off(tmp_path):
    journal, _ = written(tmp_path / "journal", b"first", b"second")
    end = journal.end
    with journal.path.open("ab") as file:
        file.write(b"half of a rec")
    again = Journal(journal.path)
    again.truncate(end)
    again.append(b"third")
    again.write(again.take())
    assert [record for _, record in again.records(again.end)] == [b"first", b"second", b"third"]


@pytest.mark.parametrize("place", [0, 9, 24, 30])
def test_a_flipped_byte_and_a_file_shorter_than_its_state_tells_are_found(tmp_path, place):
    journal, _ = written(tmp_path / "journal", b"first", b"second")
    with pytest.raises(DataError, match="damaged"):
        list(journal.records(journal.end + 30))
    with pytest.raises(DataError, match="cannot be read: No such file"):
        list(Journal(tmp_path / "none").records(5))
    data = bytearray(journal.path.read_bytes())
    data[place] ^= 1
    journal.path.write_bytes(data)
    with pytest.raises(DataError, match="journal: damaged at byte"):
        list(journal.records(journal.end))


def save(data):
    return lambda file: file.write(data)


def state_of(versions):
    found = {}
    for number, path in versions.items():
        with opened_state(path) as file:
            found[number] = file.read()
    return found


def test_the_last_two_versions_are_kept(tmp_path):
    state = StateFile(tmp_path, "odometry")
    for number in range(5):
        state.write(number, save(f"state {number}".encode()))
    versions, damaged = state.versions()
    assert list(state_of(versions).items()) == [(4, b"state 4"), (3, b"state 3")]
    assert damaged == 0
    state.remove()
    assert state.versions() == ({}, 0)


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "number"])
def test_a_damaged_version_leaves_the_one_before_it(tmp_path, damage):
    state = StateFile(tmp_path, "odometry")
    state.write(0, save(b"before"))
    state.write(1, save(b"newest"))
    path = tmp_path / "odometry.1"
    data = bytearray(path.read_bytes())
    if damage == "cut":
        del data[-2:]
    elif damage == "empty":
        data.clear()
    else:
        data[-1 if damage == "flip" else 16] ^= 4
    path.write_bytes(data)
    versions, damaged = state.versions()
    assert state_of(versions) == {0: b"before"}
    assert damaged == 1


def test_a_write_that_fails_leaves_the_newest_version(tmp_path):
    state = StateFile(tmp_path, "odometry")
    state.write(0, save(b"old"))
    state.write(1, save(b"newest"))

    def fail(file):
        file.write(b"half of")
        raise WriteError("no space left")

    with pytest.raises(WriteError):
        state.write(2, fail)
    assert state_of(state.versions()[0]) == {1: b"newest"}
