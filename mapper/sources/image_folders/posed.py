"""Layouts whose frames have a pose each, as one table: phones' exports, rendered and published scans.

Poses are of the camera, x right, y down, z forward. Those of a phone or tablet (ARKit, ARCore) are estimates
of its own and are kept as *device poses*; those of rendered data, and of scans that were published with
their poses, count as truth.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array, Transform
from mapper.sources.base import Log
from mapper.sources.calibration import Calibration, configured
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders.pairing import ordered_pairs
from mapper.sources.image_folders.rgbd import FramePair, depth_camera, find_calibration, rgbd_log
from mapper.sources.listed_files import present
from mapper.sources.text import pose_from_matrix, truth_from

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_STEADY_RATIO = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrames:
    """Frames of a log.

    Attributes:
        pairs: Both images of each, in any order.
        poses: Their T_world_camera; None where there is none.
        calibration: Camera of the colour images.
        depth_units_per_m: Units per metre of 16-bit depth images, where the calibration states none.
        notes: Sentences on what finding them left out or assumed.
    """

    pairs: Sequence[FramePair]
    poses: Sequence[Transform | None]
    calibration: Calibration
    depth_units_per_m: float
    notes: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Layout:
    """A row of the table.

    Attributes:
        kind: Name of the format.
        files: Globs of which each must find a file in a folder of the format; or the ending of its one file.
        read: Returns the frames of a folder or a file.
        are_poses_true: Whether the poses count as truth.
        holds_too: Returns whether a folder with these files is of the layout indeed.
    """

    kind: str
    files: Sequence[str]
    read: Callable[[Path, SourceConfig], PosedFrames]
    are_poses_true: bool = False
    holds_too: Callable[[Path], bool] = Path.is_dir

    def holds(self, path: Path) -> bool:
        """Return whether a path is a folder or a file of the layout."""
        if path.is_file():
            return path.suffix.lower() in self.files
        globs = [glob for glob in self.files if not glob.startswith(".")]
        found = all(any(map(Path.is_file, path.glob(glob))) for glob in globs)  # opening a pipe would wait
        return bool(globs) and found and self.holds_too(path)


def log_of(layout: Layout, path: Path, config: SourceConfig) -> Log:
    """Return the log of a folder or a file of a layout.

    Raises:
        SourceError: No frame has both images, a file is malformed, or the images do not fit to the camera.
        DependencyError: A library that decodes them is not installed.
    """
    found = layout.read(path, config)
    frames, notes = _whole(found, path)
    ordered, order_notes = ordered_pairs([pair for pair, _ in frames], config, what=layout.kind, path=path)
    poses = [(pair.stamp_ns, T_world_camera) for pair, T_world_camera in frames]
    are_stated = any(T_world_camera is not None for _, T_world_camera in poses)
    stated, pose_notes = truth_from(poses, what=f"poses of {path.name}") if are_stated else (None, [])
    log = rgbd_log(
        ordered,
        found.calibration,
        depth_units_per_m=found.depth_units_per_m,
        path=path,
        name=path.resolve().stem if path.is_file() else path.resolve().name,
        kind=layout.kind,
        truth=(stated if layout.are_poses_true else None, pose_notes),
        notes=[*found.notes, *notes, *order_notes],
    )
    return log if layout.are_poses_true else replace(log, device_poses=stated)


def camera_of(path: Path, config: SourceConfig, stated: Calibration | None) -> Calibration:
    """Return a log's camera: the user's, a calibration file's of its folder, or the one that its files state.

    Raises:
        SourceError: There is none.
    """
    if path.is_dir() or stated is None:
        return find_calibration(path if path.is_dir() else path.parent, config.camera, known=stated)
    factor = None if config.camera is None else config.camera.depth_factor
    chosen = configured(config.camera) or stated
    return replace(
        chosen,
        depth_units_per_m=factor or chosen.depth_units_per_m,
        depth=depth_camera(stated.depth, config.camera),
    )


def pose_of_opengl(matrix: Sequence[Sequence[float]] | Array) -> Transform | None:
    """Return T_world_camera of the rows of a pose whose camera has y up and z backward (ARKit, OpenGL)."""
    T = pose_from_matrix(matrix)
    return None if T is None else T @ _FROM_OPENGL


def median_camera(
    numbers: Sequence[Sequence[float]] | Array, *, origin: str, size_px: tuple[int, int] | None = None
) -> tuple[Calibration, list[str]]:
    """Return the camera of the median of every frame's fx, fy, cx, cy, and a note if they change.

    Raises:
        SourceError: They are not four positive numbers each.
    """
    rows = np.asarray(numbers, np.float64)
    if rows.ndim != 2 or rows.shape[1] != 4 or not (np.isfinite(rows).all() and (rows > 0.0).all()):
        raise SourceError(f"{origin}: intrinsics that are not four positive numbers a frame: fx, fy, cx, cy")
    fx, fy, cx, cy = np.median(rows, axis=0).tolist()
    spread = float(np.abs(rows[:, 0] / fx - 1.0).max())
    notes = []
    if spread > _STEADY_RATIO:
        notes.append(f"{origin}: the focal length changes by up to {spread:.1%}; its median is taken")
    return Calibration(origin, fx, fy, cx, cy, size_px=size_px), notes


def _whole(found: PosedFrames, path: Path) -> tuple[Sequence[tuple[FramePair, Transform | None]], list[str]]:
    """Return the frames whose image files exist, and a note on the others."""
    frames = list(zip(found.pairs, found.poses, strict=True))
    if not frames:
        raise SourceError(f"{path}: no frame in it")
    missing = np.zeros(len(frames), bool)
    for files in ([pair.colour for pair in found.pairs], [pair.depth for pair in found.pairs]):
        paths = {i: file for i, file in enumerate(files) if isinstance(file, Path)}
        missing[list(paths)] |= ~np.array(present(paths.values()), bool)
    whole = [frame for frame, is_missing in zip(frames, missing.tolist(), strict=True) if not is_missing]
    if not whole:
        raise SourceError(
            f"{path}: none of its {len(frames)} frames has both images; the first: "
            f"{found.pairs[0].colour}, {found.pairs[0].depth}"
        )
    left_out = len(frames) - len(whole)
    return whole, [f"{left_out} of {len(frames)} frames lack an image; left out"] if left_out else []
