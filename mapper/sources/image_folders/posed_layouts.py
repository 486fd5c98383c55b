"""The table of layouts whose frames have a pose each; see :mod:`mapper.sources.image_folders.posed`."""

from pathlib import Path

from mapper.core.errors import SourceError
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders import (
    bop,
    klg,
    nerfstudio,
    polycam,
    record3d,
    replica,
    scannet_sens,
    stray_scanner,
)
from mapper.sources.image_folders.posed import Layout, log_of

LAYOUTS = (
    Layout("stray-scanner", stray_scanner.FILES, stray_scanner.read_frames),
    Layout("record3d", record3d.FILES, record3d.read_frames),
    Layout("polycam", polycam.FILES, polycam.read_frames),
    Layout("nerfstudio", nerfstudio.FILES, nerfstudio.read_frames, holds_too=nerfstudio.has_depth),
    Layout("bop", bop.FILES, bop.read_frames, are_poses_true=True),
    Layout("replica", replica.FILES, replica.read_frames, are_poses_true=True),
    Layout("klg", klg.FILES, klg.read_frames),
    Layout("scannet", scannet_sens.FILES, scannet_sens.read_frames, are_poses_true=True),
)


def recognise(path: Path) -> bool:
    """Return whether a path is a folder or a file of one of the layouts."""
    return _layout_of(path) is not None


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a folder or a file.

    Raises:
        SourceError: As :func:`mapper.sources.image_folders.posed.log_of`.
        DependencyError: A library that decodes it is not installed.
    """
    layout = _layout_of(path)
    if layout is None:
        raise SourceError(f"{path}: none of {', '.join(one.kind for one in LAYOUTS)}")
    return log_of(layout, path, config)


def _layout_of(path: Path) -> Layout | None:
    return next((layout for layout in LAYOUTS if layout.holds(path)), None)
