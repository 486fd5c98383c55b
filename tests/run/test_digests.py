import hashlib
import json
import os
import shutil
import threading
from dataclasses import replace

import pytest

from mapper.core.errors import RunError
from mapper.export.exporters import EXPORTERS, export
from mapper.pipeline.fuse import fuse
from mapper.run import digests, files
from mapper.run.digests import changing
from mapper.run.file_checks import check_run
from mapper.run.folder import open_run
from mapper.run.manifest import read_manifest
from tests.support.command_line import mapper
from tests.support.files import files_of

READERS = {
    "trajectory.tum": lambda run: run.trajectory,
    "keyframes.tum": lambda run: run.keyframes,
    "poses.csv": lambda run: run.poses,
    "truth.tum": lambda run: run.truth,
    "graph.g2o": lambda run: run.graph,
    "loops.jsonl": lambda run: run.loops,
    "frames.csv": lambda run: run.records,
    "frame_ms.csv": lambda run: run.frame_ms,
    "config.json": lambda run: open_run(run.path),
}


@pytest.fixture
def run(desk_run, tmp_path):
    return open_run(shutil.copytree(desk_run.path, tmp_path / "run"))


def cut(path):
    """Leave half of a file; of an empty one, as the desk's loops are, another."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2] or b"{")


def turn_a_bit(path):
    data = bytearray(path.read_bytes())
    data[-2] ^= 1  # the last digit of a text
    path.write_bytes(data)


def verdicts_of(path):
    return {finding.name: finding.verdict for finding in check_run(path)}


def test_the_manifest_tells_size_and_digest_of_every_file(run):
    written = files_of(run.path)
    del written["manifest.json"]
    assert run.manifest.files.keys() == written.keys()
    for name, data in written.items():
        assert run.manifest.files[name].size_bytes == len(data)
        assert run.manifest.files[name].sha256 == hashlib.sha256(data).hexdigest()
    assert set(verdicts_of(run.path).values()) == {"well"}


@pytest.mark.parametrize("name", READERS)
def test_a_file_that_was_cut_is_not_read(run, name):
    READERS[name](run)
    cut(run.path / name)
    with pytest.raises(RunError, match=rf"{name}: has \d+ bytes, was written with \d+; "):
        READERS[name](replace(run))  # without what was read before


@pytest.mark.parametrize("digests_known", [True, False])
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_no_file_of_a_run(run, name, digests_known):
    if not digests_known:
        manifest = json.loads((run.path / "manifest.json").read_text())
        (run.path / "manifest.json").write_text(json.dumps(manifest | {"files": {}}))
        run = open_run(run.path)
    path = run.path / name
    path.unlink()
    os.mkfifo(path)
    writer = threading.Thread(target=lambda: path.open("wb").close())  # who opens it does not wait for ever
    writer.start()
    try:
        with pytest.raises(RunError, match=rf"{name}: (is )?no regular file"):
            READERS[name](run)
    finally:
        reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        writer.join()
        os.close(reader)


@pytest.mark.parametrize("name", ["trajectory.tum", "poses.csv", "frames.csv"])
def test_a_bit_that_was_turned_is_found(run, name):
    turn_a_bit(run.path / name)
    with pytest.raises(RunError, match=rf"{name}: has SHA-256 .*; only mapper build makes it again"):
        _ = run.results


def test_a_file_that_is_gone_is_no_file_that_never_was(run):
    (run.path / "truth.tum").unlink()
    with pytest.raises(RunError, match=r"truth.tum: is missing, was written with \d+ bytes"):
        READERS["truth.tum"](run)


@pytest.mark.parametrize("kind", EXPORTERS)
def test_no_export_takes_a_damaged_file(run, tmp_path, kind):
    """Each file of the run is cut, so whichever an export reads is."""
    for path in run.path.iterdir():
        if path.name not in ("manifest.json", "config.json"):
            cut(path)
    if kind == "foxglove-layout":  # reads nothing
        return
    exporter = EXPORTERS[kind]
    with pytest.raises(RunError, match="was written with"):
        export(run, kind, tmp_path / f"out{''.join(exporter.endings[:1])}")
    if exporter.file_name:
        with pytest.raises(RunError, match="was written with"):
            export(run, kind)


@pytest.mark.parametrize("name", ["graph.g2o", "truth.tum", "loops.jsonl", "scan_updates.bin"])
def test_fusing_does_not_take_over_damage(run, name):
    cut(run.path / name)
    before = files_of(run.path)
    with pytest.raises(RunError, match=rf"{name}: has \d+ bytes"):
        fuse(run.open_log(), run, run.config)
    assert files_of(run.path) == before


def test_a_large_file_is_hashed_by_the_doctor_only(run, monkeypatch):
    monkeypatch.setattr(digests, "MOST_HASHED_BYTES", 10)
    turn_a_bit(run.path / "trajectory.tum")
    assert len(run.trajectory)
    assert verdicts_of(run.path)["trajectory.tum"] == "failed"


def test_the_doctor_names_all_that_is_wrong_and_what_helps(run):
    cut(run.path / "loops.jsonl")
    turn_a_bit(run.path / "map.octree")
    (run.path / "slice.png").unlink()
    (run.path / "scan_updates.bin").unlink()
    (run.path / ".mesh.0123.part.ply").touch()
    (run.path / "notes.txt").write_text("a user's own")
    findings = {finding.name: finding for finding in check_run(run.path) if finding.verdict != "well"}

    assert findings.keys() == {
        *("loops.jsonl", "map.octree", "slice.png", "scan_updates.bin", ".mesh.0123.part.ply")
    }
    assert findings["scan_updates.bin"].verdict == "warning", "a run is whole without it"
    assert findings["slice.png"].verdict == findings["loops.jsonl"].verdict == "failed"
    assert findings["map.octree"].remedy == f"make it again with mapper fuse {run.path}"


def test_a_map_that_was_edited_is_kept_once_accepted(run):
    path = run.path / "slice.pgm"
    original = path.read_bytes()
    path.write_bytes(original[:-40] + bytes(40))
    with pytest.raises(RunError, match=r"mapper fuse .*; .* mapper doctor .* --accept slice.pgm"):
        export(run, "costmap")
    assert "no map that can be edited" in mapper("doctor", run.path, "--accept", "map.bt", status=1).output
    path.write_bytes(b"P5 no image")
    refused = mapper("doctor", run.path, "--accept", "slice.pgm", status=1)
    assert "not a grey 8-bit image" in refused.output
    path.write_bytes(original[:-40] + bytes(40))
    mapper("doctor", run.path, "--accept", "slice.pgm")
    export(open_run(run.path), "costmap")
    cut(run.path / "map.octree")
    assert verdicts_of(run.path)["map.octree"] == "failed", "no other file is accepted"


def test_exports_into_the_run_are_recorded(run):
    export(run, "costmap")
    assert verdicts_of(run.path)["costmap.pgm"] == "well"
    cut(run.path / "costmap.pgm")
    assert verdicts_of(run.path)["costmap.pgm"] == "failed"
    export(run, "costmap")
    assert verdicts_of(run.path)["costmap.pgm"] == "well"

    cut(run.path / "trajectory.tum")
    with pytest.raises(RunError):
        export(run, "tum")
    assert verdicts_of(run.path)["trajectory.tum"] == "failed", "an export records what it writes alone"


def test_a_run_may_be_named_by_a_link(run):
    link = run.path.with_name("link")
    link.symlink_to(run.path, target_is_directory=True)
    export(open_run(link), "costmap")
    assert verdicts_of(link)["costmap.pgm"] == "well"


def test_a_process_that_is_killed_leaves_no_digest_of_what_it_was_changing(run):
    def kill():
        with changing(run.path, {files.MCAP}):
            assert files.MCAP not in read_manifest(run.path / "manifest.json").files
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kill()
    assert read_manifest(run.path / "manifest.json").files == run.manifest.files
