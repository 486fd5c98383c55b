import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.writers import write_log


@pytest.fixture
def mbag(tiny_tum_log, tmp_path):
    out = tmp_path / "desk"
    write_log(open_source(tiny_tum_log(3)), out, kind="mbag")
    return out / "desk.mbag"


def replace_line(path, index, change):
    lines = path.read_text().splitlines()
    lines[index] = change(lines[index])
    path.write_text("\n".join(lines) + "\n")


def test_the_file_is_as_the_thesis_describes_it(mbag):
    lines = mbag.read_text().splitlines()
    assert lines[:2] == ["!RAWLOG FB1", "!dbName: log"]
    fields = lines[2].split("; ")
    assert fields[:3] == ["1305031102.175304", "rgb/1305031102.175304.png", "depth/1305031102.165305.png"]
    assert [float(f) for f in fields[3:]] == pytest.approx([0, 0, 1.5, 0, 0, 0.6, 0.8], abs=1e-15)


def test_opens_by_file_and_by_folder(mbag):
    for path in (mbag, mbag.parent):
        source = open_source(path)
        assert (source.kind, source.name, len(source), source.notes) == ("mbag", "log", 3, [])


def test_windows_paths_and_missing_truth_in_every_spelling(mbag):
    replace_line(mbag, 2, lambda line: line.replace("rgb/", "rgb\\"))
    replace_line(mbag, 3, lambda line: "; ".join(line.split("; ")[:3]))
    replace_line(mbag, 4, lambda line: "; ".join(line.split("; ")[:3]) + "; " * 7)
    source = open_source(mbag)
    assert (len(source), len(source.truth), source.notes) == (3, 1, [])


def test_a_pose_that_is_partly_missing_is_dropped_and_noted(mbag):
    replace_line(mbag, 3, lambda line: line.rsplit(";", 1)[0] + "; nan")
    source = open_source(mbag)
    assert len(source.truth) == 2
    assert source.notes == ["desk.mbag: 1 of 3 poses are not finite rigid motions; dropped"]


def test_missing_images_and_wrong_order_are_noted(mbag):
    (mbag.parent / "depth/1305031102.165305.png").unlink()
    lines = mbag.read_text().splitlines()
    mbag.write_text("\n".join([*lines[:3], lines[4], lines[3]]))
    source = open_source(mbag)
    stamps = [entry.stamp_ns for entry in source.entries()]
    assert len(stamps) == 2
    assert stamps == sorted(stamps)
    assert "desk.mbag: 1 of 3 listed pairs do not exist; dropped" in source.notes
    assert "desk.mbag: out of time order in 1 places; sorted" in source.notes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"does not start with '!RAWLOG FB1'"),
        ("1.0; a.png; b.png\n", r"does not start with '!RAWLOG FB1'"),
        ("!RAWLOG FB1\n!dbName: x\n", r"empty list"),
        ("!RAWLOG FB1\n1.0; a.png; b.png; 1; 2\n", r"2: 5 fields, want 10"),
        ("!RAWLOG FB1\nx; a.png; b.png\n", r"2: stamp 'x' is not a decimal number"),
        ("!RAWLOG FB1\n1.0; a.png; b.png; 1; 2; x; 0; 0; 0; 1\n", r"2: could not convert string"),
        ("!RAWLOG FB1\n1.0; a.png; b.png\n", r"none of its 1 pairs of images exists"),
    ],
)
def test_a_malformed_file_is_named_with_its_line(tmp_path, text, message):
    path = tmp_path / "bad.mbag"
    path.write_text(text)
    with pytest.raises(SourceError, match=rf"bad\.mbag.*{message}"):
        open_source(path)


def test_two_files_in_a_folder_are_not_guessed_between(mbag):
    (mbag.parent / "other.mbag").write_text(mbag.read_text())
    with pytest.raises(SourceError, match=r"known format .*\.mbag"):
        open_source(mbag.parent)
    assert len(np.unique([entry.stamp_ns for entry in open_source(mbag).entries()])) == 3
