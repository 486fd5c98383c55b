"""A synthetic LiDAR log on disk: a KITTI folder with exact truth beside it."""

import json
from collections.abc import Callable
from pathlib import Path

from mapper.core.timebase import seconds_text_from_ns
from mapper.runtime.atomic import new_folder
from mapper.runtime.ordered_map import ordered_map
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar.source import SyntheticLidarEntry, SyntheticLidarSource
from mapper.sources.kitti_writing import save_scan
from mapper.sources.trajectory_files import write_kitti
from mapper.sources.wheel_files import write_wheels

_WORKERS = 2


def write_lidar_log(
    out: Path, config: LidarSynthConfig, *, on_progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a synthetic log as KITTI's ``velodyne``, ``times.txt`` and ``poses.txt``, and the scene itself.

    There is no ``calib.txt``: the poses are the LiDAR's own. KITTI's records have no room for times, so
    scans with motion in them are numpy arrays with fields x, y, z and t, seconds after the stamp. The folder
    appears when it is complete.

    Args:
        out: Folder to make; it must not exist.
        config: What to record.
        on_progress: Called with (scans written, scans in all) after every scan.

    Raises:
        SourceError: ``out`` exists, or cannot be written.
    """
    source = SyntheticLidarSource(config)

    def save(entry: SyntheticLidarEntry) -> None:
        save_scan(clouds / f"{entry.index:06d}", entry.load())

    with new_folder(out) as folder:
        clouds = folder / "velodyne"
        clouds.mkdir()
        for done, _ in enumerate(ordered_map(save, source.entries(), workers=_WORKERS), start=1):
            if on_progress is not None:
                on_progress(done, len(source))
        times = [seconds_text_from_ns(int(stamp_ns)) for stamp_ns in source.stamps_ns]
        (folder / "times.txt").write_text("\n".join(times) + "\n", encoding="utf-8")
        write_kitti(folder / "poses.txt", source.truth)
        if source.wheels is not None:
            write_wheels(folder, source.wheels, sensor=source.sensor)
        news = {"wheels"} if config.wheels is None else set()  # without them it says what it always said
        scene = {
            "config": config.model_dump(mode="json", exclude=news),
            "ground": source.scene.ground.as_json(),
            "solids": source.scene.solids.as_json(),
        }
        (folder / "scene.json").write_text(json.dumps(scene, indent=1) + "\n", encoding="utf-8")
