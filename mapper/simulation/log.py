"""A synthetic log on disk: a TUM RGB-D folder with exact truth beside it."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from mapper.core.frames import RgbdFrame
from mapper.core.timebase import seconds_text_from_ns
from mapper.runtime.atomic import new_folder
from mapper.runtime.ordered_map import ordered_map
from mapper.simulation.boxes import write_scene
from mapper.simulation.config import SynthConfig, set_or_first
from mapper.simulation.path import seconds_of
from mapper.simulation.source import CameraSimulator
from mapper.sources.calibration_file import calibration_text
from mapper.sources.trajectory_files import write_tum
from mapper.sources.wheel_files import write_wheels

DEPTH_FACTOR = 5000.0
"""Units of a depth image per metre, as TUM writes them (Sturm et al. 2012)."""

# One filter and no search for repeats: noise has none, and it takes a third of the time.
_COLOUR_PNG = (
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_SUB,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)
_DEPTH_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB)
_GOOD_JPG = (cv2.IMWRITE_JPEG_QUALITY, 92)
_WORKERS = 2


def write_tum_log(
    out: Path, config: SynthConfig, *, on_progress: Callable[[int, int], None] | None = None
) -> None:
    """Write a synthetic log as a TUM folder: images, lists, truth, calibration, and the scene itself.

    The folder appears when it is complete; until then it is ``out`` with ``.partial`` behind its name.

    Args:
        out: Folder to make; it must not exist.
        config: Settings of the log.
        on_progress: Called with (frames written, frames in all) after every frame.

    Raises:
        SourceError: ``out`` exists, or cannot be written.
    """
    with new_folder(out) as folder:
        for name in ("rgb", "depth"):
            (folder / name).mkdir()
        _write(folder, CameraSimulator(config), on_progress or (lambda _done, _total: None))


def _write(folder: Path, simulator: CameraSimulator, on_progress: Callable[[int, int], None]) -> None:
    config, log = simulator.config, simulator.log()
    lists = {
        "rgb": ["# color images", "# timestamp filename"],
        "depth": ["# depth maps", "# timestamp filename"],
    }

    def save(index: int) -> str:
        frame = simulator.observe(index)
        name = seconds_text_from_ns(frame.stamp_ns)
        _save_images(folder, name, frame, image_format=config.image_format)
        return name

    for done, name in enumerate(ordered_map(save, simulator.kept.tolist(), workers=_WORKERS), start=1):
        lists["rgb"].append(f"{name} rgb/{name}.{config.image_format}")
        lists["depth"].append(f"{name} depth/{name}.png")
        on_progress(done, len(log))
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_tum(folder / "groundtruth.txt", simulator.truth)
    calibration = calibration_text(simulator.camera, depth_units_per_m=DEPTH_FACTOR)
    (folder / "calibration.toml").write_text(calibration, encoding="utf-8")
    if log.wheels is not None:
        write_wheels(folder, log.wheels, sensor=log.sensor)
    unset = {"wall_distance_m"} if config.path != "wall" else set()
    settings = set_or_first(config, exclude=unset)
    moving = simulator.movers.as_json(seconds_of(simulator.truth.stamps_ns))
    write_scene(folder / "scene.json", simulator.scene.boxes, settings, moving=moving)


def _save_images(folder: Path, name: str, frame: RgbdFrame, *, image_format: str) -> None:
    units = np.rint(frame.depth_m * np.float32(DEPTH_FACTOR))
    units[units > np.iinfo(np.uint16).max] = 0.0  # deeper than 13.1 m does not fit: no measurement
    bgr = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
    options = _COLOUR_PNG if image_format == "png" else _GOOD_JPG
    for path, image, flags in (
        (folder / "rgb" / f"{name}.{image_format}", bgr, options),
        (folder / "depth" / f"{name}.png", units.astype(np.uint16), _DEPTH_PNG),
    ):
        _, encoded = cv2.imencode(path.suffix, image, flags)
        path.write_bytes(encoded.tobytes())
