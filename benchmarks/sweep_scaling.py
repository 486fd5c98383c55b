"""How much faster a sweep is on two processes, or on a Dask cluster of two workers, than one build at a time.

    python benchmarks/sweep_scaling.py [--rounds 3] [--seconds 4] [--killed]

Three methods × three configurations × two synthetic RGB-D logs, so 18 builds, each on one core. "seconds"
are those of the whole command, start of the workers included (a cluster is there before); the ratio is of
the best rounds. "CPU" is what the command and its workers took of the processors: more of it on two processes
than on one is what sharing memory, caches and clock costs. On a machine that does other things the seconds
say little and the CPU still says something.

``--killed`` kills a worker of a sweep on two processes after 3 cells and the sweep itself after 8 (both by
SIGKILL), begins it again, and tells which cells there are then and which were left as they were.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

from mapper.simulation import write_tum_log
from mapper.simulation.config import SynthConfig

SWEEP = """
logs = ["logs/*"]
method = [
  {name = "local-map"},
  {name = "ISVD", set = {odometry.kind = "isvd"}},
  {name = "PnP", set = {odometry.kind = "pnp"}},
]
configuration = [
  {name = "5 cm"},
  {name = "10 cm", set = {octree.resolution_m = 0.1}},
  {name = "without loops", set = {loops.kind = "none"}},
]
"""
COMMAND = [sys.executable, "-c", "from mapper.cli.main import main; main()", "sweep"]
CELLS = 18
CALM = {  # as it comes, each of a cluster's processes takes 2 to 3 % of a core to watch itself
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "500ms",
}


def main() -> None:
    """Run every kind of workers in turn, as often as asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--killed", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for seed, path in enumerate(("desk", "spin")):
            scene = SynthConfig(
                path=path,
                seed=seed,
                duration_s=given.seconds,
                width_px=320,
                height_px=240,
                frame_rate_hz=15.0,
            )
            write_tum_log(place / "logs" / path, scene)
        (place / "sweep.toml").write_text(SWEEP)
        if given.killed:
            kill_and_resume(place)
        else:
            compare(place, given.rounds)


def compare(place: Path, rounds: int) -> None:
    """Print the seconds and the CPU seconds of each kind of workers."""
    best: dict[str, float] = {}
    print(f"{'workers':<14}{'round':>6}{'seconds':>9}{'CPU':>9}{'ratio':>8}")
    for number in range(1, rounds + 1):
        for workers in ("1 process", "2 processes", "Dask, 2"):
            out = place / f"{workers}-{number}".replace(" ", "")
            if workers.startswith("Dask"):
                before = getrusage(RUSAGE_CHILDREN)
                with cluster(place) as address:
                    seconds = timed(place, out, "--scheduler", address)
            else:
                before = getrusage(RUSAGE_CHILDREN)
                seconds = timed(place, out, "--processes", workers[0])
            after = getrusage(RUSAGE_CHILDREN)
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            best[workers] = min(best.get(workers, seconds), seconds)
            ratio = best["1 process"] / best[workers]
            print(f"{workers:<14}{number:>6}{seconds:>9.1f}{cpu:>9.1f}{ratio:>8.2f}", flush=True)


def timed(place: Path, out: Path, *workers: str) -> float:
    """Return the seconds of one sweep, all of whose cells must finish."""
    began = time.monotonic()
    command = [*COMMAND, str(place / "sweep.toml"), "--out", str(out), *workers, "--quiet"]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    seconds = time.monotonic() - began
    failures = [cell for cell in map(read, finished(out)) if cell["failure"]]
    assert len(finished(out)) == CELLS, out
    assert not failures, failures
    return seconds


@contextmanager
def cluster(place: Path) -> Iterator[str]:
    """Yield the address of a Dask scheduler with two workers of one thread each."""
    contact = place / "scheduler.json"
    contact.unlink(missing_ok=True)
    common = ["--scheduler-file", str(contact), "--no-dashboard", "--host", "127.0.0.1"]
    workers = ["--nworkers", "2", "--nthreads", "1", "--local-directory", str(place)]
    roles = {"scheduler": ["--port", "0"], "worker": workers}
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{role}", *options, *common],
            env=os.environ | CALM,
            stderr=subprocess.DEVNULL,
        )
        for role, options in roles.items()
    ]
    try:
        while not (contact.exists() and contact.stat().st_size):
            time.sleep(0.1)
        address = json.loads(contact.read_text())["address"]
        from distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2)
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


def kill_and_resume(place: Path) -> None:
    """Kill a worker, then the sweep; begin it again; print what became of the cells."""
    out = place / "killed"
    command = [*COMMAND, str(place / "sweep.toml"), "--out", str(out), "--processes", "2"]
    sweep = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    wait_for(out, 3)
    worker = next(pid for pid in children_of(sweep.pid) if "spawn_main" in command_of(pid))
    os.kill(worker, signal.SIGKILL)
    print(f"after {len(finished(out))} cells: killed worker {worker}")
    wait_for(out, 8)
    sweep.kill()
    sweep.wait()
    time.sleep(1.0)
    kept = {path.name: path.stat().st_mtime_ns for path in finished(out)}
    print(f"after {len(kept)} cells: killed the sweep {sweep.pid}")
    again = subprocess.run(command, check=True, capture_output=True, text=True)
    print(again.stderr.splitlines()[0])
    cells = [read(path) for path in finished(out)]
    same = sum(path.stat().st_mtime_ns == kept[path.name] for path in finished(out) if path.name in kept)
    print(f"{len(cells)} of {CELLS} cells, {sum(bool(cell['failure']) for cell in cells)} failed")
    print(f"{same} of the {len(kept)} that were finished before are untouched")


def finished(out: Path) -> list[Path]:
    """Return the cells' files."""
    return sorted(path for path in (out / "cells").glob("*.json") if not path.name.startswith("."))


def read(path: Path) -> dict[str, str]:
    """Return a cell."""
    cell: dict[str, str] = json.loads(path.read_text())
    return cell


def wait_for(out: Path, cells: int) -> None:
    """Wait until so many cells are finished."""
    while len(finished(out)) < cells:
        time.sleep(0.05)


def children_of(pid: int) -> list[int]:
    """Return a process's children."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def command_of(pid: int) -> str:
    """Return how a process was called."""
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")


if __name__ == "__main__":
    main()
