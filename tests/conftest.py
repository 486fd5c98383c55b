"""Tiny recorded logs, made on the spot."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapper.core.timebase import seconds_text_from_ns
from mapper.simulation import write_tum_log
from mapper.simulation.config import SynthConfig

FIRST_NS = 1_305_031_102_175_304_000
PERIOD_NS = 33_333_000
DEPTH_LEAD_NS = 9_999_000
CALIBRATION = "fx_px = 60.0\nfy_px = 61.0\ncx_px = 31.5\ncy_px = 23.5\n"


def picture(seed: int, *, width_px: int = 64, height_px: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """An RGB image and a 16-bit depth image with a hole."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height_px // 4, width_px // 4, 3), dtype=np.uint8)
    rgb = cv2.resize(coarse, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
    rows, columns = np.mgrid[:height_px, :width_px]
    depth = (5000 + 20 * rows + 10 * columns + 100 * seed).astype(np.uint16)
    depth[: height_px // 4, : width_px // 4] = 0
    return rgb, depth


def write_picture(colour: Path, depth: Path, seed: int, **size: int) -> None:
    rgb, units = picture(seed, **size)
    for path, pixels in ((colour, rgb[:, :, ::-1]), (depth, units)):
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), pixels)


@pytest.fixture
def tiny_tum_log(tmp_path: Path) -> Callable[..., Path]:
    """Make a TUM folder of ``n`` 64×48 frames with truth along x at 0.3 m/s."""

    def make(n: int = 5, *, folder: str = "log", ending: str = ".png") -> Path:
        log = tmp_path / folder
        colour_lines, depth_lines, truth_lines = (["# tiny"] for _ in range(3))
        for i in range(n):
            stamp_ns = FIRST_NS + i * PERIOD_NS
            stamp, depth_stamp = (seconds_text_from_ns(t) for t in (stamp_ns, stamp_ns - DEPTH_LEAD_NS))
            write_picture(log / f"rgb/{stamp}{ending}", log / f"depth/{depth_stamp}.png", seed=i)
            colour_lines.append(f"{stamp} rgb/{stamp}{ending}")
            depth_lines.append(f"{depth_stamp} depth/{depth_stamp}.png")
            truth_lines.append(f"{seconds_text_from_ns(stamp_ns + 1_000_000)} {0.01 * i} 0 1.5 0 0 0.6 0.8")
        for name, lines in (("rgb", colour_lines), ("depth", depth_lines), ("groundtruth", truth_lines)):
            (log / f"{name}.txt").write_text("\n".join(lines) + "\n")
        (log / "calibration.toml").write_text(CALIBRATION)
        return log

    return make


@pytest.fixture(scope="session")
def desk_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic TUM log of two seconds before a desk, with truth; tests that damage it work on a copy."""
    log = tmp_path_factory.mktemp("synthetic") / "desk"
    write_tum_log(
        log,
        SynthConfig(
            path="desk",
            duration_s=2.0,
            frame_rate_hz=15.0,
            width_px=320,
            height_px=240,
            texture_px_per_m=64,
            posters_per_room=3,
            furniture_per_room=4,
        ),
    )
    return log


@pytest.fixture(scope="session")
def dask_scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a Dask scheduler with two workers, which gives up a job whose worker has died once."""
    folder = tmp_path_factory.mktemp("dask")
    contact = folder / "scheduler.json"
    settings = os.environ | {
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0",
        "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",  # it watches what takes long: our imports
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), str(Path(__file__).parent)]),
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
        for _ in range(600):
            if contact.exists() and contact.stat().st_size:
                break
            time.sleep(0.1)
        yield json.loads(contact.read_text())["address"]
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()
