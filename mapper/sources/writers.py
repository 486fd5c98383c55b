"""Writers of logs in other formats: TUM and mbag (Somlyai, PhD thesis, §3.5) here, the rest elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.core.rotations import row_of_pose
from mapper.core.timebase import MAX_TRUTH_GAP_NS, nearest, seconds_text_from_ns
from mapper.core.trajectory import Trajectory
from mapper.runtime.atomic import new_folder, write_bytes, write_text
from mapper.sources.base import Accelerations, FrameRef, Log, Skipped
from mapper.sources.calibration_file import calibration_text
from mapper.sources.image_files.decoded import encode_colour, encode_depth
from mapper.sources.image_files.reading import TUM_UNITS_PER_M, image_bytes
from mapper.sources.image_folders.mbag import HEADER
from mapper.sources.image_folders.tum import DEVICE_POSES
from mapper.sources.readings_beside import write_readings
from mapper.sources.scan_folders.kitti_writing import write_kitti_log
from mapper.sources.trajectory_files import write_tum

LogKind = Literal["tum", "mbag", "kitti", "mcap", "bag"]

_NO_POSE = ["nan"] * 7


@dataclass(frozen=True, slots=True)
class _Written:
    """A frame's image files, relative to the log's folder."""

    stamp_ns: int
    colour: Path
    depth: Path
    depth_stamp_ns: int
    depth_units_per_m: float


def write_log(
    source: Log, out: Path, *, kind: LogKind, on_progress: Callable[[int], None] | None = None
) -> list[Skipped]:
    """Write a log in another format and return the frames that could not be.

    RGB-D logs become TUM or mbag folders, LiDAR logs KITTI folders, and both MCAP files or ROS 1 bags.

    Args:
        source: Log that is written.
        out: File or folder to make; it must not exist or be empty.
        kind: The format.
        on_progress: Receives the number of frames done, after each.

    Raises:
        SourceError: OUT is not empty, or no frame of the source can be read and is of a kind that the format
            has room for.
    """
    if kind == "mcap" or kind == "bag":
        from mapper.sources.ros.log_writing import write_recording  # loads rosbags

        return write_recording(source, out, kind=kind, on_progress=on_progress)
    with new_folder(out) as folder:
        if kind == "kitti":
            return write_kitti_log(source, folder, on_progress=on_progress)
        mbag = f"{out.resolve().name}.mbag" if kind == "mbag" else None
        return _write_images_log(source, folder, mbag=mbag, on_progress=on_progress)


def left_out(source: Log, kind: LogKind) -> list[str]:
    """Return the parts of a log that a format has no place for, a sentence each."""
    has = {
        "wheel odometry": source.wheels is not None,
        "device poses": source.device_poses is not None,
        "accelerations": source.accelerations is not None,
        "angular velocities": source.gyroscope is not None,
        "GNSS fixes": source.gnss is not None,
        "images beside the LiDAR": len(source.images) > 0,
        "frames of the sensors beside it": len(source.beside) > 0,
        "the plane of a 2D laser's scans": source.sensor == "lidar-2d",
        "the noise of its depth": source.depth_noise is not None,
    }
    of_all = [
        "images beside the LiDAR",
        "frames of the sensors beside it",
        "the plane of a 2D laser's scans",
        "the noise of its depth",
    ]
    no_place: dict[LogKind, list[str]] = {
        "mbag": ["wheel odometry", "device poses", "angular velocities", "GNSS fixes"],
        "mcap": ["device poses"],
        "bag": ["device poses"],
        "kitti": ["accelerations"],
    }
    missing = [what for what in [*no_place.get(kind, []), *of_all] if has[what]]
    if kind == "mcap" or kind == "bag":
        from mapper.sources.ros.log_writing import early_readings  # loads rosbags

        missing += [f"{count} {what} before the time 0" for what, count in early_readings(source).items()]
    return [f"{kind} has no place for {what}; left out" for what in missing]


def _write_images_log(
    source: Log,
    out: Path,
    *,
    mbag: str | None,
    on_progress: Callable[[int], None] | None,
) -> list[Skipped]:
    """Write an RGB-D log as a folder of image files, TUM's, or the mbag of a name.

    Image files are copied byte for byte under names that are their stamps; frames without files are encoded
    as PNG, depth at 0.2 mm. ``calibration.toml`` keeps the camera and depth units. TUM keeps the whole truth;
    mbag has room for one pose a frame, the nearest within 20 ms, and none for wheels.
    """
    camera = _camera_of(source)
    written: list[_Written] = []
    skipped: list[Skipped] = []
    for done, entry in enumerate(source.entries(), start=1):
        try:
            written.append(_write_images(entry, out))
        except FrameError as error:
            skipped.append(Skipped(entry.stamp_ns, str(error)))
        if on_progress is not None:
            on_progress(done)
    units_per_m = written[0].depth_units_per_m
    write_text(out / "calibration.toml", calibration_text(camera, depth_units_per_m=units_per_m))
    if source.accelerations is not None:
        write_text(out / "accelerometer.txt", _accelerations_text(source.accelerations, source.name))
    if mbag is not None:
        write_text(out / mbag, _mbag_text(written, source))
    else:
        if source.truth is not None:
            write_tum(out / "groundtruth.txt", source.truth)
        if source.device_poses is not None:
            write_tum(out / DEVICE_POSES, source.device_poses)
        write_readings(source, out)
        depth_files = {frame.depth_stamp_ns: frame.depth for frame in written}
        colour_files = {frame.stamp_ns: frame.colour for frame in written}
        write_text(out / "depth.txt", _list_text("depth maps", source.name, depth_files))
        write_text(out / "rgb.txt", _list_text("color images", source.name, colour_files))
    return skipped


def _camera_of(source: Log) -> PinholeCamera:
    """Return the camera of the first readable frame's colour image: a log without any is no RGB-D log."""
    if source.sensor != "rgbd":
        raise SourceError(f"{source.path}: scans without images; TUM and mbag hold RGB-D frames: --as kitti")
    reason = "it has no frames"
    for entry in source.entries():
        try:
            camera = _load(entry).camera
            files = entry.files
            return camera if files is None or files.colour_px is None else camera.resized(*files.colour_px)
        except FrameError as error:
            reason = str(error)
    raise SourceError(f"{source.path}: no frame can be written: {reason}")


