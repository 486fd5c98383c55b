"""HoloLens 2's recordings by Microsoft's StreamRecorder (Research Mode), unpacked as by its own scripts.

https://github.com/microsoft/HoloLens2ForCV/tree/main/Samples/StreamRecorder: colour is in ``PV/*.png``, or
``*.bytes`` of BGRA, with ``*_pv.txt``: a line of principal point and size, then for each image stamp, focal
lengths and pose. ``Depth Long Throw/*.pgm`` has millimetres along the rays of ``Depth Long Throw_lut.bin``;
``…_extrinsics.txt`` maps the rig's points to its camera, and ``…_rig2world.txt`` has the rig's poses. Stamps,
in names too, count 100 ns since 1601, and centres of pixels are halves. Poses are kept as *device poses*.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, Image
from mapper.core.geometry import Array, Transform, inverse, nearest_rotation, transform
from mapper.core.timebase import Stamps, nearest
from mapper.core.trajectory import Trajectory
from mapper.core.units import MM_PER_M
from mapper.sources.base import ImageFile, Log
from mapper.sources.calibration import Calibration, DepthCamera
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.decoded import DecodedColour, DecodedDepth
from mapper.sources.image_files.image_sizes import Size
from mapper.sources.image_files.reading import (
    TUM_UNITS_PER_M,
    bytes_of,
    decode_depth_units,
    depth_m_from,
    read_depth_m,
)
from mapper.sources.image_folders.pairing import ImageList, pair_images
from mapper.sources.image_folders.posed import camera_of, median_camera, pose_of_opengl
from mapper.sources.image_folders.rgbd import first_size, rgbd_log
from mapper.sources.text import parse_count, parse_numbers, pose_from_matrix, rows, truth_from

_DEPTH = "Depth Long Throw"
_COLOUR_FOLDERS = ("PV", "rgb")
"""Names that the scripts give it, the first ones the latter."""
_TICK_NS, _TICKS_TO_1970, _TICKS_TO_2234 = 100, 116_444_736_000_000_000, 200_000_000_000_000_000
_HALF_PX = 0.5


def recognise(path: Path) -> bool:
    """Return whether a path is a folder of a recording, with its images or not."""
    return (path / f"{_DEPTH}_lut.bin").is_file() and any(path.glob("*_pv.txt"))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a recording; the body is the colour camera.

    Raises:
        SourceError: Images are not unpacked or do not pair, or a file is malformed.
    """
    stated, poses, notes = _video(path)
    folder = next((path / name for name in _COLOUR_FOLDERS if (path / name).is_dir()), path / "PV")
    colour_ns, colours = _stamped(folder, ".bytes", ".png")
    depth_ns, depths = _stamped(path / _DEPTH, ".pgm")
    depth_px = first_size(depths, lambda file: read_depth_m(file, MM_PER_M), where=f"{path / _DEPTH}")
    rays = _unit_rays(path / f"{_DEPTH}_lut.bin", depth_px)
    stated = replace(stated, depth=_depth_camera(path, poses, rays))
    camera = camera_of(path, config, stated)
    units_per_m = camera.depth_units_per_m or MM_PER_M
    chosen = np.unique(nearest(colour_ns, depth_ns)[0])  # of 30 images a second; depth has five or fewer
    pairs, pair_notes = pair_images(
        ImageList(colour_ns[chosen], [_colour(colours[i], stated.size_px or (0, 0)) for i in chosen]),
        ImageList(depth_ns, [_depth(file, rays[..., 2], units_per_m) for file in depths]),
        config,
        path=path,
    )
    log = rgbd_log(
        pairs,
        replace(camera, depth=camera.depth or stated.depth),
        depth_units_per_m=TUM_UNITS_PER_M,
        path=path,
        name=path.resolve().name,
        kind="hololens",
        truth=(None, []),
        notes=[*notes, *pair_notes],
    )
    return replace(log, device_poses=poses)


def _video(path: Path) -> tuple[Calibration, Trajectory | None, list[str]]:
    """Return what ``*_pv.txt`` says: the camera, T_world_camera with y down and z forward, and notes."""
    file = min(path.glob("*_pv.txt"))
    lines = list(rows(file, separator=","))
    if not lines or len(lines[0][1]) != 4:
        raise SourceError(f"{file}: want first a line of the principal point, width and height")
    number, first = lines[0]
    cx, cy = parse_numbers(first[:2], where=f"{file}:{number}").tolist()
    width, height = (parse_count(word, where=f"{file}:{number}") for word in first[2:])
    intrinsics, poses = [], []
    for stamp_ns, numbers in _posed(file, lines[1:], 18):
        intrinsics.append([*numbers[:2], cx - _HALF_PX, cy - _HALF_PX])
        poses.append((stamp_ns, pose_of_opengl(numbers[2:].reshape(4, 4))))
    calibration, notes = median_camera(intrinsics, origin=file.name, size_px=(width, height))
    found, pose_notes = truth_from(poses, what=f"poses of {file.name}")
    return calibration, found, [*notes, *pose_notes]


def _posed(file: Path, lines: Sequence[tuple[int, Sequence[str]]], count: int) -> Iterator[tuple[int, Array]]:
    """Yield the stamp, nanoseconds, and the numbers of each line."""
    for number, words in lines:
        where = f"{file}:{number}"
        if len(words) != 1 + count:
            raise SourceError(f"{where}: {len(words)} columns, want {1 + count}: a stamp and {count} numbers")
        if not _is_stamp(words[0]):
            raise SourceError(f"{where}: {words[0]!r} is no stamp; want units of 100 ns since 1601")
        yield _ns(words[0]), parse_numbers(words[1:], where=where)


