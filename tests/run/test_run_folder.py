import fcntl
import os

import numpy as np
import pytest

from mapper.config.build import BuildConfig
from mapper.core.doubts import Doubt
from mapper.core.errors import DataError, FrameError, RunError, TrackingError
from mapper.export.mesh_files import write_ply
from mapper.loops.closure import read_closures
from mapper.odometry.base import Diagnostics
from mapper.run.cloud import read_cloud
from mapper.run.files import RUN
from mapper.run.folder import open_run
from mapper.run.frame_records import FrameRecord, read_frame_ms, read_records, write_frame_ms, write_records
from mapper.run.input_logs import fingerprint
from mapper.run.manifest import Manifest, is_merged_map, read_manifest
from mapper.run.manifest_logs import Input
from mapper.run.pose_covariances import read_poses
from mapper.run.writer import write_run
from mapper.runtime.atomic import atomic_folder, partial_of

MANIFEST = Manifest(status="building", input=Input(path="/log", kind="tum", fingerprint="sha256:0"))

DOUBTS = (Doubt("jump", "jump of 0.3 m"), Doubt("disagreement", "another pose fits as well"))


def draft_of(out, *, overwrite=False):
    return write_run(out, MANIFEST, BuildConfig(workers=1), overwrite=overwrite)


def make_run(out, text, *, overwrite=False, error=None):
    with draft_of(out, overwrite=overwrite) as writer:
        (writer.folder / "trajectory.tum").write_text(text)
        if error is not None:
            raise error


def test_a_run_appears_only_when_it_is_whole(tmp_path):
    out = tmp_path / "runs" / "lab"

    with draft_of(out) as writer:
        assert not out.exists()
        assert read_manifest(writer.folder / "manifest.json").status == "building"

    run = open_run(out)
    assert run.manifest.status == "complete"
    assert run.config == BuildConfig(workers=1)
    assert not partial_of(out).exists()


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (TrackingError("only 3 frames"), "failed", "only 3 frames"),
        (KeyboardInterrupt(), "interrupted", "KeyboardInterrupt"),
        (ZeroDivisionError("x"), "failed", "ZeroDivisionError: x"),
    ],
)
def test_a_run_that_ends_early_says_how(tmp_path, error, status, reason):
    out = tmp_path / "lab"

    with pytest.raises(type(error)):
        make_run(out, "saved", error=error)

    assert not out.exists()
    manifest = read_manifest(partial_of(out) / "manifest.json")
    assert manifest.status == status
    assert reason in manifest.reason
    assert (partial_of(out) / "trajectory.tum").read_text() == "saved"
    with pytest.raises(RunError, match=status):
        open_run(out)


def test_a_killed_process_leaves_a_folder_that_says_so(tmp_path):
    child = os.fork()
    if child == 0:
        with draft_of(tmp_path / "lab"):
            os.kill(os.getpid(), 9)
    os.waitpid(child, 0)

    with pytest.raises(RunError, match="still being built, or its process was killed"):
        open_run(tmp_path / "lab")
    make_run(tmp_path / "lab", "second try")
    assert open_run(tmp_path / "lab").manifest.status == "complete"


def test_an_existing_run_is_refused_before_any_work(tmp_path):
    make_run(tmp_path / "lab", "old")

    with pytest.raises(RunError, match="--overwrite"), draft_of(tmp_path / "lab"):
        pytest.fail("the body must not run")


def test_overwriting_keeps_the_old_run_until_the_new_one_is_whole(tmp_path):
    out = tmp_path / "lab"
    make_run(out, "old")

    with pytest.raises(TrackingError):
        make_run(out, "new", overwrite=True, error=TrackingError("too little"))
    assert (out / "trajectory.tum").read_text() == "old"

    make_run(out, "new", overwrite=True)
    assert (out / "trajectory.tum").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lab"]


@pytest.mark.parametrize("place", ["lab", "lab.partial"])
def test_folders_that_are_not_ours_are_never_replaced(tmp_path, place):
    precious = tmp_path / place / "thesis.tex"
    precious.parent.mkdir()
    precious.write_text("years")

    with pytest.raises(RunError), atomic_folder(tmp_path / "lab", RUN, overwrite=True):
        pytest.fail("the body must not run")
    assert precious.read_text() == "years"


def test_two_builds_of_one_run_do_not_mix(tmp_path):
    with atomic_folder(tmp_path / "lab", RUN) as partial:
        handle = os.open(partial, os.O_RDONLY)
        with pytest.raises(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(RunError, match="another process"), atomic_folder(tmp_path / "lab", RUN):
            pytest.fail("the body must not run")
        os.close(handle)


def test_folders_that_are_no_runs(tmp_path):
    with pytest.raises(RunError, match="no such run folder"):
        open_run(tmp_path / "none")
    with pytest.raises(RunError, match="run folder"):
        open_run(tmp_path)
    (tmp_path / "manifest.json").write_text('{"status": "complete"}')
    with pytest.raises(RunError, match="input: Field required"):
        open_run(tmp_path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"kind": "merged map", "tiles": []}', True),
        ('{"input": {\n  "kind": "merged map"\n}}', False),
        ('{\n  "kind": "merged map",\n  "tiles": [{"na', True),
        ("not JSON", False),
        ("[]", False),
    ],
)
def test_a_merged_map_is_recognised_by_its_manifest(tmp_path, text, expected):
    (tmp_path / "manifest.json").write_text(text)
    assert is_merged_map(tmp_path) == expected


