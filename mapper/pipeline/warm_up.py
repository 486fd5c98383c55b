"""Compilation of the kernels before the first build."""

from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mapper.config.loading import load_config
from mapper.export.exporters import export
from mapper.export.report.data import chapter_of
from mapper.export.report.page import write_report
from mapper.features.hamming import match_mutual_bits, pack
from mapper.pipeline.build import build
from mapper.registration.config import IsvdConfig
from mapper.registration.isvd import Isvd
from mapper.registration.reprojection import variance_factor
from mapper.runtime.doctor import processors
from mapper.runtime.progress import SILENT, Progress
from mapper.simulation import write_tum_log
from mapper.simulation.config import LidarSynthConfig, SynthConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source

_CAMERA = SynthConfig(duration_s=1.0, width_px=320, height_px=240)


def compile_kernels(*, progress: Progress = SILENT) -> None:
    """Compile every kernel that builds of RGB-D and LiDAR logs, and reports of their runs, use by default.

    A second of a synthetic log of each sensor is rendered and built, by two processes: the last job begins
    when the scans, the sooner of the first two, are done. What is compiled already is kept.
    """
    jobs = (_build_rgbd, _build_lidar, _build_rolling_shutter)
    with (
        TemporaryDirectory(prefix="mapper-warm-") as scratch,
        progress.stage("compile") as report,
        ProcessPoolExecutor(min(2, processors()), mp_context=get_context("spawn")) as executor,
    ):
        running = [executor.submit(job, Path(scratch) / job.__name__) for job in jobs]
        for done, finished in enumerate(as_completed(running), start=1):
            finished.result()
            report(done, len(jobs))


def _build_rgbd(folder: Path) -> None:
    bits = pack(np.zeros((2, 32), np.uint8))  # what loop closures need, which a second has none of
    match_mutual_bits(bits, bits, 50, 0.8)
    points = np.random.default_rng(0).normal(size=(100, 3))
    Isvd(IsvdConfig()).fit(points, points)
    variance_factor(np.eye(4), points + np.array([0.0, 0.0, 9.0]), points, np.ones((100, 3)), np.ones(5))
    write_tum_log(folder, _CAMERA)
    _build(folder, "run")


def _build_rolling_shutter(folder: Path) -> None:
    write_tum_log(folder, _CAMERA)
    _build(folder, "run", "odometry.readout_s=0.03", "source.last_frame=9")  # found only in longer logs


def _build_lidar(folder: Path) -> None:
    write_lidar_log(folder, LidarSynthConfig(duration_s=1.0))
    _build(folder, "run")


def _build(log: Path, name: str, *overrides: str) -> None:
    source, out = open_source(log), log.with_name(f"{log.name}_{name}")
    run = build(source, load_config(None, overrides, sensor=source.sensor), out)
    export(run, "octomap", out.with_suffix(".bt"))  # reads map.octree
    export(run, "nav2", out.with_name(f"{out.name}_nav2"))  # inflates the slice
    write_report(out.with_suffix(".html"), [chapter_of(run, out.name, ())])  # the octree at coarser levels
