"""What every RGB-D log made of image files shares: its frames, its camera and its accelerometer."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, PinholeCamera, RgbdFrame, Scan, Sensor
from mapper.core.trajectory import Trajectory
from mapper.sources.base import Accelerations, FrameRef, ImageFiles
from mapper.sources.calibration import Calibration
from mapper.sources.calibration_file import FILE_NAMES, read_calibration
from mapper.sources.config import CameraConfig
from mapper.sources.images import check_size, read_colour, read_depth_m, read_grey, scan_of
from mapper.sources.text import parse_numbers, parse_stamp, rows, time_order


@dataclass(frozen=True, slots=True)
class RgbdEntry:
    """One colour and depth image on disk; the body is the camera."""

    stamp_ns: int
    files: ImageFiles
    camera: PinholeCamera

    def load(self, *, colour: bool = True) -> RgbdFrame:
        """Read and decode both images.

        Raises:
            FrameError: A file is missing, damaged, of the wrong kind or of another size than the camera's.
        """
        image = read_colour(self.files.colour) if colour else read_grey(self.files.colour)
        check_size(image.shape, self.camera, f"{self.files.colour}")
        return RgbdFrame(self.stamp_ns, image, self._depth_m(), self.camera)

    def scan(self) -> Scan:
        """Read and decode the depth image alone.

        Raises:
            FrameError: As ``load``.
        """
        return scan_of(self._depth_m(), self.camera, stamp_ns=self.stamp_ns)

    def _depth_m(self) -> DepthImage:
        depth_m = read_depth_m(self.files.depth, self.files.depth_units_per_m)
        check_size(depth_m.shape, self.camera, f"{self.files.depth}")
        return depth_m


@dataclass(slots=True, eq=False)
class RgbdLog:
    """A log whose frames are pairs of image files; see :class:`mapper.sources.base.FrameSource`."""

    path: Path
    name: str
    kind: str
    truth: Trajectory | None
    accelerations: Accelerations | None
    notes: Sequence[str]
    images: Sequence[RgbdEntry]
    sensor: Sensor = "rgbd"
    wheels: Trajectory | None = None

    def __len__(self) -> int:
        return len(self.images)

    def entries(self) -> Iterator[FrameRef]:
        """Yield every frame's entry in time order."""
        yield from self.images


def find_calibration(
    folder: Path, config: CameraConfig | None, *, known: Calibration | None, depth_units_per_m: float
) -> tuple[Calibration, float]:
    """Return a log's intrinsics and depth units: the user's, else a file's, else the known camera's.

    Args:
        folder: Where a file of ``FILE_NAMES`` may lie.
        config: What the user set.
        known: The camera that the log's format or name implies.
        depth_units_per_m: The format's own depth image units per metre, where nothing else states them.

    Raises:
        SourceError: None of the three exists, or the file is malformed.
    """
    path = next((folder / name for name in FILE_NAMES if (folder / name).is_file()), None)
    stated = known if path is None else read_calibration(path)
    units_per_m = depth_units_per_m if stated is None else stated.depth_units_per_m or depth_units_per_m
    if config is not None:
        numbers = (config.fx_px, config.fy_px, config.cx_px, config.cy_px)
        set_by_user = Calibration("source.camera", *numbers, distortion=config.distortion)
        return set_by_user, config.depth_factor or units_per_m
    if stated is None:
        raise SourceError(
            f"{folder}: intrinsics unknown; put a calibration.toml with fx_px, fy_px, cx_px and cy_px there, "
            "or --set source.camera.fx_px=… and so on"
        )
    return stated, units_per_m


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame's stamps and files, before the log's camera is known."""

    stamp_ns: int
    colour: Path
    depth_stamp_ns: int
    depth: Path


def entries_of(
    shots: Sequence[Shot], calibration: Calibration, *, depth_units_per_m: float
) -> list[RgbdEntry]:
    """Return the entries of shots, all seen by one camera as large as the first readable colour image.

    Raises:
        SourceError: No colour image can be read, or they are not of the calibration's size.
    """
    camera = _camera_of(shots, calibration)
    return [
        RgbdEntry(
            shot.stamp_ns,
            ImageFiles(shot.colour, shot.depth, shot.depth_stamp_ns, depth_units_per_m),
            camera,
        )
        for shot in shots
    ]


def _camera_of(shots: Sequence[Shot], calibration: Calibration) -> PinholeCamera:
    first_reason = ""
    for shot in shots:
        try:
            height_px, width_px = read_grey(shot.colour).shape
        except FrameError as error:
            first_reason = first_reason or str(error)
        else:
            return calibration.camera(width_px=width_px, height_px=height_px)
    raise SourceError(f"none of {len(shots)} colour images can be read; the first: {first_reason}")


def present(paths: Iterable[Path]) -> list[bool]:
    """Tell which files exist, listing each folder once: a stat per file is slow on network disks."""
    listings: dict[Path, frozenset[str]] = {}
    found = []
    for path in paths:
        if path.parent not in listings:
            listings[path.parent] = _listing(path.parent)
        found.append(path.name in listings[path.parent])
    return found


def _listing(folder: Path) -> frozenset[str]:
    return frozenset(path.name for path in folder.iterdir()) if folder.is_dir() else frozenset()


def read_accelerations(folder: Path) -> tuple[Accelerations | None, list[str]]:
    """Return the readings of ``accelerometer.txt`` (lines of ``stamp ax ay az``), if the folder has one.

    Raises:
        SourceError: A line is not four numbers.
    """
    path = folder / "accelerometer.txt"
    if not path.is_file():
        return None, []
    stamps_ns, readings, dropped = [], [], 0
    for number, words in rows(path):
        where = f"{path}:{number}"
        if len(words) != 4:
            raise SourceError(f"{where}: {len(words)} columns, want 4: stamp ax ay az")
        numbers = parse_numbers(words, where=where)
        if np.isfinite(numbers).all():
            stamps_ns.append(parse_stamp(words[0], where=where))
            readings.append(numbers[1:])
        else:
            dropped += 1
    notes = [f"{path.name}: {dropped} readings are not finite; dropped"] if dropped else []
    if not stamps_ns:
        return None, [*notes, f"{path.name}: no readings"]
    stamps = np.array(stamps_ns, dtype=np.int64)
    order, more = time_order(stamps, what=path.name)
    return Accelerations(stamps[order], np.array(readings)[order]), [*notes, *more]
