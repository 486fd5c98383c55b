"""Scenes of the BOP benchmark: rgb/ or gray/ beside depth/, and scene_camera.json with a camera an image.

Depth is in units of ``depth_scale`` millimetres; positions, where poses are stated, are in millimetres.
https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field, PositiveFloat, RootModel

from mapper.core.errors import SourceError
from mapper.core.geometry import Transform, inverse
from mapper.core.units import MM_PER_M
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders.numbered import NumberedPair, stamped
from mapper.sources.image_folders.posed import PosedFrames, camera_of, median_camera
from mapper.sources.json_files import read_json
from mapper.sources.text import parse_count, pose_from_matrix

_CAMERAS = "scene_camera.json"
FILES = (_CAMERAS, "depth/*")


class _Camera(BaseModel):
    intrinsics: list[float] = Field(alias="cam_K", min_length=9, max_length=9)
    depth_scale: PositiveFloat = 1.0
    rotation: list[float] | None = Field(None, alias="cam_R_w2c", min_length=9, max_length=9)
    translation: list[float] | None = Field(None, alias="cam_t_w2c", min_length=3, max_length=3)

    def pose(self) -> Transform | None:
        """Return T_world_camera, if it is stated."""
        if self.rotation is None or self.translation is None:
            return None
        t_m = np.array(self.translation) / MM_PER_M
        T = pose_from_matrix(np.column_stack([np.reshape(self.rotation, (3, 3)), t_m]))
        return None if T is None else inverse(T)


class _Cameras(RootModel[dict[str, _Camera]]):
    pass


def read_frames(folder: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames of a scene, which have true poses in some of the data sets.

    Raises:
        SourceError: The list is malformed, or has no camera.
    """
    path = folder / _CAMERAS
    cameras = {parse_count(key, where=f"{path}"): one for key, one in read_json(path, _Cameras).root.items()}
    if not cameras:
        raise SourceError(f"{path}: no camera in it")
    numbers = sorted(cameras)
    colour, depth = (_numbered(folder, names) for names in (("rgb", "gray"), ("depth",)))
    images = [NumberedPair(k, colour[k], depth[k], None) for k in numbers if k in colour and k in depth]
    pairs, notes = stamped(images, rate_hz=config.rate_hz, beside=[folder])
    stated, camera_notes = median_camera(
        [[cameras[k].intrinsics[i] for i in (0, 4, 2, 5)] for k in numbers], origin=f"{path}"
    )
    scale = cameras[numbers[0]].depth_scale
    others = sum(cameras[k].depth_scale != scale for k in numbers)
    if others:
        notes.append(
            f"{path.name}: {others} depth_scales are not {scale:g}, the first, which is taken for all"
        )
    poses = [cameras[image.number].pose() for image in images]
    return PosedFrames(
        pairs, poses, camera_of(folder, config, stated), MM_PER_M / scale, [*notes, *camera_notes]
    )


def _numbered(folder: Path, names: tuple[str, ...]) -> dict[int, Path]:
    """Return the images of the first of some folders that is there, by their numbers."""
    found = next((one for name in names if (one := folder / name).is_dir()), folder / names[0])
    return {int(path.stem): path for path in found.glob("*") if path.stem.isdecimal()}