def _is_stamp(text: str) -> bool:
    return len(text) == 18 and text.isdecimal() and _TICKS_TO_1970 <= int(text) < _TICKS_TO_2234


def _ns(ticks: str) -> int:
    return _TICK_NS * (int(ticks) - _TICKS_TO_1970)


def _stamped(folder: Path, *endings: str) -> tuple[Stamps, list[Path]]:
    """Return the images of a folder that are named by their stamps, of the last of these endings there is."""
    by_stamp = {
        _ns(file.stem): file
        for ending in endings
        for file in folder.glob(f"*{ending}")
        if _is_stamp(file.stem)
    }
    if not by_stamp:
        raise SourceError(
            f"{folder}: no image NUMBER{endings[-1]} in it; unpack {folder.name}.tar there, as "
            "StreamRecorder's process_all.py does"
        )
    stamps_ns = sorted(by_stamp)
    return np.array(stamps_ns, np.int64), [by_stamp[stamp_ns] for stamp_ns in stamps_ns]


def _colour(file: Path, size_px: Size) -> ImageFile:
    return DecodedColour(file, partial(_bgra, file, size_px)) if file.suffix == ".bytes" else file


def _bgra(file: Path, size_px: Size, in_colour: bool) -> Image:
    data, (width, height) = bytes_of(file), size_px
    if len(data) != 4 * width * height:
        raise FrameError(f"{file}: {len(data)} bytes are no image of {width}×{height} px, 4 bytes each")
    code = cv2.COLOR_BGRA2RGB if in_colour else cv2.COLOR_BGRA2GRAY
    return np.asarray(cv2.cvtColor(np.frombuffer(data, np.uint8).reshape(height, width, 4), code), np.uint8)


def _depth(file: Path, z_of_unit: NDArray[np.float32], units_per_m: float) -> ImageFile:
    return DecodedDepth(file, partial(_depth_m, file, z_of_unit, units_per_m), TUM_UNITS_PER_M)


def _depth_m(file: Path, z_of_unit: NDArray[np.float32], units_per_m: float) -> DepthImage:
    distance_m = depth_m_from(decode_depth_units(bytes_of(file), f"{file}"), units_per_m)
    if distance_m.shape != z_of_unit.shape:
        raise FrameError(f"{file}: rows and columns {distance_m.shape}, but the log has {z_of_unit.shape}")
    return distance_m * z_of_unit


def _unit_rays(file: Path, size_px: Size) -> NDArray[np.float32]:
    """Return (H, W, 3) unit vectors, z forward; 0 where the lens has none."""
    try:
        data = bytes_of(file)
    except FrameError as error:
        raise SourceError(f"{error}") from None
    (width, height), want = size_px, 12 * size_px[0] * size_px[1]
    if len(data) != want:
        raise SourceError(f"{file}: {len(data)} bytes, want {want}: a ray of each of {width}×{height} px")
    with np.errstate(all="ignore"):  # a damaged file's numbers may be signalling NaN
        rays = np.frombuffer(data, "<f4").reshape(height, width, 3).astype(np.float64)
        is_ray = (np.abs(np.linalg.norm(rays, axis=2) - 1.0) < 0.01) & (rays[..., 2] > 0.0)
    if 2 * is_ray.sum() < is_ray.size:
        raise SourceError(f"{file}: {is_ray.sum()} of {is_ray.size} rays are unit vectors, want half or more")
    return np.where(is_ray[..., None], rays, 0.0).astype(np.float32)


def _depth_camera(path: Path, poses: Trajectory | None, rays: NDArray[np.float32]) -> DepthCamera:
    z = np.where(rays[..., 2:] > 0.0, rays[..., 2:], 1.0)
    tangents = np.asarray(rays[..., :2] / z, np.float32)
    x_step, y_step = (float(np.median(np.diff(tangents[..., axis], axis=1 - axis))) for axis in (0, 1))
    where = f"{_DEPTH}_lut.bin"
    if not min(x_step, y_step) > 0.0:
        raise SourceError(f"{path / where}: its rays do not run from left to right and from top to bottom")
    height, width = rays.shape[:2]
    calibration = Calibration(where, 1.0 / x_step, 1.0 / y_step, width / 2, height / 2)
    T_color_depth = _depth_in_colour(path, poses)
    return DepthCamera(calibration, T_color_depth, f"{_DEPTH}_rig2world.txt", tangents)


def _depth_in_colour(path: Path, poses: Trajectory | None) -> Transform:
    """Return T_color_depth: both are fixed to the rig, so it is the median over the rig's poses."""
    file = path / f"{_DEPTH}_extrinsics.txt"
    numbers = parse_numbers(
        [word for _, words in rows(file, separator=",") for word in words], where=f"{file}"
    )
    T_depth_rig = pose_from_matrix(numbers.reshape(4, 4)) if len(numbers) == 16 else None
    if T_depth_rig is None:
        raise SourceError(f"{file}: no rigid motion of 16 numbers")
    file = path / f"{_DEPTH}_rig2world.txt"
    lines = _posed(file, list(rows(file, separator=",")), 16)
    rig, _ = truth_from([(at_ns, pose_from_matrix(m.reshape(4, 4))) for at_ns, m in lines], what=file.name)
    found = [
        inverse(poses.at(stamp_ns)) @ T_world_rig @ inverse(T_depth_rig)
        for stamp_ns, T_world_rig in (rig.items() if rig and poses else ())
        if poses and poses.stamps_ns[0] <= stamp_ns <= poses.stamps_ns[-1]
    ]
    if not found:
        raise SourceError(f"{file}: no pose of the rig is of the time of the colour images' poses")
    T_color_depth = np.median(found, axis=0)
    return transform(nearest_rotation(T_color_depth[:3, :3]), T_color_depth[:3, 3])
