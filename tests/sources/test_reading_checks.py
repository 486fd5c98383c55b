"""Images that repeat and returns beyond reach are noted, by a build and by an inspection."""

import shutil
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.doubts import Doubt
from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.timebase import NS_PER_S
from mapper.pipeline.build import build
from mapper.sources import inspection, open_source
from mapper.sources.config import SourceConfig
from mapper.sources.inspection import inspect_log
from mapper.sources.reading_checks import FROZEN_IMAGES, FROZEN_SCANS, ReadingChecks
from tests.support.logs import log_in_memory, memory_entry

CAMERA = PinholeCamera(8, 6, 6.0, 6.0, 3.5, 2.5)


def log_of(images, depths):
    """A log at 10 Hz whose frame i has the image and the depth of seeds images[i] and depths[i]."""
    entries = []
    for i, seeds in enumerate(zip(images, depths, strict=True)):
        image = np.random.default_rng(seeds[0]).integers(0, 256, (6, 8, 3), dtype=np.uint8)
        depth_m = np.random.default_rng(seeds[1]).uniform(1.0, 2.0, (6, 8)).astype(np.float32)
        entries.append(
            memory_entry(i * NS_PER_S // 10, RgbdFrame(i * NS_PER_S // 10, image, depth_m, CAMERA))
        )
    return log_in_memory(entries)


def notes_on(log, order=None):
    checks = ReadingChecks(log)
    for index in range(len(log)) if order is None else order:
        with suppress(FrameError):
            checks.log.entry_at(index).load()
    return [sentence for _, sentence in checks.notes()]


def frozen(n, first, count):
    return [first if first <= i < first + count else i for i in range(n)]


@pytest.mark.parametrize(
    ("is_depth", "what"),
    [(False, "same image; was the camera frozen?"), (True, "same depth image; was the depth camera frozen?")],
)
def test_a_frozen_camera_is_noted_with_its_frames_and_times(is_depth, what):
    def log(count):
        seeds = frozen(40, 7, count), range(100, 140)
        return log_of(*(reversed(seeds) if is_depth else seeds))

    verb = "have" if is_depth else "show"
    noted = [f"frames 7 … 13, 0.7 … 1.3 s after the first, {verb} the {what}"]
    assert notes_on(log(FROZEN_IMAGES + 2)) == noted
    assert notes_on(log(FROZEN_IMAGES + 2), np.random.default_rng(0).permutation(40).tolist()) == noted
    assert notes_on(log(FROZEN_IMAGES - 1)) == []


def test_frames_that_repeat_earlier_ones_are_doubted():
    log = log_of(frozen(40, 7, FROZEN_IMAGES), frozen(40, 30, FROZEN_IMAGES))
    checks = ReadingChecks(log)
    for entry in checks.log.entries():
        entry.load()
    doubts = checks.doubts()
    assert sorted(doubts) == log.stamps_ns[[*range(8, 12), *range(31, 35)]].tolist()
    assert doubts[log.stamps_ns[9]] == [Doubt("repeated image", "same image as 2 frames before")]
    assert doubts[log.stamps_ns[31]] == [Doubt("repeated image", "same depth image as 1 frames before")]


def scans_of(seeds):
    """A log at 10 Hz whose scan i has the points of seeds[i]."""
    scans = [
        Scan(i * NS_PER_S // 10, np.random.default_rng(seed).uniform(1.0, 2.0, (50, 3)).astype(np.float32))
        for i, seed in enumerate(seeds)
    ]
    return log_in_memory([memory_entry(scan.stamp_ns, scan) for scan in scans])


def test_scans_that_repeat_are_noted_and_doubted():
    log = scans_of(frozen(20, 12, FROZEN_SCANS))
    assert notes_on(log) == [
        "frames 12 … 14, 1.2 … 1.4 s after the first, have the same points; was the LiDAR or its driver "
        "frozen?"
    ]
    checks = ReadingChecks(log)
    for entry in checks.log.entries():
        entry.load()
    assert sorted(checks.doubts()) == log.stamps_ns[13:15].tolist()
    assert checks.doubts()[log.stamps_ns[14]] == [Doubt("repeated image", "same points as 2 frames before")]
    assert notes_on(scans_of(frozen(20, 12, FROZEN_SCANS - 1))) == []


def test_a_second_of_the_same_image_is_long_whatever_the_frame_rate():
    log = log_of(frozen(6, 2, 3), range(100, 106))
    slow = replace(log, stamps_ns=log.stamps_ns * 6)
    assert notes_on(log) == []
    assert len(notes_on(slow)) == 1


def test_a_damaged_frame_among_the_same_ones_hides_nothing():
    log = log_of(frozen(30, 5, 20), range(100, 130))
    entries = [log.entry_at(i) for i in range(30)]
    entries[14] = memory_entry(entries[14].stamp_ns, FrameError("damaged"))
    assert notes_on(log_in_memory(entries))[0].startswith("frames 5 … 24, ")


def test_the_same_image_now_and_again_is_no_frozen_camera():
    assert notes_on(log_of([i % 2 for i in range(60)], [i % 3 for i in range(60)])) == []


@pytest.mark.parametrize(("times", "noted"), [(1, 0), (2, 1), (3, 1)])
def test_a_camera_that_is_slower_than_its_stamps_is_noted(times, noted):
    notes = notes_on(log_of(np.repeat(range(20), times), range(20 * times)))
    assert len(notes) == noted
    assert all(note.startswith(f"{20 * (times - 1)} of {20 * times} frames") for note in notes)
    slow_depth = log_of(range(20), np.repeat(range(100, 110), 2))
    assert notes_on(slow_depth) == []


def test_far_returns_are_counted_over_the_log():
    scans = [Scan(i, np.full((20, 3), i, np.float32), far_returns=i % 3) for i in range(6)]
    entries = [memory_entry(scan.stamp_ns, scan) for scan in scans]
    assert notes_on(log_in_memory(entries, sensor="lidar")) == [
        "6 returns in 4 of 6 scans are farther than 5000 m, which no sensor reaches; left out"
    ]


@pytest.fixture(scope="module")
def frozen_log(desk_log, tmp_path_factory):
    """The log of the desk whose colour images 0 … 13 are the same, byte by byte."""
    log = shutil.copytree(desk_log, tmp_path_factory.mktemp("logs") / "frozen")
    images = sorted((log / "rgb").iterdir())
    for image in images[1:14]:
        shutil.copyfile(images[0], image)
    return log


NOTE = "frames 0 … 13, 0.0 … 0.9 s after the first, show the same image; was the camera frozen?"


def test_an_inspection_notes_it_whatever_part_of_the_log_it_loads(frozen_log, monkeypatch):
    assert NOTE in inspect_log(frozen_log, SourceConfig()).log.notes
    monkeypatch.setattr(inspection, "_MOST_LOADED", 8)
    assert NOTE in inspect_log(frozen_log, SourceConfig()).log.notes


def test_an_inspection_counts_what_cannot_be_read(desk_log, tmp_path):
    log = shutil.copytree(desk_log, tmp_path / "log")
    for image in sorted((log / "depth").iterdir())[4:7]:
        image.write_bytes(image.read_bytes()[:100])
    notes = inspect_log(log, SourceConfig()).log.notes
    assert [note.split(": ")[0] for note in notes] == ["3 of 31 frames looked at cannot be read; the first"]


def test_a_build_notes_it_in_the_manifest(frozen_log, tmp_path):
    config = load_config(None, ["loops.kind=none", "min_tracked_ratio=0", "min_tracked_frames=2"])
    run = build(open_source(frozen_log), config, tmp_path / "run")
    assert NOTE in run.manifest.input.notes
    assert run.manifest.counts.listed == 31


@pytest.mark.parametrize(("untimed", "noted"), [(range(0, 6, 2), 1), (range(0), 0), (range(6), 0)])
def test_scans_without_times_among_others_with_times_are_counted(untimed, noted):
    points = np.random.default_rng(2).uniform(1.0, 9.0, (6, 20, 3)).astype(np.float32)
    times_s = np.linspace(0.0, 0.1, 20, dtype=np.float32)
    scans = [Scan(k * 10**8, points[k], times_s=None if k in untimed else times_s) for k in range(6)]
    notes = notes_on(log_in_memory([memory_entry(scan.stamp_ns, scan) for scan in scans], sensor="lidar"))
    assert sum(note.startswith("3 of 6 scans have no times") for note in notes) == noted
    assert len(notes) == noted