def _load(entry: FrameRef) -> RgbdFrame:
    frame = entry.load()
    if not isinstance(frame, RgbdFrame):
        raise FrameError(
            f"frame {entry.stamp_ns}: a scan without images; TUM and mbag hold RGB-D frames: --as kitti"
        )
    return frame


def _write_images(entry: FrameRef, out: Path) -> _Written:
    """Copy or encode both images; return their paths relative to ``out``."""
    stamp = seconds_text_from_ns(entry.stamp_ns)
    if (files := entry.files) is not None:
        depth_stamp = seconds_text_from_ns(entry.depth_stamp_ns)
        colour = Path("rgb", stamp + files.colour.suffix)
        depth = Path("depth", depth_stamp + files.depth.suffix)
        write_bytes(out / colour, image_bytes(files.colour))
        write_bytes(out / depth, image_bytes(files.depth))
        return _Written(entry.stamp_ns, colour, depth, entry.depth_stamp_ns, files.depth_units_per_m)
    frame = _load(entry)
    depth_stamp = seconds_text_from_ns(frame.depth_stamp_ns)
    colour, depth = Path("rgb", f"{stamp}.png"), Path("depth", f"{depth_stamp}.png")
    write_bytes(out / colour, encode_colour(frame.image))
    write_bytes(out / depth, encode_depth(frame.depth_m, TUM_UNITS_PER_M))
    return _Written(entry.stamp_ns, colour, depth, frame.depth_stamp_ns, TUM_UNITS_PER_M)


def _list_text(title: str, name: str, files: dict[int, Path]) -> str:
    lines = [f"# {title}", f"# file: '{name}'", "# timestamp filename"]
    lines += [
        f"{seconds_text_from_ns(stamp_ns)} {path.as_posix()}" for stamp_ns, path in sorted(files.items())
    ]
    return "\n".join(lines) + "\n"


def _accelerations_text(accelerations: Accelerations, name: str) -> str:
    lines = ["# accelerometer data", f"# file: '{name}'", "# timestamp ax ay az"]
    for stamp_ns, reading in zip(accelerations.stamps_ns, accelerations.acceleration_mps2, strict=True):
        lines.append(" ".join([seconds_text_from_ns(int(stamp_ns)), *(repr(float(a)) for a in reading)]))
    return "\n".join(lines) + "\n"


def _mbag_text(written: list[_Written], source: Log) -> str:
    lines = [HEADER, f"!dbName: {source.name}"]
    poses = _pose_words(np.array([frame.stamp_ns for frame in written], dtype=np.int64), source.truth)
    for frame, pose in zip(written, poses, strict=True):
        paths = [frame.colour.as_posix(), frame.depth.as_posix()]
        lines.append("; ".join([seconds_text_from_ns(frame.stamp_ns), *paths, *pose]))
    return "\n".join(lines) + "\n"


def _pose_words(stamps_ns: NDArray[np.int64], truth: Trajectory | None) -> list[list[str]]:
    """Return x y z qx qy qz qw of the truth nearest to each stamp, or ``nan`` where none is near."""
    if truth is None:
        return [_NO_POSE] * len(stamps_ns)
    index, gap_ns = nearest(truth.stamps_ns, stamps_ns)
    words = []
    for i, gap in zip(index, gap_ns, strict=True):
        row = row_of_pose(truth.T_world_body[i]).tolist()
        words.append(list(map(repr, row)) if gap <= MAX_TRUTH_GAP_NS else _NO_POSE)
    return words
