"""transforms.json with depth (nerfstudio, instant-ngp, apps that export it): two paths and a pose a frame.

The pose is of a camera with y up and z backward. Depth is PNG of millimetres, or of ``integer_depth_scale``
metres a unit, or .npy. https://docs.nerf.studio/quickstart/data_conventions.html
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from math import tan
from pathlib import Path

from pydantic import AliasChoices, BaseModel, Field, PositiveFloat

from mapper.core.errors import SourceError
from mapper.core.units import MM_PER_M
from mapper.runtime.regular_files import read_text
from mapper.sources.calibration import Calibration
from mapper.sources.calibration_file import read_calibration
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.reading import read_grey
from mapper.sources.image_folders.numbered import NumberedPair, stamped
from mapper.sources.image_folders.posed import PosedFrames, camera_of, pose_of_opengl
from mapper.sources.image_folders.rgbd import first_size
from mapper.sources.json_files import read_json
from mapper.sources.listed_files import within
from mapper.sources.text import parse_stamp

FILES = ("transforms.json",)
_LIST = "transforms.json"
_NUMBER = re.compile(r"\d{1,18}(?=\D*$)")


class _Frame(BaseModel):
    file_path: str
    depth_file_path: str | None = Field(None, validation_alias=AliasChoices("depth_file_path", "depth_path"))
    transform_matrix: list[list[float]]
    fl_x: float | None = None
    timestamp: int | float | None = None


class _Transforms(BaseModel):
    frames: list[_Frame]
    integer_depth_scale: PositiveFloat | None = None
    fl_x: float | None = None
    camera_angle_x: PositiveFloat | None = None
    camera_angle_y: PositiveFloat | None = None


def has_depth(folder: Path) -> bool:
    """Return whether frames of the list have depth images."""
    with suppress(SourceError):
        text = read_text(folder / _LIST, error=SourceError)
        return '"depth_file_path"' in text or '"depth_path"' in text
    return False


def read_frames(folder: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames that have depth, in the order of the numbers in their names, if they have any.

    Raises:
        SourceError: The list is malformed, or names a file out of the folder.
    """
    path = folder / _LIST
    listed = read_json(path, _Transforms)
    with_depth = [frame for frame in listed.frames if frame.depth_file_path]
    if not with_depth:
        raise SourceError(f"{path}: no frame of {len(listed.frames)} has a depth_file_path")
    colours = [_with_ending(within(folder, frame.file_path, where=f"{path}")) for frame in with_depth]
    depths = [within(folder, f"{frame.depth_file_path}", where=f"{path}") for frame in with_depth]
    found = [_NUMBER.search(colour.stem) for colour in colours]
    numbers = [int(one[0]) for one in found if one]
    if len(set(numbers)) < len(colours):
        numbers = list(range(len(colours)))
    order = sorted(range(len(numbers)), key=numbers.__getitem__)
    stamps_us = _stamps_us(with_depth, where=f"{path}: timestamp")
    pairs, notes = stamped(
        [NumberedPair(numbers[i], colours[i], depths[i], stamps_us[i]) for i in order],
        rate_hz=config.rate_hz,
        beside=[folder, colours[0].parent],
    )
    if len(with_depth) < len(listed.frames):
        notes.append(f"{len(listed.frames) - len(with_depth)} frames of {_LIST} have no depth; left out")
    poses = [pose_of_opengl(with_depth[i].transform_matrix) for i in order]
    scale = listed.integer_depth_scale
    if listed.camera_angle_x and not (listed.fl_x or with_depth[0].fl_x):
        stated = _camera_by_angles(listed, colours, f"{path}: camera_angle_x")
    else:
        stated = read_calibration(path)
    camera = camera_of(folder, config, stated)
    return PosedFrames(pairs, poses, camera, 1.0 / scale if scale else MM_PER_M, notes)


def _stamps_us(frames: Sequence[_Frame], *, where: str) -> Sequence[int | None]:
    """Return the frames' own stamps, microseconds, as some apps state them; None unless each has another."""
    stated = {frame.timestamp for frame in frames}
    if None in stated or len(stated) < len(frames):
        return [None] * len(frames)
    return [(parse_stamp(f"{frame.timestamp}", where=where) + 500) // 1000 for frame in frames]


def _camera_by_angles(listed: _Transforms, images: Sequence[Path], origin: str) -> Calibration | None:
    """Return the camera of NeRF's lists: its angles of view, with the images' centre as principal point."""
    if listed.camera_angle_x is None:
        return None
    width_px, height_px = size_px = first_size(images, read_grey, where=origin)
    fx_px = 0.5 * width_px / tan(0.5 * listed.camera_angle_x)
    fy_px = 0.5 * height_px / tan(0.5 * listed.camera_angle_y) if listed.camera_angle_y else fx_px
    return Calibration(origin, fx_px, fy_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1), size_px=size_px)


def _with_ending(image: Path) -> Path:
    """Return an image whose name NeRF's lists leave without its ending, which is .png."""
    return image if image.suffix else image.with_suffix(".png")
