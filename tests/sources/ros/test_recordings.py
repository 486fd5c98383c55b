"""MCAP files, ROS 1 bags and ROS 2 folders: whole, cut off, damaged."""

import shutil
import sqlite3

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import PinholeCamera
from mapper.runtime.ordered_map import ordered_map
from mapper.sources import open_source
from tests.support.recordings import (
    CAMERA,
    COLOR,
    DEPTH,
    add_messages,
    camera_info,
    image,
    shots,
    write,
    write_folder,
)
from tests.support.tum_logs import FIRST_NS, PERIOD_NS, picture

KINDS = ["log.mcap", "log.bag", "log"]
WIDE = PinholeCamera(320, 240, 300.0, 300.0, 159.5, 119.5)


def bulky(n):
    """Messages that do not compress, so that there are several chunks."""
    rng = np.random.default_rng(0)
    messages = []
    for i in range(n):
        stamp_ns = FIRST_NS + i * PERIOD_NS
        rgb = rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
        messages += [
            image(stamp_ns, DEPTH, np.full((240, 320), 1000, np.uint16), "16UC1"),
            image(stamp_ns, COLOR, rgb, "rgb8"),
            camera_info(stamp_ns, camera=WIDE),
        ]
    return messages


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("other", ["a.bag", "a.mcap", "recording", "a.db3"])
def test_a_recording_is_known_by_its_bytes(tmp_path, name, other):
    path = write(tmp_path / name, shots(2))
    file = path if path.is_file() else next(path.glob("*.db3"), None) or next(path.glob("*.mcap"))
    log = open_source(file.rename(tmp_path / other))
    assert (log.sensor, len(log)) == ("rgbd", 2)


@pytest.mark.parametrize("name", KINDS)
def test_a_recording_is_a_log_by_the_stamps_of_its_headers(tmp_path, name):
    """Folders are recorded a nanosecond a message."""
    source = open_source(write(tmp_path / name, shots(6)))

    assert (source.sensor, source.name, len(source)) == ("rgbd", "log", 6)
    assert source.kind == {"log.mcap": "mcap", "log.bag": "rosbag", "log": "rosbag2"}[name]
    for i, entry in enumerate(source.entries()):
        rgb, units = picture(i)
        frame = entry.load()
        assert entry.stamp_ns == frame.stamp_ns == FIRST_NS + i * PERIOD_NS
        assert entry.depth_stamp_ns == entry.stamp_ns - 5_000_000
        assert frame.camera == CAMERA
        np.testing.assert_array_equal(frame.image, rgb)
        np.testing.assert_array_equal(frame.depth_m, units.astype(np.float32) / np.float32(1000))
        np.testing.assert_array_equal(entry.scan().points_body, frame.scan().points_body)
        assert entry.load(colour=False).image.shape == (48, 64)
    assert source.choices == [f"colour {COLOR}, depth {DEPTH}"]


