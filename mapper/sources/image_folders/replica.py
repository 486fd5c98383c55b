"""Replica as rendered for iMAP and NICE-SLAM: results/frame*.jpg and depth*.png, traj.txt, cam_params.json.

A line of ``traj.txt`` is a frame's 4×4 pose; ``cam_params.json`` lies there, or beside the scenes' folders.
"""

from pathlib import Path

from mapper.core.errors import SourceError
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders.numbered import NumberedPair, stamped
from mapper.sources.image_folders.posed import PosedFrames
from mapper.sources.image_folders.rgbd import find_calibration
from mapper.sources.text import parse_count, parse_numbers, pose_from_matrix, rows

FILES = ("results/frame*", "results/depth*.png", "traj.txt")
_PARAMETERS = "cam_params.json"
_UNITS_PER_M = 6553.5


def read_frames(folder: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames of a scene.

    Raises:
        SourceError: A pose is malformed, or the camera is unknown.
    """
    colours = sorted((folder / "results").glob("frame*"))
    images = [
        NumberedPair(
            parse_count(colour.stem.removeprefix("frame"), where=f"{colour}"),
            colour,
            colour.with_name(f"depth{colour.stem.removeprefix('frame')}.png"),
            None,
        )
        for colour in colours
    ]
    path = folder / "traj.txt"
    poses = []
    for number, words in rows(path):
        if len(words) != 16:
            raise SourceError(f"{path}:{number}: {len(words)} numbers, want 16: the rows of a 4×4 pose")
        poses.append(pose_from_matrix(parse_numbers(words, where=f"{path}:{number}").reshape(4, 4)))
    pairs, notes = stamped(images, rate_hz=config.rate_hz)
    if images and images[-1].number >= len(poses):
        notes.append(f"{path.name}: {len(poses)} poses; frames from number {len(poses)} on have none")
    of_images = [poses[image.number] if image.number < len(poses) else None for image in images]
    parent = folder.resolve().parent
    is_beside = not (folder / _PARAMETERS).is_file() and (parent / _PARAMETERS).is_file()
    camera = find_calibration(parent if is_beside else folder, config.camera, known=None)
    return PosedFrames(pairs, of_images, camera, _UNITS_PER_M, notes)
