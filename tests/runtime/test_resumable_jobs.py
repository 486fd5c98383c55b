import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mapper.core.errors import ConfigError, DataError, RunError
from mapper.evaluators.study.engine import run_study
from mapper.runtime.atomic import locked
from mapper.runtime.executor import Workers
from mapper.runtime.resumable_jobs import Job
from tests.support.counted_jobs import Work, told, until
from tests.support.paths import ROOT
from tests.support.progress import Observer


@pytest.fixture
def diary(tmp_path):
    return tmp_path / "diary"


def cell(diary, name, how="records", *, key=None):
    return Job(key or f"cell-{name}", f"the cell {name}", Work(diary, str(name), how))


def run_cells(cells, folder, **options):
    return list(run_study(dict(enumerate(cells)), folder, **options).values())


def test_results_come_in_order_and_are_not_worked_out_again(diary, tmp_path):
    cells = [cell(diary, n) for n in (3, 1, 2)]
    first, second = (run_cells(cells, tmp_path / "cells", workers=Workers(p)) for p in (2, 1))

    assert first == second
    assert [result.key for result in first] == ["cell-3", "cell-1", "cell-2"]
    assert first[1].records == ({"name": "1", "third": 1 / 3, "nothing": None},)
    assert first[1].seconds > 0.0
    assert told(diary) == {"1": 1, "2": 1, "3": 1}


def test_finished_cells_need_no_workers(diary, tmp_path):
    (first,) = run_cells([cell(diary, 1)], tmp_path / "cells")
    cluster = {"workers": Workers(scheduler="nonsense")}
    (again,) = run_cells([cell(diary, 1)], tmp_path / "cells", **cluster)
    assert again == first
    assert run_cells([], tmp_path / "cells", **cluster) == []
    with pytest.raises(ConfigError, match="nonsense"):
        run_cells([cell(diary, 2)], tmp_path / "cells", **cluster)


def test_more_cells_leave_the_finished_ones_alone(diary, tmp_path):
    run_cells([cell(diary, 1), cell(diary, 2)], tmp_path / "cells")
    observer = Observer()
    run_cells([cell(diary, n) for n in (1, 2, 3, 4)], tmp_path / "cells", progress=observer)

    assert told(diary) == {"1": 1, "2": 1, "3": 1, "4": 1}
    assert observer.notes == ["2 of 4 cells were finished before and are kept"]
    assert observer.counts == [(0, 2), (1, 2), (2, 2)]


def test_a_failed_cell_is_told_written_and_tried_again(diary, tmp_path):
    observer = Observer()
    cells = [cell(diary, 1, "refuse"), cell(diary, 2), cell(diary, 3, "nan")]
    failed, fine, nan = run_cells(cells, tmp_path / "cells", progress=observer, attempts=1)

    assert (failed.failure, failed.records) == ("1.png: is black", ())
    assert fine.failure == ""
    assert nan.failure == "ratio is nan; want text, a finite number or None"
    assert observer.notes[0] == "the cell 1: 1.png: is black"
    assert json.loads((tmp_path / "cells/cell-1.json").read_text())["failure"] == "1.png: is black"

    (again,) = run_cells([cell(diary, 1)], tmp_path / "cells")
    assert again.failure == ""
    assert told(diary)["1"] == 2


@pytest.mark.parametrize("text", ["", '{"format": ', "[1]", '{"format": "of others"}', None])
def test_a_file_that_is_no_cell_is_worked_out_again(diary, tmp_path, text):
    (result,) = run_cells([cell(diary, 1)], tmp_path / "cells")
    file = tmp_path / "cells/cell-1.json"
    good = file.read_text()
    file.write_text(good.replace("cell-1", "cell-2") if text is None else text)

    observer = Observer()
    (again,) = run_cells([cell(diary, 1)], tmp_path / "cells", progress=observer)
    assert again.records == result.records
    assert told(diary)["1"] == 2
    assert observer.notes == [f"{file}: not a finished result, or a damaged one; it is computed again"]
    assert json.loads(file.read_text())["records"] == json.loads(good)["records"]


def test_one_key_is_one_piece_of_work(diary, tmp_path):
    twins = [cell(diary, 1), Job("cell-1", "its twin", Work(diary, "1", "records"))]
    one, other = run_cells(twins, tmp_path / "cells")
    assert (one.label, other.label) == ("the cell 1", "its twin")
    assert one.records == other.records
    assert told(diary) == {"1": 1}


def test_two_sweeps_do_not_share_a_folder(diary, tmp_path):
    (tmp_path / "cells").mkdir()
    with locked(tmp_path / "cells"), pytest.raises(RunError, match="another process is filling it"):
        run_cells([cell(diary, 1)], tmp_path / "cells")
    assert not told(diary)


@pytest.mark.parametrize("key", ["", "../up", ".hidden", "a b", "a" * 201])
def test_a_key_is_a_file_s_name(key):
    with pytest.raises(DataError, match="its key is a file's name"):
        Job(key, "a cell", Path.cwd)


def test_killed_in_the_middle_it_goes_on_and_runs_nothing_finished_twice(diary, tmp_path):
    script = tmp_path / "sweep.py"
    script.write_text(
        "from pathlib import Path\n"
        "from mapper.evaluators.study.engine import run_study\n"
        "from mapper.runtime.resumable_jobs import Job\n"
        "from mapper.runtime.executor import Workers\n"
        "from tests.support.counted_jobs import Work\n"
        "if __name__ == '__main__':\n"
        f"    diary, folder = Path({str(diary)!r}), Path({str(tmp_path / 'cells')!r})\n"
        "    jobs = {n: Job(f'cell-{n}', str(n), Work(diary, str(n), 'nap_records')) for n in range(8)}\n"
        "    results = run_study(jobs, folder, workers=Workers(2)).values()\n"
        "    print([len(result.records) for result in results])\n"
    )
    command = {"args": [sys.executable, str(script)], "env": {"PYTHONPATH": str(ROOT)}}
    first = subprocess.Popen(**command)
    until(lambda: len(list((tmp_path / "cells").glob("cell-*.json"))) >= 3)
    first.send_signal(signal.SIGKILL)
    first.wait()
    finished = {file.stem.removeprefix("cell-") for file in (tmp_path / "cells").glob("cell-*.json")}
    second = subprocess.run(**command, capture_output=True, text=True, check=True)

    assert second.stdout == f"{[1] * 8}\n"
    begun = told(diary)
    assert begun.keys() == {str(n) for n in range(8)}
    assert 3 <= len(finished) < 8
    assert all(begun[name] == 1 for name in finished)
    assert begun.total() <= 8 + 2  # what two workers were at when they died
