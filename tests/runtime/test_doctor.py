import json
import tomllib
from itertools import chain

import pytest

from mapper.core.errors import DataError
from mapper.runtime import doctor
from mapper.runtime.doctor import Finding, Requirement, check_library, requirements
from tests.support.command_line import invoke
from tests.support.paths import ROOT


def test_every_library_that_we_name_is_examined():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = chain(project["dependencies"], *(extras[name] for name in extras if name not in {"all", "dev"}))
    names = {line.split(">=")[0].split("[")[0] for line in lines}
    assert {wanted.name for wanted in requirements()} == names


def test_requirements_know_what_is_optional(monkeypatch):
    lines = [
        "laspy[lazrs]>=2.7",
        'kiss-matcher>=1.0; (python_version < "3.13") and extra == "peers"',
        'octree-mapper[viewer]; extra == "all"',
        'evo>=1.31; extra == "dev"',
    ]
    monkeypatch.setattr(doctor.metadata, "requires", lambda _name: lines)
    assert requirements() == [Requirement("laspy", "2.7"), Requirement("kiss-matcher", "1.0", "peers")]


@pytest.mark.parametrize(
    ("wanted", "verdict", "said"),
    [
        (Requirement("gtsam", "4.3"), "well", ""),
        (Requirement("gtsam", "99.0"), "failed", "pip install 'gtsam>=99.0'"),
        (Requirement("no-such-library"), "failed", "pip install 'no-such-library>=0'"),
        (Requirement("no-such-library", extra="viewer"), "well", ""),
    ],
)
def test_libraries_are_there_and_new_enough(wanted, verdict, said):
    finding = check_library(wanted)
    assert (finding.verdict, finding.remedy) == (verdict, said)


@pytest.mark.parametrize(
    ("code", "remedy"),
    [
        ("raise ImportError('libGL.so.1: cannot open shared object file')", "sudo apt-get install libgl1"),
        ("raise ImportError('libno.so.7: cannot open shared object file')", "find the package with"),
        ("import os; os.abort()", "pip install --force-reinstall"),
    ],
)
def test_a_library_that_cannot_be_imported_fails_alone(tmp_path, monkeypatch, code, remedy):
    (tmp_path / "broken.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setitem(doctor.MODULES, "gtsam", "broken")
    finding = check_library(Requirement("gtsam"))
    assert finding.verdict == "failed"
    assert finding.remedy.startswith(remedy)


def test_what_is_scarce_is_a_warning_and_a_cache_that_cannot_be_written_fails(monkeypatch, tmp_path):
    monkeypatch.setattr(doctor, "_LEAST_GB", 1e9)
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert [check().verdict for check in (doctor.check_machine, doctor.check_kernels)] == ["warning"] * 2
    monkeypatch.setattr(doctor, "_LEAST_GB", 0.0)
    assert "OMP_NUM_THREADS" in doctor.check_machine().remedy
    monkeypatch.setattr(doctor.os, "access", lambda _path, _mode: False)
    assert doctor.check_kernels().verdict == "failed"
    with pytest.raises(DataError, match="verdict 'failed' with remedy ''"):
        Finding("x", "failed", "broken")


def test_kernels_are_counted_once_however_often_they_were_compiled(monkeypatch, tmp_path):
    folder = tmp_path / "octree_0"
    folder.mkdir()
    for name in ("kernels._add-12.py311.nbi", "kernels._add-15.py311.nbi", "kernels._add-12.py311.1.nbc"):
        (folder / name).touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert doctor.compiled_kernels() == {folder / "kernels._add"}


def test_the_verb_fails_when_a_library_does(monkeypatch):
    wanted = [Requirement("zstandard"), Requirement("no-such-library")]
    monkeypatch.setattr(doctor, "requirements", lambda: wanted)
    result = invoke("doctor", "--json")
    verdicts = {told["name"]: told["verdict"] for told in json.loads(result.stdout)["findings"]}
    assert result.exit_code == 1
    assert (verdicts["zstandard"], verdicts["no-such-library"]) == ("well", "failed")
    assert "do: pip install 'no-such-library>=0'" in invoke("doctor").stdout
