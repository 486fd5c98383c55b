"""Recorded logs as sequences of frames."""

import re
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING

from mapper.core.errors import SourceError, listed
from mapper.runtime.atomic import MANIFEST_NAME
from mapper.runtime.regular_files import reads
from mapper.sources.config import SourceConfig

if TYPE_CHECKING:
    from mapper.sources.base import Log

__all__ = ["open_source"]

RECORDING = "ros.files"
# The first that recognises a path reads it. Images of ICL-NUIM and Poznań are numbered too, and stamps are
# numbers, so these come before numbered images; any log's folder may have clouds in it, so clouds come last.
FORMATS = (
    "image_folders.posed_layouts",
    "image_folders.azure_kinect",
    "image_folders.hololens",
    "image_folders.icl_nuim",
    "image_folders.tum",
    "image_folders.mbag",
    "image_folders.poznan",
    "image_folders.stamped_images",
    "image_folders.numbered",
    "scan_folders.kitti",
    "image_folders.kitti_stereo",
    "image_folders.stereo_pairs",
    RECORDING,
    "scan_folders.ouster_pcap",
    "scan_folders.ouster_osf",
    "scan_folders.velodyne_pcap",
    "scan_folders.e57",
    "scan_folders.carmen",
    "scan_folders.las_strips",
    "scan_folders.clouds",
)
"""Modules, imported one after the other when a log is opened, until one recognises it."""
_MOST_TRIED, _MOST_LOOKED_AT = 20, 10_000
"""Folders within a folder, and files, that are looked at to say which is the log or what lacks."""
_DEFAULTS = SourceConfig()
_ADDRESS = re.compile(r"\w+:/")
_IMAGES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".ppm"}
_ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar")
_VIDEOS = (".mp4", ".mov", ".avi", ".webm", ".m4v")
_OTHER_FILES = {
    **dict.fromkeys(_ARCHIVES, "an archive; unpack it, and open the folder"),
    **dict.fromkeys(_VIDEOS, "a video, which has no depth; open the folder of its log"),
    **dict.fromkeys((*_IMAGES, ".exr"), "one image; open the folder of its log"),
    **dict.fromkeys(
        (".svo", ".svo2"),
        "a ZED's own format; export images and depth with its SDK, or record zed-ros2-wrapper's topics",
    ),
    **dict.fromkeys(
        (".lvx", ".lvx2"), "Livox Viewer's own format; convert it to .bag or .las with Livox's tools"
    ),
    ".oni": "OpenNI's own format; play it into a recording with openni2_launch, or export its images",
    ".vrs": "Project Aria's own format; it has no depth",
    ".npz": "arrays of NumPy; write each cloud as .npy, or images as .png, into a folder",
}
"""What files are that are no logs, and what to do, by their ending."""
_RECORDINGS = (".mcap", ".bag", ".db3", ".klg", ".mkv", ".r3d", ".pcap", ".pcapng", ".osf")
"""Endings of logs that are one file each, of which a folder may hold several."""


