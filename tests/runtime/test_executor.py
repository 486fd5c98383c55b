import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from mapper.core.errors import ConfigError, DataError, DependencyError
from mapper.runtime import executor as workers
from mapper.runtime.executor import Failure, Workers, make_executor, run_jobs
from mapper.runtime.worker_process import call_isolated
from tests.support.counted_jobs import Work, alive, told, until
from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def dask_scheduler(tmp_path_factory):
    """The address of a Dask scheduler with two workers, which gives up a job whose worker has died once."""
    folder = tmp_path_factory.mktemp("dask")
    contact = folder / "scheduler.json"
    settings = os.environ | {
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0",
        "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",  # it watches what takes long: our imports
        "PYTHONPATH": str(ROOT),
    }
    roles = {
        "scheduler": ["--port", "0"],
        "worker": ["--nworkers", "2", "--nthreads", "1", "--local-directory", str(folder)],
    }
    common = ["--scheduler-file", str(contact), "--no-dashboard", "--host", "127.0.0.1"]
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{role}", *options, *common],
            env=settings,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for role, options in roles.items()
    ]
    try:
        until(lambda: contact.exists() and contact.stat().st_size, seconds=60.0)
        yield json.loads(contact.read_text())["address"]
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


@pytest.fixture(params=["here", "processes", "dask"])
def anywhere(request):
    if request.param == "dask":
        return Workers(scheduler=request.getfixturevalue("dask_scheduler"))
    return Workers(1 if request.param == "here" else 2)


@pytest.fixture
def diary(tmp_path):
    return tmp_path / "diary"


def outcomes_of(jobs, given, **options):
    with make_executor(given) as executor:
        return dict(run_jobs(jobs, executor, **options))


def test_every_job_is_done_once_wherever(anywhere, diary):
    jobs = [Work(diary, str(n)) for n in range(7)]
    assert outcomes_of(jobs, anywhere) == {n: n * n for n in range(7)}
    assert told(diary) == {str(n): 1 for n in range(7)}


def test_what_raises_is_tried_again_and_the_others_go_on(anywhere, diary):
    jobs = [Work(diary, "1", "raise"), Work(diary, "2"), Work(diary, "3", "refuse")]
    outcomes = outcomes_of(jobs, anywhere, attempts=3)
    assert outcomes[1] == 4
    assert outcomes[2] == Failure("3.png: is black", 3)
    assert outcomes[0].attempts == 3
    assert outcomes[0].reason.startswith("ValueError: no such thing as 1 (counted_jobs.py:")
    assert told(diary) == {"1": 3, "2": 1, "3": 3}


def test_what_ends_its_worker_is_the_only_one_lost(diary):
    jobs = [Work(diary, "1", "exit"), Work(diary, "2", "kill"), Work(diary, "flaky", "exit_once")]
    jobs += [Work(diary, str(n)) for n in (4, 5)]
    outcomes = outcomes_of(jobs, Workers(2))
    assert outcomes == {
        0: Failure("its worker ended with exit status 3", 2),
        1: Failure("its worker was killed by SIGKILL", 2),
        2: 7,
        3: 16,
        4: 25,
    }
    assert told(diary) == {"1": 2, "2": 2, "flaky": 2, "4": 1, "5": 1}


def test_what_ends_a_cluster_s_worker_is_the_only_one_lost(diary, dask_scheduler):
    jobs = [Work(diary, "1", "exit"), Work(diary, "2"), Work(diary, "3")]
    outcomes = outcomes_of(jobs, Workers(scheduler=dask_scheduler), attempts=1)
    assert outcomes == {0: Failure("its worker ended, 1 of 1 times; its log may say why", 1), 1: 4, 2: 9}
    assert told(diary) == {"1": 1, "2": 1, "3": 1}


def test_a_result_that_cannot_travel_is_a_failure(diary):
    outcomes = outcomes_of([Work(diary, "1", "unpicklable"), Work(diary, "2")], Workers(2))
    assert "pickle" in outcomes[0].reason
    assert outcomes[1] == 4


def test_libraries_get_one_thread_each(diary, monkeypatch):
    for name in ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        monkeypatch.delenv(name, raising=False)
    outcomes = outcomes_of([Work(diary, "1", "limits"), Work(diary, "2")], Workers(2))
    assert outcomes[0] == (1, "1")


