"""Compilation of the kernels before the first build."""

from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mapper.config.loading import load_config, load_source_config
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
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, SynthConfig, SynthImuConfig
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source

_CAMERA = SynthConfig(duration_s=8.0, frame_rate_hz=1.5, width_px=320, height_px=240)
"""Frames so far apart that depth images are aligned, and landmarks are searched in all of a keyframe."""
_LIDAR = LidarSynthConfig(
    scene="courtyard",
    loop_m=30.0,
    laps=1.5,
    rate_hz=5.0,
    imu=SynthImuConfig(),
    sensor=LidarSensorConfig(rings=16),
)
"""A lap and a half, so that places are recognised and poses are adjusted to planes."""


def compile_kernels(*, progress: Progress = SILENT) -> None:
    """Compile every kernel that builds of RGB-D and LiDAR logs, and reports of their runs, use by default.

    A short synthetic log of each sensor is rendered and built, in a process of its own. What is compiled
    already is kept.
    """
    jobs = (_build_rgbd, _build_lidar)
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
    fx_px, cx_px, cy_px = 262.0, 159.5, 119.5
    _build(
        folder,
        "odometry.readout_s=0.03",  # found only in longer logs
        f"source.camera.depth_intrinsics_px=[{fx_px},{fx_px},{cx_px},{cy_px}]",
        "source.camera.depth_in_color=[0.01,0,0,0,0,0,1]",
    )


def _build_lidar(folder: Path) -> None:
    write_lidar_log(folder, _LIDAR)
    _build(folder)


def _build(log: Path, *overrides: str) -> None:
    source = open_source(log, load_source_config(None, overrides))
    out = log.with_name(f"{log.name}_run")
    run = build(source, load_config(None, overrides, sensor=source.sensor), out)
    export(run, "octomap", out.with_suffix(".bt"))  # reads map.octree
    export(run, "nav2", out.with_name(f"{out.name}_nav2"))  # inflates the slice
    write_report(out.with_suffix(".html"), [chapter_of(run, out.name, ())])  # the octree at coarser levels
