"""Polycam's raw data (iOS): keyframes/images, depth, confidence and cameras, named by microseconds.

``cameras/NAME.json`` has the camera and t_00 … t_23, the pose of ARKit's camera row by row.
Once Polycam has processed a scan, ``corrected_images`` are undistorted and ``corrected_cameras`` have poses
after its own optimisation. Depth is in millimetres.
"""

from pathlib import Path

from pydantic import BaseModel

from mapper.core.errors import SourceError
from mapper.core.units import MM_PER_M
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.confidence import confident_depths
from mapper.sources.image_folders.numbered import NumberedPair, stamped
from mapper.sources.image_folders.posed import (
    PosedFrames,
    camera_of,
    median_camera,
    pose_of_opengl,
)
from mapper.sources.json_files import read_json
from mapper.sources.listed_files import refuse_links_out

FILES = ("keyframes/*cameras/*.json", "keyframes/*images/*", "keyframes/depth/*.png")


class _Camera(BaseModel):
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float

    def intrinsics_px(self) -> list[float]:
        return [self.fx, self.fy, self.cx, self.cy]

    def matrix(self) -> list[list[float]]:
        return [
            [self.t_00, self.t_01, self.t_02, self.t_03],
            [self.t_10, self.t_11, self.t_12, self.t_13],
            [self.t_20, self.t_21, self.t_22, self.t_23],
        ]


def read_frames(folder: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames of an export.

    Raises:
        SourceError: A camera's file is malformed.
    """
    keyframes = folder / "keyframes"
    has_corrected = all((keyframes / f"corrected_{what}").is_dir() for what in ("cameras", "images"))
    prefix = "corrected_" if has_corrected else ""
    paths = sorted((keyframes / f"{prefix}cameras").glob("*.json"))
    cameras = [read_json(path, _Camera) for path in paths]
    if not cameras:
        raise SourceError(f"{keyframes}: no camera in {prefix}cameras")
    stated, notes = median_camera(
        [one.intrinsics_px() for one in cameras],
        origin=f"{keyframes.name}/{prefix}cameras",
        size_px=(cameras[0].width, cameras[0].height),
    )
    camera = camera_of(folder, config, stated)
    depths, depth_notes = confident_depths(
        [keyframes / "depth" / f"{path.stem}.png" for path in paths],
        [keyframes / "confidence" / f"{path.stem}.png" for path in paths],
        camera.depth_units_per_m or MM_PER_M,
    )
    refuse_links_out((keyframes / "confidence" / f"{path.stem}.png" for path in paths), log=folder)
    images = [keyframes / f"{prefix}images" / f"{path.stem}.jpg" for path in paths]
    numbers = [int(path.stem) if path.stem.isdecimal() else index for index, path in enumerate(paths)]
    numbered = [NumberedPair(*of_frame, None) for of_frame in zip(numbers, images, depths, strict=True)]
    pairs, stamp_notes = stamped(numbered, rate_hz=config.rate_hz)
    poses = [pose_of_opengl(one.matrix()) for one in cameras]
    return PosedFrames(pairs, poses, camera, MM_PER_M, [*notes, *depth_notes, *stamp_notes])