def test_records_survive_the_disk(tmp_path):
    how = Diagnostics(
        features=900, matches=300, inliers=250, residual=0.1 + 0.2, residual_unit="px", method="map"
    )
    nothing = Diagnostics(features=0, matches=0, inliers=0, residual=0.0, residual_unit="", method="")
    records = [
        FrameRecord(10, "tracked", 0, is_keyframe=True, diagnostics=how),
        FrameRecord(20, "skipped", None, is_keyframe=False, diagnostics=nothing),
        FrameRecord(30, "lost", None, is_keyframe=False, diagnostics=how),
        FrameRecord(40, "doubtful", 0, is_keyframe=False, diagnostics=how, doubts=DOUBTS),
    ]

    write_records(tmp_path / "frames.csv", records)
    write_frame_ms(tmp_path / "ms.csv", {10: 1.25, 30: 2.5})

    assert read_records(tmp_path / "frames.csv") == records
    assert read_frame_ms(tmp_path / "ms.csv") == {10: 1.25, 30: 2.5}


@pytest.mark.parametrize(("column", "expected"), [("unobservable", "yaw"), ("unseen", "yaw"), ("other", "")])
def test_records_of_older_runs_are_read(tmp_path, column, expected):
    how = Diagnostics(9, 8, 7, 0.5, "m", "map", unobservable="yaw")
    write_records(tmp_path / "frames.csv", [FrameRecord(10, "tracked", 0, True, how)])
    text = (tmp_path / "frames.csv").read_text()
    (tmp_path / "frames.csv").write_text(text.replace("unobservable", column))

    (record,) = read_records(tmp_path / "frames.csv")

    assert record.diagnostics.unobservable == expected


def test_doubts_of_older_runs_have_no_kinds(tmp_path):
    how = Diagnostics(9, 8, 7, 0.5, "m", "map")
    write_records(tmp_path / "frames.csv", [FrameRecord(10, "doubtful", 0, False, how, DOUBTS)])
    header, row = (tmp_path / "frames.csv").read_text().splitlines()
    assert (header.rpartition(",")[2], row.rpartition(",")[2]) == ("doubt_kinds", "jump; disagreement")
    older = "\n".join(line.rpartition(",")[0] for line in (header, row))
    (tmp_path / "frames.csv").write_text(older + "\n")

    (record,) = read_records(tmp_path / "frames.csv")

    assert [doubt.text for doubt in record.doubts] == [doubt.text for doubt in DOUBTS]
    assert [doubt.kind for doubt in record.doubts] == ["disagreement"] * 2


@pytest.mark.parametrize(
    "damage", [b'"' + 200_000 * b"a" + b'"\n', b"1,\0\n", b"1,tracked\n"], ids=["quote", "zero", "short"]
)
def test_damaged_records_are_named(tmp_path, damage):
    path = tmp_path / "frames.csv"
    write_records(path, [])
    path.write_bytes(path.read_bytes() + damage)
    with pytest.raises(DataError, match=r"frames\.csv: not a list of frames with columns stamp_ns, "):
        read_records(path)
    path.write_bytes(b"stamp_ns,ms\n" + damage)
    with pytest.raises(DataError, match=r"frames\.csv: not a list of times with columns stamp_ns, ms: "):
        read_frame_ms(path)


@pytest.mark.parametrize("read", [read_records, read_frame_ms, read_poses, read_closures])
def test_a_run_s_file_that_is_no_text_or_endless_is_named(tmp_path, read):
    path = tmp_path / "file"
    path.write_bytes(b"stamp_ns\n1\xff\n")
    with pytest.raises(RunError, match="file: not a text file: byte 10 is not UTF-8"):
        read(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(RunError, match="file: no regular file"):
        read(path)


def test_a_fingerprint_follows_names_sizes_and_lists_but_not_the_place(tmp_path):
    def make(name, *, listed="1 a.png\n", image=b"123"):
        folder = tmp_path / name
        (folder / "rgb").mkdir(parents=True)
        (folder / "rgb.txt").write_text(listed)
        (folder / "rgb" / "a.png").write_bytes(image)
        return fingerprint(folder)

    first = make("a")
    assert make("b") == first
    assert make("c", listed="2 a.png\n") != first
    assert make("d", image=b"1234") != first
    assert fingerprint(tmp_path / "a" / "rgb" / "a.png") != fingerprint(tmp_path / "d" / "rgb" / "a.png")


def test_a_cloud_that_is_a_circle_of_links_is_refused_in_one_line(tmp_path):
    (tmp_path / "cloud.ply").symlink_to("cloud.ply")
    with pytest.raises(FrameError, match=r"cloud\.ply: cannot be read: Too many levels of symbolic links"):
        read_cloud(tmp_path / "cloud.ply")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (np.float32(2.5).tobytes(), np.float32(np.nan).tobytes(), r"point 1 is at \[nan +4\. +5\. *\]"),
        (np.float32(2.5).tobytes(), np.float32(3e38).tobytes(), r"point 1 is at \[3\.e\+38 .*\]"),
        (b"float y", b"float w", "no property y of float32"),
        (b"float y", b"int y", "no property y of float32"),
        (b"uchar green", b"char green", "no property green of uint8"),
    ],
)
def test_a_cloud_that_no_run_writes_is_refused(tmp_path, old, new, complaint):
    path = tmp_path / "cloud.ply"
    points = np.array([[0, 1, 2], [2.5, 4, 5]], np.float32)
    write_ply(path, points, np.full((2, 3), 7, np.uint8))
    np.testing.assert_array_equal(read_cloud(path).points, points)
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(FrameError, match=rf"cloud\.ply: {complaint}"):
        read_cloud(path)


def test_what_another_version_wrote_in_addition_is_ignored(tmp_path):
    (tmp_path / "manifest.json").write_text(
        '{"status": "complete", "trial": {}, '
        '"input": {"path": "log", "kind": "tum", "fingerprint": "", "later": 1}}'
    )
    assert read_manifest(tmp_path / "manifest.json").input.kind == "tum"
