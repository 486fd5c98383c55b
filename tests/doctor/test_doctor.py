import json
import sys
import tomllib
from itertools import chain

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.doctor import libraries, machine
from mapper.doctor.finding import Finding
from mapper.doctor.libraries import Requirement, check_library, tried, usual_timeout_s
from mapper.doctor.self_tests import SELF_TESTS, WrongAnswerError, expect_near
from mapper.doctor.system_libraries import apt_line, check_system_libraries
from tests.support.command_line import invoke
from tests.support.paths import ROOT

PYPROJECT = ROOT / "pyproject.toml"
AGAIN = "install it again"


def ended(code, **options):
    return tried("lib", "1.2", [sys.executable, "-c", code], again=AGAIN, **options)


def test_every_library_that_we_need_has_a_self_test():
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    extras = project["optional-dependencies"]
    lines = chain(project["dependencies"], *(extras[name] for name in extras if name not in {"all", "dev"}))
    assert {libraries.REQUIREMENT.match(line)["name"] for line in lines} == set(SELF_TESTS)


def test_requirements_know_what_is_optional(monkeypatch):
    lines = [
        "numpy>=2.0",
        "laspy[lazrs]>=2.7",
        'rerun-sdk>=0.41; extra == "viewer"',
        'kiss-matcher>=1.0; (python_version < "3.13") and extra == "peers"',
        'octree-mapper[viewer]; extra == "all"',
        'evo>=1.31; extra == "dev"',
    ]
    monkeypatch.setattr(libraries.metadata, "requires", lambda _name: lines)
    assert libraries.requirements() == {
        "numpy": Requirement("2.0"),
        "laspy": Requirement("2.7"),
        "rerun-sdk": Requirement("0.41", "viewer"),
        "kiss-matcher": Requirement("1.0", "peers"),
    }


def test_an_optional_library_that_is_absent_is_well_and_told():
    finding = check_library("no-such-library", Requirement("1.5", "viewer"))
    assert finding.verdict == "well"
    assert finding.detail == "optional, not installed: pip install 'octree-mapper[viewer]'"


def test_a_library_that_works_is_well():
    finding = check_library("gtsam", Requirement("4.3"))
    assert (finding.verdict, finding.remedy) == ("well", "")
    assert finding.detail.startswith("4.")


@pytest.mark.parametrize(
    ("code", "detail", "remedy"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "self-test ended by SIGSEGV", AGAIN),
        ("import os, signal; os.kill(os.getpid(), signal.SIGILL)", "ended by SIGILL", "build the library"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "ended by SIGKILL", "was there memory"),
        ("raise ValueError('got [0, 0, 0]')", "1.2, ValueError: got [0, 0, 0]", AGAIN),
        (
            "raise ImportError('libGL.so.1: cannot open shared object file: No such file or directory')",
            "ImportError: libGL.so.1: cannot open",
            "sudo apt-get install libgl1",
        ),
        ("raise SystemExit(3)", "1.2, exit status 3", AGAIN),
    ],
)
def test_a_failure_is_reported_and_not_suffered(code, detail, remedy):
    finding = ended(code)
    assert finding.verdict == "failed"
    assert detail in finding.detail
    assert remedy in finding.remedy


def test_a_library_that_hangs_is_given_up():
    assert "still busy after 1 s" in ended("import time; time.sleep(60)", timeout_s=1.0).detail


def test_the_timeout_grows_with_the_processes_that_wait(monkeypatch):
    monkeypatch.setattr("mapper.doctor.libraries.processors", lambda: 2)
    for load, timeout_s in ((0.1, 60.0), (2.0, 60.0), (24.0, 720.0)):
        monkeypatch.setattr("os.getloadavg", lambda load=load: (load, load, load))
        assert usual_timeout_s() == timeout_s
    monkeypatch.delattr("os.getloadavg")
    assert usual_timeout_s() == 60.0


def test_a_library_that_is_missing_or_old_is_told_with_the_line_that_mends_it():
    missing = check_library("no-such-library", Requirement("1.5"))
    assert (missing.detail, missing.remedy) == ("not installed", "pip install 'no-such-library>=1.5'")

    old = check_library("numpy", Requirement("99.1"))
    assert old.detail.endswith(", want at least 99.1")
    assert old.remedy == "pip install 'numpy>=99.1'"


def test_missing_system_libraries_come_with_the_apt_line():
    finding = check_system_libraries(["libstdc++.so.6", "libnothing.so.7"])
    assert finding.detail == "missing libnothing.so.7"
    assert finding.remedy == "find the package with: apt-file search libnothing.so.7"
    assert apt_line(["libGL.so.1", "libEGL.so.1"]) == "sudo apt-get install libgl1 libegl1"


def test_a_cache_that_cannot_be_written_fails(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert "0 compiled" in machine.check_kernels().detail
    assert machine.check_kernels().remedy == "mapper doctor --warm compiles them"

    monkeypatch.setattr(machine.os, "access", lambda _path, _mode: False)
    finding = machine.check_kernels()
    assert (finding.verdict, "NUMBA_CACHE_DIR" in finding.remedy) == ("failed", True)


def test_modules_that_each_start_compiles_are_a_warning(monkeypatch):
    monkeypatch.setattr(machine, "has_bytecode", lambda _module: True)
    assert machine.check_bytecode().verdict == "well"

    monkeypatch.setattr(machine, "has_bytecode", lambda module: module.__name__ != "numpy.linalg")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    finding = machine.check_bytecode()
    assert (finding.verdict, finding.detail[:5]) == ("warning", "1 of ")
    assert finding.detail.endswith("PYTHONDONTWRITEBYTECODE is set")


def test_threads_of_the_libraries_own_are_a_warning(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert machine.check_threads().verdict == "well"
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    assert machine.check_threads().verdict == "warning"


def test_what_is_scarce_is_a_warning(monkeypatch):
    for limit, look in (
        ("_LEAST_MEMORY_GB", machine.check_memory),
        ("_LEAST_DISK_GB", machine.check_disk),
    ):
        monkeypatch.setattr(machine, limit, 1e9)
        assert look().verdict == "warning"


def test_a_finding_that_is_not_well_says_what_to_do():
    with pytest.raises(DataError, match="verdict 'failed' with remedy ''"):
        Finding("x", "failed", "broken")


@pytest.mark.parametrize("as_json", [True, False])
def test_the_verb_fails_when_a_library_does(monkeypatch, as_json):
    monkeypatch.setattr("mapper.doctor.examination.SELF_TESTS", {"zstandard": None, "no-such-library": None})
    result = invoke("doctor", *(["--json"] if as_json else []))

    assert result.exit_code == 1
    assert result.stderr.splitlines()[-1] == "mapper: doctor: 1 of 10 failed: no-such-library"
    if as_json:
        verdicts = {told["name"]: told["verdict"] for told in json.loads(result.stdout)["findings"]}
        assert (verdicts["zstandard"], verdicts["no-such-library"]) == ("well", "failed")
    else:
        assert "do: pip install 'no-such-library>=0'" in result.stdout


@pytest.mark.parametrize("name", SELF_TESTS)
def test_every_self_test_passes_here(name, tmp_path):
    SELF_TESTS[name](tmp_path)


def test_a_wrong_answer_is_an_error():
    with pytest.raises(WrongAnswerError, match=r"got \[0\.1\]"):
        expect_near(np.array([0.1]), np.array([0.5]))