def test_leaving_early_ends_the_workers(diary):
    jobs = [Work(diary, "1"), Work(diary, "asleep", "wait"), Work(diary, "awake", "wait")]
    with make_executor(Workers(2)) as executor:
        assert next(run_jobs(jobs, executor)) == (0, 1)
        asleep = diary.parent / "asleep.pid"
        until(lambda: asleep.exists() and asleep.read_text())  # the file is there before its text
        pid = int(asleep.read_text())
        assert alive(pid)
    assert not alive(pid)


def test_workers_do_not_outlive_a_parent_that_is_killed(diary, tmp_path):
    script = tmp_path / "sweep.py"
    script.write_text(
        "from pathlib import Path\n"
        "from mapper.runtime.executor import Workers, make_executor, run_jobs\n"
        "from tests.support.counted_jobs import Work\n"
        "if __name__ == '__main__':\n"
        f"    diary = Path({str(diary)!r})\n"
        "    with make_executor(Workers(2)) as executor:\n"
        "        list(run_jobs([Work(diary, name, 'wait') for name in 'ab'], executor))\n"
    )
    parent = subprocess.Popen([sys.executable, str(script)], env={"PYTHONPATH": str(ROOT)})
    files = [tmp_path / "a.pid", tmp_path / "b.pid"]
    until(lambda: all(file.exists() and file.read_text() for file in files))
    pids = [int(file.read_text()) for file in files]
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    until(lambda: not any(map(alive, pids)), seconds=10.0)


@pytest.mark.parametrize(("processes", "attempts"), [(0, 1), (1, 0)])
def test_numbers_of_nothing_are_refused(diary, processes, attempts):
    with pytest.raises(ConfigError, match="want at least 1"):
        outcomes_of([Work(diary, "1")], Workers(processes), attempts=attempts)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("somewhere", "scheduler 'somewhere': not an address; want tcp://HOST:PORT"),
        ("", "scheduler '': not an address"),
        ("tcp://127.0.0.1:9", "tcp://127.0.0.1:9: no Dask scheduler answers there within 0.3 s"),
    ],
)
def test_a_scheduler_that_is_not_there_is_told(monkeypatch, address, message):
    monkeypatch.setattr(workers, "_ANSWER_S", 0.3)
    with pytest.raises(ConfigError) as told_:
        make_executor(Workers(scheduler=address))
    assert str(told_.value).startswith(message)


def test_a_missing_extra_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(DependencyError, match=r"pip install 'octree-mapper\[cluster\]'"):
        make_executor(Workers(scheduler="tcp://127.0.0.1:8786"))


LIMIT = 64 << 20


def test_a_result_and_an_error_come_back():
    assert call_isolated(partial(divmod, 7, 2), memory_bytes=LIMIT) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        call_isolated(partial(divmod, 7, 0), memory_bytes=LIMIT)


def test_the_process_is_kept_until_it_ends():
    first = call_isolated(os.getpid, memory_bytes=LIMIT)
    assert call_isolated(os.getpid, memory_bytes=LIMIT) == first != os.getpid()
    with pytest.raises(DataError, match="the process that reads it was killed by SIGKILL"):
        call_isolated(partial(os.kill, first, signal.SIGKILL), memory_bytes=LIMIT)
    with pytest.raises(DataError, match="the process that reads it ended with exit status 3"):
        call_isolated(partial(os._exit, 3), memory_bytes=LIMIT)
    assert call_isolated(os.getpid, memory_bytes=LIMIT) not in (first, os.getpid())


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="limits memory on Linux only")
def test_each_call_has_its_limit_of_memory():
    with pytest.raises(MemoryError):
        call_isolated(partial(bytes, 2 * LIMIT), memory_bytes=LIMIT)
    assert len(call_isolated(partial(bytes, 2 * LIMIT), memory_bytes=6 * LIMIT)) == 2 * LIMIT


def test_a_script_without_a_guard_runs_once(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os\nfrom mapper.runtime.worker_process import call_isolated\n"
        f"print(call_isolated(os.getpid, memory_bytes={LIMIT}) != os.getpid())\n"
    )
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("True\n", "")
