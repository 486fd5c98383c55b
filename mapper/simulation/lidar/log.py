"""A synthetic LiDAR log on disk: a KITTI folder with exact truth beside it."""

from collections.abc import Callable
from pathlib import Path

from mapper.core.timebase import seconds_text_from_ns
from mapper.runtime.atomic import new_folder, write_json
from mapper.runtime.ordered_map import ordered_map
from mapper.simulation.config import LidarSynthConfig, set_or_first
from mapper.simulation.lidar.source import LidarSimulator
from mapper.sources.scan_folders.kitti_writing import save_scan
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
        config: Settings of the log.
        on_progress: Called with (scans written, scans in all) after every scan.

    Raises:
        SourceError: ``out`` exists, or cannot be written.
    """
    simulator = LidarSimulator(config)
    log = simulator.log()

    def save(index: int) -> None:
        save_scan(clouds / f"{index:06d}", simulator.observe(index))

    with new_folder(out) as folder:
        clouds = folder / "velodyne"
        clouds.mkdir()
        for done, _ in enumerate(ordered_map(save, range(len(log)), workers=_WORKERS), start=1):
            if on_progress is not None:
                on_progress(done, len(log))
        times = [seconds_text_from_ns(stamp_ns) for stamp_ns in log.stamps_ns.tolist()]
        (folder / "times.txt").write_text("\n".join(times) + "\n", encoding="utf-8")
        write_kitti(folder / "poses.txt", simulator.truth)
        if log.wheels is not None:
            write_wheels(folder, log.wheels, sensor=log.sensor)
        scene = {
            "config": set_or_first(config, exclude=set()),
            "ground": simulator.scene.ground.as_json(),
            "solids": simulator.scene.solids.as_json(),
        }
        write_json(folder / "scene.json", scene, indent=1)
