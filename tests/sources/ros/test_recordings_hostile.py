"""Recordings that announce too much cost what is good about them, and neither memory nor time."""

import bz2
import os
import sqlite3
import struct
import tracemalloc
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from mapper.core.errors import DataError, SourceError
from mapper.sources import open_source
from mapper.sources.ros import mcap_file, recording, ros1_bag
from mapper.sources.ros.decode import decompressed
from mapper.sources.ros.mcap_file import open_mcap
from mapper.sources.ros.recording import Topic
from mapper.sources.ros.ros1_bag import open_bag
from tests.support.recordings import shots, write

FOOTER_BYTES = 1 + 8 + 20 + 8


def bag_record(data: bytes, **fields: bytes) -> bytes:
    header = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value
        for name, value in fields.items()
    )
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def bag_chunk(packed: bytes, compression: str, size: int) -> bytes:
    return bag_record(packed, op=b"\x05", compression=compression.encode(), size=struct.pack("<I", size))


def mcap_chunk(packed: bytes, compression: str, size: int) -> bytes:
    body = struct.pack("<QQQII", 0, 1, size, 0, len(compression)) + compression.encode()
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


CHUNKS = [
    (ros1_bag.unpack, bag_chunk, "lz4", lz4.frame.compress),
    (ros1_bag.unpack, bag_chunk, "bz2", bz2.compress),
    (mcap_file.unpack, mcap_chunk, "lz4", lz4.frame.compress),
    (mcap_file.unpack, mcap_chunk, "zstd", zstandard.compress),
    (mcap_file.unpack, mcap_chunk, "", bytes),
]


@pytest.mark.parametrize(("unpack", "chunk", "compression", "pack"), CHUNKS)
def test_a_chunk_is_unpacked_no_further_than_it_announces(unpack, chunk, compression, pack):
    content = bytes(range(256)) * 40
    assert bytes(unpack(chunk(pack(content), compression, len(content)))) == content
    for size in (0, 100, len(content) - 1, len(content) + 1, 1 << 20):
        with pytest.raises(DataError, match=r"a chunk of \d+ bytes"):
            unpack(chunk(pack(content), compression, size))
    bomb = chunk(pack(bytes(64 << 20)), compression, 1000)
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"a chunk of \d+ bytes"):
            unpack(bomb)
        assert tracemalloc.get_traced_memory()[1] < len(bomb) + (1 << 20)
    finally:
        tracemalloc.stop()


def test_no_chunk_is_unpacked_that_announces_too_much(monkeypatch):
    monkeypatch.setattr(recording, "MOST_BYTES", 1 << 20)
    content = bytes((1 << 20) + 1)
    too_much = "a chunk of 1048577 bytes; more than 1048576 are taken for damage"
    for unpack, chunk, compression, pack in CHUNKS:
        with pytest.raises(DataError, match=too_much):
            unpack(chunk(pack(content), compression, len(content)))
    with pytest.raises(DataError, match=too_much):
        decompressed(Topic("/t", "x/msg/Y", "cdr"), memoryview(zstandard.compress(content)))


def test_reading_ends_where_a_file_unpacks_to_many_times_its_size(tmp_path, monkeypatch):
    path = tmp_path / "log.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + 50 * mcap_chunk(zstandard.compress(bytes(1 << 20)), "zstd", 1 << 20))
    monkeypatch.setattr(recording, "MOST_BYTES", 1 << 20)
    opened = open_mcap(path)
    assert list(opened.messages()) == []
    assert (
        "log.mcap: 2 of 50 chunks unpack to 2097152 bytes, more than 255 times the file's size"
        in opened.notes[1]
    )


def damaged_index(path: Path, position: int, layout: str, value: int) -> None:
    """Overwrite a number of the first chunk index of an MCAP file, and let the file have no checksum."""
    data = bytearray(path.read_bytes())
    start, _, _ = struct.unpack_from("<QQI", data, len(data) - FOOTER_BYTES + 9)
    struct.pack_into("<I", data, len(data) - 12, 0)
    at = start
    while data[at] != 8:  # the opcode of a chunk index
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    struct.pack_into(layout, data, at + 9 + position, value)
    path.write_bytes(data)


@pytest.mark.parametrize("position", [16, 24], ids=["place", "length"])
@pytest.mark.parametrize("value", [0, 1, 9, 100, 1 << 20, 1 << 40, 1 << 63, (1 << 64) - 1])
def test_an_mcap_file_whose_index_is_damaged_is_walked(tmp_path, position, value):
    path = write(tmp_path / "log.mcap", shots(6))
    expected = [bytes(message.data) for message in open_mcap(path).messages()]
    damaged_index(path, position, "<Q", value)
    opened = open_mcap(path)
    assert [bytes(message.data) for message in opened.messages()] == expected
    assert len(open_source(path)) == 6


