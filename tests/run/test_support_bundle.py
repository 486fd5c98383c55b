"""Support bundle: records of the machine, a run and its log, and nothing that was measured."""

import json
from zipfile import ZipFile

import pytest

from mapper.core.errors import RunError
from mapper.run.support_bundle import write_bundle
from mapper.runtime.doctor import Finding

FINDINGS = [Finding("machine", "well", "2 processors"), Finding("disk", "failed", "full", "delete something")]


def texts(path):
    with ZipFile(path) as bundle:
        return {name: bundle.read(name).decode() for name in bundle.namelist()}


def test_a_bundle_of_a_run_has_its_records_alone(desk_run, tmp_path):
    names = write_bundle(tmp_path / "b.zip", FINDINGS, desk_run.path)
    found = texts(tmp_path / "b.zip")
    assert [*found] == names
    assert found.keys() == {
        "doctor.json",
        "manifest.json",
        "config.json",
        "frames.csv",
        "frame_ms.csv",
        "loops.jsonl",
        "inspect.json",
    }
    assert json.loads(found["doctor.json"])[1]["remedy"] == "delete something"
    assert json.loads(found["inspect.json"])["log"]["kind"] == "tum"
    assert found["manifest.json"] == (desk_run.path / "manifest.json").read_text()


def test_a_build_that_failed_and_lost_its_log_is_bundled_all_the_same(tmp_path):
    partial = tmp_path / "run.partial"
    partial.mkdir()
    (partial / "manifest.json").write_text('{"input": {"path": "/nowhere"}}')
    (partial / "config.json").write_text("{")
    write_bundle(tmp_path / "b.zip", FINDINGS, partial)
    found = texts(tmp_path / "b.zip")
    assert found.keys() == {"doctor.json", "manifest.json", "config.json", "inspect.json"}
    assert [*json.loads(found["inspect.json"])] == ["error"]


def test_without_a_run_the_machine_is_bundled(tmp_path):
    assert write_bundle(tmp_path / "b.zip", FINDINGS, None) == ["doctor.json"]
    with pytest.raises(RunError, match=str(tmp_path)):
        write_bundle(tmp_path / "c.zip", FINDINGS, tmp_path)
