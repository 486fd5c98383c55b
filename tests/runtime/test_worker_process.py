import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from mapper.core.errors import DataError
from mapper.runtime.worker_process import call_isolated

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
