"""Compilation before the first build: kernels, which numba keeps, and bytecode of what a build imports."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mapper.core.errors import DependencyError
from mapper.doctor.machine import compiled_kernels, processors
from mapper.runtime.bytecode import keep_bytecode
from mapper.runtime.executor import Workers, make_executor, run_jobs
from mapper.runtime.progress import SILENT, Progress, Report
from mapper.runtime.worker_process import Failure

KERNELS = 162
"""About how many kernels are compiled, for the progress bar."""
_POLL_S = 0.5


def compile_kernels(*, progress: Progress = SILENT) -> None:
    """Compile every kernel that builds of RGB-D and LiDAR logs, and reports of their runs, use by default.

    Two processes, where there are two processors, render and build a second of a synthetic log of each
    sensor. Code that is compiled already is kept. What the builds have imported keeps its bytecode, too.

    Raises:
        DependencyError: A build failed, as it does where the compiled code cannot be kept.
    """
    with TemporaryDirectory(prefix="mapper-warm-") as scratch, progress.stage("compile") as report:
        jobs = [partial(build, Path(scratch) / build.__name__) for build in (_build_rgbd, _build_lidar)]
        workers = Workers(processes=min(2, processors()))
        with make_executor(workers, jobs=len(jobs)) as executor, _watched(report):
            for _, outcome in run_jobs(jobs, executor, attempts=1):
                if isinstance(outcome, Failure):
                    raise DependencyError(f"the build that compiles kernels failed: {outcome.reason}")


def _build_rgbd(folder: Path) -> None:
    from mapper.features.hamming import match_mutual_bits, pack
    from mapper.mapping.thumbnails import encode_jpeg
    from mapper.registration.config import IsvdConfig
    from mapper.registration.isvd import Isvd
    from mapper.simulation import write_tum_log
    from mapper.simulation.config import SynthConfig
    from mapper.sources.image_files.jpeg_entropy import check_entropy

    check_entropy(encode_jpeg(np.zeros((8, 8, 3), np.uint8), width_px=8, quality=90))  # the log has PNGs
    bits = pack(np.zeros((2, 32), np.uint8))  # matching and ISVD of loop closures, which a second has none of
    match_mutual_bits(bits, bits, 50, 0.8)
    points = np.random.default_rng(0).normal(size=(100, 3))
    Isvd(IsvdConfig()).fit(points, points)
    write_tum_log(folder / "log", SynthConfig(duration_s=1.0, width_px=320, height_px=240))
    _build(folder, "run")
    _build(folder, "short", "odometry.readout_s=0.03", "source.last_frame=9")  # found only in longer logs
    keep_bytecode()


def _build_lidar(folder: Path) -> None:
    from mapper.simulation.config import LidarSynthConfig
    from mapper.simulation.lidar import write_lidar_log

    write_lidar_log(folder / "log", LidarSynthConfig(duration_s=1.0))
    _build(folder, "run")
    keep_bytecode()


def _build(folder: Path, name: str, *overrides: str) -> None:
    from mapper.config.loading import load_config
    from mapper.export.exporters import export
    from mapper.export.report.data import chapter_of
    from mapper.export.report.page import write_report
    from mapper.pipeline.build import build
    from mapper.sources import open_source

    source = open_source(folder / "log")
    run = build(source, load_config(None, overrides, sensor=source.sensor), folder / name)
    export(run, "octomap", folder / f"{name}.bt")  # reads map.octree
    export(run, "nav2", folder / f"{name}_nav2")  # inflates the slice
    write_report(folder / f"{name}.html", [chapter_of(run, name, ())])  # the octree at coarser levels, too


@contextmanager
def _watched(report: Report) -> Iterator[None]:
    """Report the number of compiled kernels regularly while inside."""
    ended = threading.Event()
    watcher = threading.Thread(target=_watch, args=(report, ended.wait), daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()
    report(KERNELS, KERNELS)


def _watch(report: Report, wait: Callable[[float], bool]) -> None:
    while not wait(_POLL_S):
        if compiled := len(compiled_kernels()):
            report(min(compiled, KERNELS - 1), KERNELS)
