"""Only regular files inside a log are read, whatever its lists name."""

import os
import shutil
import signal

import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.runtime import regular_files
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.inspection import inspect_log
from mapper.sources.scan_folders.scans import read_scan
from mapper.sources.writers import write_log
from tests.support.tum_logs import copy_numbered


@pytest.fixture(autouse=True)
def _no_hang():
    """End a test that waits for a pipe's writer."""
    signal.alarm(60)
    yield
    signal.alarm(0)


def renamed(log, name, number=1):
    """Let the list of colour images call one of them by another name."""
    lines = (log / "rgb.txt").read_text().splitlines()
    stamp, old = lines[number].split()
    lines[number] = f"{stamp} {name}"
    (log / "rgb.txt").write_text("\n".join(lines) + "\n")
    return log / old


@pytest.mark.parametrize("name", ["/etc/passwd", "../log/rgb/1.png", "rgb/../../x.png", "rgb/\0.png"])
def test_names_that_lead_out_of_a_log_are_refused(tiny_tum_log, name):
    log = tiny_tum_log(3)
    renamed(log, name)
    with pytest.raises(SourceError, match=r"rgb\.txt:2: '.*' leads out of the log's folder"):
        open_source(log)


@pytest.mark.parametrize("name", ["/etc/passwd", "..\\1.png", "../1.png"])
def test_an_mbag_s_names_may_not_either(tiny_tum_log, tmp_path, name):
    write_log(open_source(tiny_tum_log(3)), tmp_path / "out", kind="mbag")
    mbag = next((tmp_path / "out").glob("*.mbag"))
    lines = mbag.read_text().splitlines()
    words = lines[3].split("; ")
    mbag.write_text("\n".join([*lines[:3], "; ".join([words[0], name, *words[2:]]), *lines[4:]]) + "\n")
    with pytest.raises(SourceError, match=r"mbag:4: '.*' leads out of the log's folder"):
        open_source(mbag)


def test_an_image_that_is_a_link_out_of_the_log_is_refused(tiny_tum_log, tmp_path):
    log = tiny_tum_log(3)
    folder = copy_numbered(log, tmp_path / "numbered")
    for image in (renamed(log, "rgb/link.png").with_name("link.png"), folder / "depth/000001.png"):
        image.unlink(missing_ok=True)
        image.symlink_to("/etc/passwd")
        with pytest.raises(SourceError, match=rf"{image.name}: a link to /etc/passwd, out of the log"):
            open_source(log if image.name == "link.png" else folder)


@pytest.mark.parametrize("ending", [".pcd", ".npy", ".las", ".txt", ".bag", ".db3", ".mcap"])
def test_clouds_and_recordings_in_a_folder_are_no_links_out_of_it(tmp_path, ending):
    (tmp_path / "log").mkdir()
    np.savetxt(tmp_path / "log/1.xyz", np.random.default_rng(0).normal(0, 5, (50, 3)))
    text = (tmp_path / "log/1.xyz").read_bytes()
    for name in ("1", "2"):
        (tmp_path / f"secret{name}{ending}").write_bytes(text)
        (tmp_path / f"log/{name}{ending}").symlink_to(tmp_path / f"secret{name}{ending}")
    (tmp_path / "log/1.xyz").unlink()
    with pytest.raises(SourceError, match=r"out of the log|not a log of a known"):
        open_source(tmp_path / "log")


def test_links_that_stay_inside_and_linked_folders_are_fine(tiny_tum_log, tmp_path):
    log, disk = tiny_tum_log(4), tmp_path / "disk"
    image = renamed(log, "rgb/link.png", 2)
    (log / "rgb/link.png").symlink_to(image.name)
    shutil.move(log / "depth", disk)
    (log / "depth").symlink_to(disk)
    (tmp_path / "linked").symlink_to(log)
    for path in (log, tmp_path / "linked"):
        source = open_source(path)
        assert len([entry.load() for entry in source.entries()]) == 4


def test_pipes_and_devices_are_no_images(tiny_tum_log, tmp_path):
    log = tiny_tum_log(4)
    os.mkfifo(log / "rgb/pipe.png")
    renamed(log, "rgb/pipe.png")
    assert len(open_source(log)) == 3
    folder = copy_numbered(tiny_tum_log(3, folder="other"), tmp_path / "numbered")
    (folder / "rgb/000001.png").unlink()
    os.mkfifo(folder / "rgb/000001.png")
    with pytest.raises(FrameError, match=r"000001\.png: no regular file"):
        open_source(folder).entry_at(1).load()


def test_a_pipe_is_no_list_and_no_log(tiny_tum_log, tmp_path):
    log = tiny_tum_log(3)
    (log / "depth.txt").unlink()
    os.mkfifo(log / "depth.txt")
    with pytest.raises(SourceError, match=r"depth\.txt: no regular file"):
        open_source(log)
    for name in ("log.mcap", "log.las", "log.laz", "log.e57", "log.pcap", "log.sens", "log.mkv", "log.r3d"):
        os.mkfifo(tmp_path / name)
        for opened in (open_source, lambda path: inspect_log(path, SourceConfig())):
            with pytest.raises(SourceError, match=rf"{name}: a device or a pipe; want a file or a folder"):
                opened(tmp_path / name)
    with pytest.raises(FrameError, match=r"log\.las: no regular file"):
        read_scan(tmp_path / "log.las")


def test_a_list_without_end_is_refused_before_it_is_read(tiny_tum_log):
    log = tiny_tum_log(3)
    with (log / "depth.txt").open("r+b") as file:
        file.truncate(regular_files.MOST_BYTES + 1)  # a hole, which takes no room
    with pytest.raises(SourceError, match=r"depth\.txt: 536870913 bytes, want 536870912 at most"):
        open_source(log)


@pytest.mark.parametrize("kind", ["tum", "mcap"])
def test_nothing_but_images_is_copied_into_a_converted_log(tiny_tum_log, tmp_path, kind):
    log, elsewhere = tiny_tum_log(3), tmp_path / "elsewhere"
    shutil.move(log / "rgb", elsewhere)
    (log / "rgb").symlink_to(elsewhere)
    secret = renamed(log, "rgb/secret.png", 2).with_name("secret.png")
    secret.write_text("root:x:0:0:root")
    out = tmp_path / ("out.mcap" if kind == "mcap" else "out")
    skipped = write_log(open_source(log), out, kind=kind)
    (skip,) = skipped
    assert skip.reason.startswith(f"{secret}: not an image of a known format (15 bytes)")
    written = [out] if kind == "mcap" else [path for path in out.rglob("*") if path.is_file()]
    assert not any(b"root:x" in path.read_bytes() for path in written)


def test_files_of_sensors_that_are_not_read_are_named(tiny_tum_log):
    log = tiny_tum_log(3)
    before = open_source(log).notes
    for name in ("imu_raw.csv", "gps_fix.json", "gt_vicon.log", "notes.txt", "gtk.txt"):
        (log / name).write_text("1 2 3\n")
    (log / "wheels.txt").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    (named,) = [
        note for note in open_source(log).notes if note not in before and "wheel odometry" not in note
    ]
    assert "imu_raw.csv" in named
    assert "gps_fix.json" in named
    assert "gt_vicon.log" not in named  # the truth is read from groundtruth.txt
    assert "notes.txt" not in named
    assert " wheels.txt, " not in named