def test_an_mcap_summary_whose_checksum_is_wrong_is_not_used(tmp_path):
    path = write(tmp_path / "log.mcap", shots(6))
    data = bytearray(path.read_bytes())
    start, _, crc = struct.unpack_from("<QQI", data, len(data) - FOOTER_BYTES + 9)
    assert crc
    topic = data.index(b"/cam", start)
    data[topic + 1] ^= 1
    path.write_bytes(data)
    assert {message.topic.name.split("/")[1] for message in open_mcap(path).messages()} == {"cam"}


def test_a_bag_s_index_that_names_a_chunk_twice_is_not_used(tmp_path):
    path = write(tmp_path / "log.bag", shots(6))
    expected = [bytes(message.data) for message in open_bag(path).messages()]
    data = path.read_bytes()
    path.write_bytes(data + data[last_record(data) :])
    assert [bytes(message.data) for message in open_bag(path).messages()] == expected


@pytest.mark.parametrize("at", [1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
def test_a_bag_s_index_that_points_far_beyond_the_file_is_not_used(tmp_path, at):
    path = write(tmp_path / "log.bag", shots(6))
    expected = [bytes(message.data) for message in open_bag(path).messages()]
    data = path.read_bytes()
    last = last_record(data)
    place = data.index(b"chunk_pos=", last) + len(b"chunk_pos=")
    path.write_bytes(data[:place] + struct.pack("<Q", at) + data[place + 8 :])
    assert [bytes(message.data) for message in open_bag(path).messages()] == expected


def test_a_bag_s_index_that_announces_gigabytes_is_not_read(tmp_path):
    path = write(tmp_path / "log.bag", shots(6))
    expected = [bytes(message.data) for message in open_bag(path).messages()]
    data = bytearray(path.read_bytes())
    (header,) = struct.unpack_from("<I", data, last := last_record(data))
    struct.pack_into("<I", data, last + 4 + header, 1 << 31)
    path.write_bytes(data)
    os.truncate(path, 3 << 30)
    tracemalloc.start()
    try:
        assert [bytes(message.data) for message in open_bag(path).messages()] == expected
        assert tracemalloc.get_traced_memory()[1] < 1 << 30
    finally:
        tracemalloc.stop()


def last_record(data: bytes) -> int:
    """Return where the last record of a bag begins, which is about one of its chunks."""
    at = last = len(b"#ROSBAG V2.0\n")
    while at < len(data):
        last = at
        (header,) = struct.unpack_from("<I", data, at)
        (length,) = struct.unpack_from("<I", data, at + 4 + header)
        at += 8 + header + length
    return last


@pytest.mark.parametrize("name", ["log.mcap", "log.bag"])
def test_zeros_after_what_was_written_are_no_records(tmp_path, name):
    path = write(tmp_path / name, shots(6))
    whole = path.read_bytes()
    with path.open("r+b") as file:
        file.truncate(len(whole) - 50)
        file.truncate(1 << 33)  # a hole of 8 GiB, as a file system leaves it after a power cut
    assert len(open_source(path)) == 6


ENDLESS = """
    ALTER TABLE messages RENAME TO stored;
    CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)
    SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(1000000) AS data FROM n;
"""
COMPUTED = """
    ALTER TABLE messages RENAME COLUMN data TO stored;
    ALTER TABLE messages ADD COLUMN data BLOB GENERATED ALWAYS AS (zeroblob(1000000000)) VIRTUAL;
"""
SEARCHED = "DROP TABLE topics; CREATE VIRTUAL TABLE topics USING fts5(id, name, type, serialization_format);"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (ENDLESS, "messages is no table"),
        (COMPUTED, "column data of messages is computed"),
        (SEARCHED, "topics is no table"),
    ],
)
def test_a_database_whose_rows_are_computed_is_refused(tmp_path, change, why):
    path = changed_database(tmp_path, change)
    with pytest.raises(SourceError, match=rf"log\.db3: not a \.db3 file that rosbag2 wrote: {why}"):
        open_source(path)


def test_a_database_whose_definition_is_no_text_is_refused_in_one_line(tmp_path):
    path = write(tmp_path / "log", shots(3)) / "log.db3"
    path.write_bytes(path.read_bytes().replace(b"name TEXT", b"name T\xff\xffT"))
    with pytest.raises(SourceError, match=r"log\.db3: not a \.db3 file .*: Could not decode") as refused:
        open_source(path)
    assert "\n" not in str(refused.value)


def test_a_topic_whose_name_is_no_text_is_left_out(tmp_path):
    odd = """
        INSERT INTO topics (id, name, type, serialization_format, offered_qos_profiles, type_description_hash)
        VALUES (99, x'ff', 'x/msg/Y', 'cdr', '', '');
        INSERT INTO messages (topic_id, timestamp, data) VALUES (99, 1, x'00');
    """
    assert len(open_source(changed_database(tmp_path, odd))) == 6


def changed_database(tmp_path: Path, change: str) -> Path:
    path = write(tmp_path / "log", shots(6)) / "log.db3"
    with closing(sqlite3.connect(path)) as database:
        database.executescript(change)
        database.commit()
    return path
