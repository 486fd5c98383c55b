"""Memory, time and checkpoints of tracking against the number of frames, always through new places.

    python -m benchmarks.long_logs rgbd [--frames 2400]
    python -m benchmarks.long_logs lidar [--frames 3000]

"rgbd" walks through a building that grows with the log, "lidar" drives along a street. Frames are simulated
in other threads as they are read, so that no log is in memory or on disk. Each row covers a tenth of the
frames: growth of resident memory since before the first frame; CPU milliseconds per frame in the thread that
tracks, searches for loops and takes checkpoints; CPU milliseconds per frame for checkpoints, in that thread
and in the one that writes them; size of the checkpoints on disk.
"""

import argparse
import os
import shutil
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from mapper.config.loading import load_config
from mapper.core.units import MB
from mapper.pipeline.build import build
from mapper.pipeline.tracking_checkpoints import TrackingCheckpoints
from mapper.run import files
from mapper.run.observers import Observers, Step
from mapper.runtime.archive import Archive
from mapper.runtime.atomic import partial_of
from mapper.runtime.journal import Journal, StateFile
from mapper.simulation import CameraSimulator
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, SynthConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.sources.base import Log

ROWS = 10
FRAMES_PER_ROOM, SCAN_STEP_M = 50, 0.5
"""At 10 Hz; a room is 4.4 m across, and has an aisle."""


class Enough(KeyboardInterrupt):
    """All frames are tracked; what follows is of no interest here."""


class Clock:
    """CPU seconds that functions took in whatever thread called them."""

    def __init__(self, *methods: tuple[type, str]) -> None:
        self._spent_s = dict.fromkeys(methods, 0.0)
        for method in methods:
            self._measure(method)

    def _measure(self, method: tuple[type, str]) -> None:
        owner, name = method
        function = getattr(owner, name)

        def measured(*arguments: Any, **settings: Any) -> Any:
            began_s = time.thread_time()
            try:
                return function(*arguments, **settings)
            finally:
                self._spent_s[method] += time.thread_time() - began_s

        setattr(owner, name, measured)

    @property
    def seconds(self) -> float:
        """Sum over the functions."""
        return sum(self._spent_s.values())


class Meter(Observers):
    """Prints a row at intervals of tracked frames."""

    def __init__(self, out: Path, frames: int) -> None:
        self._checkpoints, self._frames = partial_of(out) / files.CHECKPOINTS, frames
        self._done = self._keyframes = 0
        self._cpu_s, self._checkpoints_s, self._before = time.thread_time(), 0.0, resident_bytes()
        self._clock = Clock(
            (TrackingCheckpoints, "add"), (Archive, "release"), (Journal, "write"), (StateFile, "write")
        )
        print(
            f"{'frames':>7} {'keyframes':>9} {'memory MB':>9} {'ms/frame':>8} {'checkpoints: ms/frame':>21} "
            f"{'MB':>7}"
        )

    def on_frame(self, step: Step) -> None:
        """Count a frame."""
        self._done += 1
        self._keyframes += step.track.is_keyframe
        every = max(1, self._frames // ROWS)
        if self._done % every == 0:
            now_s, memory = time.thread_time(), resident_bytes() - self._before
            ms, self._cpu_s = 1e3 * (now_s - self._cpu_s) / every, now_s
            spent_s = self._clock.seconds
            checkpoints_ms, self._checkpoints_s = 1e3 * (spent_s - self._checkpoints_s) / every, spent_s
            print(
                f"{self._done:7d} {self._keyframes:9d} {memory / MB:9.0f} {ms:8.1f} {checkpoints_ms:21.2f} "
                f"{size_of(self._checkpoints) / MB:7.1f}",
                flush=True,
            )
        if self._done >= self._frames:
            raise Enough


def resident_bytes() -> int:
    """Return the resident memory of this process; Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def size_of(folder: Path) -> int:
    """Return the size of the files in a folder, of which some may vanish."""
    size = 0
    for path in folder.glob("*"):
        with suppress(OSError):
            size += path.stat().st_size
    return size


def building(frames: int) -> Log:
    """Return an RGB-D log through a building with enough rooms that none is seen twice."""
    rooms = max(4, 2 * -(-frames // (2 * FRAMES_PER_ROOM)))
    config = SynthConfig(
        rooms=rooms, frame_rate_hz=10.0, width_px=320, height_px=240, texture_px_per_m=64, posters_per_room=6
    )
    return CameraSimulator(config).log()


def street(frames: int) -> Log:
    """Return a LiDAR log along a street that does not come back."""
    sensor = LidarSensorConfig()
    config = LidarSynthConfig(loop_m=1.1 * SCAN_STEP_M * frames, sensor=sensor)
    return LidarSimulator(config).log()


def main() -> None:
    """Track one log."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sensor", choices=("rgbd", "lidar"))
    parser.add_argument("--frames", type=int, default=None, help="2400 images, 3000 scans")
    parser.add_argument("--set", action="append", default=[], help="setting of the build")
    options = parser.parse_args()
    frames = options.frames or (2400 if options.sensor == "rgbd" else 3000)
    log = building(frames) if options.sensor == "rgbd" else street(frames)
    print(f"{log.name}: {frames} of {len(log)} frames")
    folder = Path(tempfile.mkdtemp(prefix="long_logs_"))
    try:
        meter = Meter(folder / "run", min(frames, len(log)))
        with suppress(Enough):
            build(log, load_config(None, options.set, sensor=log.sensor), folder / "run", observer=meter)
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