def test_a_folder_of_mcap_files_is_one_log(tmp_path):
    messages = shots(6)
    for number in (10, 2, 1):  # 10 comes last, whatever the alphabet says
        part = {1: messages[:6], 2: messages[6:12], 10: messages[12:]}[number]
        write(tmp_path / f"drive/drive_{number}.mcap", part)
    (tmp_path / "drive/metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    source = open_source(tmp_path / "drive")
    assert source.kind == "rosbag2"
    assert [entry.load().stamp_ns for entry in source.entries()] == [
        FIRST_NS + i * PERIOD_NS for i in range(6)
    ]


@pytest.mark.parametrize("ending", [".mcap", ".bag"])
def test_parts_are_joined_in_the_order_in_which_they_were_recorded(tmp_path, ending):
    messages = shots(6)
    for number, part in enumerate((messages[6:], messages[:6])):
        write(tmp_path / f"drive/drive_{number}{ending}", part)
    source = open_source(tmp_path / "drive")
    assert source.stamps_ns.tolist() == [FIRST_NS + i * PERIOD_NS for i in range(6)]
    assert not any("set back" in note for note in source.notes)


@pytest.mark.parametrize("ending", [".mcap", ".bag"])
def test_recordings_of_other_names_are_no_parts_unless_rosbag2_lists_them(tmp_path, ending):
    messages = shots(6)
    for name, part in (("morning", messages[:6]), ("evening", messages[6:])):
        write(tmp_path / f"drives/{name}{ending}", part)
    with pytest.raises(SourceError, match=f"open one of evening{ending}, morning{ending}"):
        open_source(tmp_path / "drives")
    if ending == ".mcap":
        files = "".join(f"  - {name}.mcap\n" for name in ("morning", "evening", "night"))
        (tmp_path / "drives/metadata.yaml").write_text(f"relative_file_paths:\n{files}")
        source = open_source(tmp_path / "drives")
        assert len(source) == 6
        assert sum("night.mcap" in note for note in source.notes) == 1


@pytest.mark.parametrize(("begin", "noted"), [(0, 1), (1, 1), (5, 0), (6, 0)])
def test_files_of_the_same_time_and_topics_are_noted(tmp_path, begin, noted):
    messages = shots(12)
    write(tmp_path / "drive/drive_0.bag", messages[:18])
    write(tmp_path / "drive/drive_1.bag", messages[3 * begin :])
    notes = open_source(tmp_path / "drive").notes
    assert sum("drive_1.bag" in note for note in notes) == noted


def test_a_part_between_others_that_is_missing_is_named(tmp_path):
    for number, part in enumerate((shots(9)[:9], shots(9)[9:18], shots(9)[18:])):
        write(tmp_path / f"drive/drive_{number}.bag", part)
    assert not [note for note in open_source(tmp_path / "drive").notes if "part" in note]
    (tmp_path / "drive/drive_1.bag").unlink()
    assert [note for note in open_source(tmp_path / "drive").notes if "no part 1 " in note]


def test_the_part_that_a_killed_rosbag_left_is_read(tmp_path):
    write(tmp_path / "drive/drive_0.bag", shots(6)[:9])
    write(tmp_path / "drive/drive_1.bag", shots(6)[9:]).rename(tmp_path / "drive/drive_1.bag.active")
    assert len(open_source(tmp_path / "drive")) == 6
    assert len(open_source(tmp_path / "drive/drive_1.bag.active")) == 3


def test_a_recording_of_another_kind_beside_the_parts_is_named(tmp_path):
    write(tmp_path / "drive/drive_0.mcap", shots(3))
    write(tmp_path / "drive/drive.bag", shots(3))
    assert sum("drive.bag" in note for note in open_source(tmp_path / "drive").notes) == 1


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_messages_that_rosbag2_compressed_are_read(tmp_path, storage):
    writer = FolderWriter(tmp_path / "log", version=8, storage_plugin=storage)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    write_folder(writer, shots(3))
    frames = [entry.load() for entry in open_source(tmp_path / "log").entries()]
    assert [frame.stamp_ns for frame in frames] == [FIRST_NS + i * PERIOD_NS for i in range(3)]
    np.testing.assert_array_equal(frames[0].image, picture(0)[0])


def test_files_that_rosbag2_compressed_come_with_what_unpacks_them(tmp_path):
    writer = FolderWriter(tmp_path / "log", version=8)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    write_folder(writer, shots(3))
    with pytest.raises(SourceError, match=r"log.db3.zstd: compressed as a whole.*: zstd -d .*log.db3.zstd"):
        open_source(tmp_path / "log")


def test_the_journal_of_a_recorder_that_was_killed_is_read(tmp_path):
    whole = write(tmp_path / "log", shots(3)) / "log.db3"
    killed = tmp_path / "killed.db3"
    database = sqlite3.connect(whole)
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("DELETE FROM messages WHERE id > 6")  # the third image and its depth
    database.commit()
    for ending in ("", "-wal"):
        shutil.copy(f"{whole}{ending}", f"{killed}{ending}")
    database.close()
    assert len(open_source(killed)) == 2


def test_a_file_of_a_folder_that_cannot_be_read_is_told(tmp_path):
    write(tmp_path / "drive/drive_0.mcap", shots(3))
    (tmp_path / "drive/drive_1.mcap").write_bytes(b"")
    source = open_source(tmp_path / "drive")
    assert len(source) == 3
    assert any("drive_1.mcap: does not begin as MCAP files do" in note for note in source.notes)
    (tmp_path / "drive/drive_0.mcap").write_bytes(b"")
    with pytest.raises(SourceError, match=r"drive_0.mcap"):
        open_source(tmp_path / "drive")


def test_a_bag_that_was_converted_to_mcap_is_a_log(tmp_path):
    bag = write(tmp_path / "log.bag", shots(3))
    path = tmp_path / "converted.mcap"
    with AnyReader([bag]) as reader, path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1")
        channels = {}
        for connection in reader.connections:
            schema = writer.register_schema(connection.msgtype.replace("/msg/", "/"), "ros1msg", b"")
            channels[connection.topic] = writer.register_channel(connection.topic, "ros1", schema)
        for connection, log_ns, data in reader.messages():
            writer.add_message(channels[connection.topic], log_time=log_ns, data=data, publish_time=log_ns)
        writer.finish()
    source = open_source(path)
    assert [entry.stamp_ns for entry in source.entries()] == [FIRST_NS + i * PERIOD_NS for i in range(3)]
    np.testing.assert_array_equal(next(source.entries()).load().image, picture(0)[0])


def test_other_libraries_read_what_is_written(tmp_path):
    mcap, bag = (write(tmp_path / name, shots(3)) for name in ("log.mcap", "log.bag"))
    with mcap.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        stamps = [message.log_time for _, channel, message in reader.iter_messages(topics=[COLOR])]
    assert stamps == [FIRST_NS + i * PERIOD_NS for i in range(3)]
    for path in (mcap, bag):
        with AnyReader([path]) as reader:
            message = next(
                reader.deserialize(data, c.msgtype) for c, _, data in reader.messages() if c.topic == COLOR
            )
        np.testing.assert_array_equal(message.data.reshape(48, 64, 3), picture(0)[0])
        assert message.header.frame_id == "optical"


def test_messages_can_be_read_ahead_in_threads(tmp_path):
    source = open_source(write(tmp_path / "log.mcap", shots(8)))
    alone = [entry.load().image for entry in source.entries()]
    ahead = list(ordered_map(lambda entry: entry.load().image, source.entries(), workers=3))
    np.testing.assert_array_equal(alone, ahead)


@pytest.mark.parametrize("name", ["log.mcap", "log.bag"])
@pytest.mark.parametrize("share", [0.1, 0.35, 0.6, 0.85, 0.999])
def test_a_log_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path, name, share):
    path = write(tmp_path / name, bulky(60))
    size = path.stat().st_size
    whole = [entry.stamp_ns for entry in open_source(path).entries()]
    assert len(whole) == 60
    with path.open("r+b") as file:
        file.truncate(int(share * size))
    source = open_source(path)
    got = [entry.load().stamp_ns for entry in source.entries()]
    assert got == whole[: len(got)]
    assert len(got) >= share * 60 - 12  # a chunk or two
    assert any("cut off" in note and "bytes at its end" in note for note in source.notes)