def open_source(path: Path, config: SourceConfig = _DEFAULTS) -> "Log":
    """Return a recorded log, recognised by its files, with the configured selection of its frames.

    Args:
        path: Folder of a TUM, ICL-NUIM, Poznań, 7-Scenes, Redwood, ScanNet, Replica, EuRoC or KITTI log,
            of an app's export (Stray Scanner, Record3D, Polycam, nerfstudio), of a HoloLens 2 or of clouds;
            an mbag, .sens, .klg, .r3d, .mkv (Azure), .e57, .pcap, .osf or MCAP file, CARMEN log or ROS bag.
        config: Selection, pairing, camera, and what the files of a log do not state.

    Raises:
        SourceError: Nothing is there, no format fits, the log is malformed, nothing of it is selected, or it
            has no frame such as is to be its body.
        DependencyError: A library that decodes it is not installed.
    """
    from mapper.sources.frame_selection import selected
    from mapper.sources.listed_files import unused_note
    from mapper.sources.readings_beside import with_readings
    from mapper.sources.scan_folders.scan_folder import most_clouds

    if not path.exists():
        if address := _ADDRESS.match(f"{path}"):  # of whose two slashes a path keeps one
            url = f"{address[0]}/{f'{path}'[address.end() :]}"
            raise SourceError(f"{url}: an address; download it, or mount its store, and open the file")
        raise SourceError(f"{path}: no such file or folder")
    if not (path.is_dir() or path.is_file()):
        raise SourceError(f"{path}: a device or a pipe; want a file or a folder")
    if name := format_of(path):
        if config.body_frame is not None and name != RECORDING:
            raise SourceError(
                f"{path}: source.body_frame={config.body_frame}: only a recording's tf has such a frame; "
                "leave it out"
            )
        with reads() as read:
            log: Log = import_module(f"mapper.sources.{name}").read_log(path, config)
            if path.is_dir():
                log = with_readings(log, path, config)
        if name != RECORDING:
            log = replace(log, notes=[*log.notes, *unused_note(path, read)])
        return selected(log, config)
    if (path / MANIFEST_NAME).is_file():
        raise SourceError(f"{path}: holds what mapper made, not a log; mapper eval {path} judges it")
    above = path.absolute().parent
    if what := _other_data(path):
        within = f"; the folder it is in, {above}, is one" if path.is_dir() and format_of(above) else ""
        raise SourceError(f"{path}: {what}{within}")
    if path.is_file():
        hint = f"; the folder it is in, {above}, is one" if format_of(above) else ""
    else:
        one = "; of clouds it has one, want two or more" if most_clouds(path) == 1 else ""
        hint = one or _inner_hint(path)
    raise SourceError(
        f"{path}: not a log of a known format (TUM, 7-Scenes, KITTI, EuRoC, clouds, exports of apps, .mcap, "
        f".bag, .db3, .mbag, .e57 …); docs/your-sensor.md has them all{hint}"
    )


def _other_data(path: Path) -> str:
    """Return what a file or folder of other data is and what to do; empty if its name does not say."""
    if path.is_file():
        return _OTHER_FILES.get(path.suffix.lower(), "")
    endings = {inner.suffix.lower() for inner in path.iterdir() if inner.is_file()}
    if endings and endings <= _IMAGES:
        return "images alone; depth images belong beside them, as in rgb/ and depth/"
    if len(endings) == 1 and (what := _OTHER_FILES.get(*endings)):
        return f"files {endings.pop()}: {what}"
    from mapper.sources.image_folders.numbered import image_places

    colour, depth, _ = image_places(path)
    if any(place.numbered for place in colour) and any(place.numbered for place in depth):
        names = listed([f"{place.name}/" for place in (*colour, *depth)])
        return f"the names of its images in {names} have no number in common, which pairs colour with depth"
    return ""


def format_of(path: Path) -> str | None:
    """Return the module of the format that recognises a file or folder; None if none does."""
    recognising = (name for name in FORMATS if import_module(f"mapper.sources.{name}").recognise(path))
    return next(recognising, None)


def _inner_hint(path: Path) -> str:
    """Return advice to open what is in a folder: a log in a folder of its own, or one of several bags."""
    within = (sorted(inner for inner in path.glob(names) if inner.is_dir()) for names in ("*", "*/*"))
    for inner in chain.from_iterable(folders[:_MOST_TRIED] for folders in within):
        with suppress(SourceError):  # of a file in it that cannot be read
            if format_of(inner):
                return f"; {inner.relative_to(path)} in it is one"
    recordings = sorted(one.name for one in path.glob("*") if one.suffix.lower() in _RECORDINGS)
    if recordings:
        return f"; open one of {listed(recordings)}"
    for names in ("*/*", "*/*/*", "*/*/*/*"):
        files = islice(path.glob(names), _MOST_LOOKED_AT)
        images = sorted(
            {f"{one.parent.relative_to(path)}/" for one in files if one.suffix.lower() in _IMAGES}
        )
        if images:
            return (
                f"; it has images in {listed(images)} and no depth, as in depth/; stereo pairs are read as "
                "EuRoC and KITTI keep them, with their calibration"
            )
    return ""