@pytest.mark.parametrize("name", ["log.mcap", "log.bag"])
def test_a_damaged_chunk_costs_itself_only(tmp_path, name):
    path = write(tmp_path / name, bulky(60))
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    source = open_source(path)
    got = [entry.load().stamp_ns for entry in source.entries()]
    if name == "log.mcap":  # its chunks have checksums
        assert 40 <= len(got) < 60
        assert any("1 of " in note and "chunks are damaged" in note for note in source.notes)
    assert got[0] == FIRST_NS
    assert got[-1] == FIRST_NS + 59 * PERIOD_NS


def test_a_damaged_message_costs_its_frame_only(tmp_path):
    messages = shots(6)
    messages[7] = messages[7]._replace(cdr=messages[7].cdr[:-1000])  # the third colour image
    source = open_source(write(tmp_path / "log.mcap", messages))
    entries = list(source.entries())
    with pytest.raises(FrameError, match=r"log.mcap: /cam/color/image_raw at \d+: a damaged message"):
        entries[2].load()
    assert all(entries[i].load().image.shape == (48, 64, 3) for i in (0, 1, 3, 4, 5))


def test_a_damaged_first_message_does_not_hide_its_topic(tmp_path):
    messages = shots(6)
    for i in (0, 1, 2):  # depth, colour and calibration
        messages[i] = messages[i]._replace(cdr=messages[i].cdr[:20])
    source = open_source(write(tmp_path / "log.mcap", messages))
    assert len([1 for entry in source.entries() if entry.stamp_ns > FIRST_NS and entry.load()]) == 5


def test_what_is_no_recording_is_refused_by_name(tmp_path):
    for name in ("log.mcap", "log.bag", "log.db3"):
        (tmp_path / name).write_bytes(b"nothing of the kind" * 10)
        with pytest.raises(SourceError, match=name):
            open_source(tmp_path / name)
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(SourceError, match=name):
            open_source(tmp_path / name)


def test_a_recording_of_which_nothing_is_left_tells_what_was_lost(tmp_path):
    path = write(tmp_path / "log.mcap", shots(3))
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(SourceError, match=r"nothing to map: no message .* can be read; log.mcap: .* cut off"):
        open_source(path)


def test_a_recording_without_an_index_is_read_all_the_same(tmp_path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:  # neither chunks nor index nor summary
        writer = Writer(
            file,
            compression=CompressionType.NONE,
            index_types=IndexType.NONE,
            use_chunking=False,
            use_statistics=False,
            use_summary_offsets=False,
            repeat_channels=False,
            repeat_schemas=False,
        )
        writer.start()
        add_messages(writer, shots(5))
        writer.finish()
    source = open_source(path)
    assert [entry.load().stamp_ns for entry in source.entries()] == [
        FIRST_NS + i * PERIOD_NS for i in range(5)
    ]
    assert not any("cut off" in note for note in source.notes)
