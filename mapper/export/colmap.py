"""A run's images, poses and cloud as COLMAP's text model and as nerfstudio's ``transforms.json``."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapper.core.errors import FrameError, RunError
from mapper.core.frames import NO_DISTORTION, Cloud, PinholeCamera, RgbdFrame
from mapper.core.geometry import Transform, inverse
from mapper.core.rotations import quaternion_from_rotation
from mapper.core.timebase import seconds_text_from_ns
from mapper.export.export_folders import export_folder
from mapper.export.mesh_files import write_ply
from mapper.mapping.cloud import thinned_to_view
from mapper.run.folder import Run
from mapper.runtime.atomic import write_bytes, write_json, write_text
from mapper.runtime.progress import Progress
from mapper.sources.base import FrameRef
from mapper.sources.image_files.decoded import encode_colour
from mapper.sources.image_files.reading import image_bytes

_POINTS = "points.ply"
_FILES = ("images", "sparse", "transforms.json", _POINTS)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """An image that has been written.

    Attributes:
        name: Name of its file.
        camera: Its camera, distortion included.
        T_world_camera: (4, 4) pose of the camera.
    """

    name: str
    camera: PinholeCamera
    T_world_camera: Transform


def colmap(run: Run, path: Path, progress: Progress) -> None:
    """Write the folder; it replaces an earlier one.

    Its images are those of every ``cloud.frame_stride``-th tracked frame, copied byte for byte where the log
    has image files.

    Raises:
        RunError: PATH holds something else, or the log has moved, has changed or has no images.
    """
    T_world_body = dict(run.tracked_trajectory[:: run.config.cloud.frame_stride].items())
    cloud, log = run.cloud, run.open_log()
    if log.sensor != "rgbd":
        raise RunError(f"{log.path}: COLMAP's models are of images, and this log has scans; export --as las")
    views: list[View] = []
    with export_folder(run, path, "colmap", files=_FILES) as folder:
        with progress.stage("images") as report:
            for done, entry in enumerate(log.entries_of(T_world_body), start=1):
                report(done, len(T_world_body))
                try:
                    views.append(_write_view(folder / "images", entry, T_world_body[entry.stamp_ns]))
                except FrameError as error:
                    progress.note(f"left out: {error}")
        if not views:
            raise RunError(f"{log.path}: none of the {len(T_world_body)} images can be read any more")
        points_world, colors = thinned_to_view(cloud.points, cloud.colors)
        write_ply(folder / _POINTS, points_world, colors)
        write_json(folder / "transforms.json", transforms_of(views))
        write_model(folder / "sparse" / "0", views, Cloud(points_world, colors))


def _write_view(folder: Path, entry: FrameRef, T_world_body: Transform) -> View:
    frame, files = entry.load(), entry.files
    if not isinstance(frame, RgbdFrame):
        raise FrameError(f"frame {entry.stamp_ns}: a scan among images")
    camera, ending = frame.camera, ".png" if files is None else files.colour.suffix
    if files is not None and files.colour_px is not None:
        camera = camera.resized(*files.colour_px)
    name = f"{seconds_text_from_ns(entry.stamp_ns)}{ending}"
    write_bytes(folder / name, encode_colour(frame.image) if files is None else image_bytes(files.colour))
    return View(name, camera, T_world_body @ frame.T_body_camera)


def transforms_of(views: Sequence[View]) -> dict[str, Any]:
    """Return the tree of ``transforms.json``: poses whose y is up and whose z points back, as OpenGL has it.

    The intrinsics are those of all frames, or of each if they differ.
    """
    is_one = len({view.camera for view in views}) == 1
    frames = [
        {
            "file_path": f"images/{view.name}",
            "transform_matrix": (view.T_world_camera * [1.0, -1.0, -1.0, 1.0]).tolist(),
            **({} if is_one else _intrinsics(view.camera)),
        }
        for view in views
    ]
    shared = _intrinsics(views[0].camera) if is_one else {}
    return {"camera_model": "OPENCV", **shared, "ply_file_path": _POINTS, "frames": frames}


def _intrinsics(camera: PinholeCamera) -> dict[str, float]:
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = (*_corner_intrinsics(camera), *camera.distortion)
    return {"w": camera.width_px, "h": camera.height_px, **dict(zip(names, values, strict=True))}


def write_model(folder: Path, views: Sequence[View], cloud: Cloud) -> None:
    """Write ``cameras.txt``, ``images.txt`` and ``points3D.txt``; no image has features, no point a track."""
    cameras = {
        camera: number for number, camera in enumerate(dict.fromkeys(v.camera for v in views), start=1)
    }
    write_text(folder / "cameras.txt", _lines((number, _camera_text(c)) for c, number in cameras.items()))
    rows: list[tuple[object, ...]] = []
    for number, view in enumerate(views, start=1):
        T_camera_world = inverse(view.T_world_camera)
        x, y, z, w = quaternion_from_rotation(T_camera_world[:3, :3]).tolist()
        pose = (w, x, y, z, *T_camera_world[:3, 3].tolist())
        rows += [(number, *pose, cameras[view.camera], view.name), ()]  # an empty line: no features
    write_text(folder / "images.txt", _lines(rows))
    points = zip(cloud.points, cloud.colors, strict=True)
    write_text(
        folder / "points3D.txt",
        _lines((number, *xyz, *rgb, 0) for number, (xyz, rgb) in enumerate(points, start=1)),
    )


def _camera_text(camera: PinholeCamera) -> str:
    model = "PINHOLE" if camera.distortion == NO_DISTORTION else "FULL_OPENCV"
    distortion = () if model == "PINHOLE" else (*camera.distortion, 0.0, 0.0, 0.0)
    numbers = (camera.width_px, camera.height_px, *_corner_intrinsics(camera), *distortion)
    return " ".join([model, *map(str, numbers)])


def _corner_intrinsics(camera: PinholeCamera) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in pixels from the image's corner, not from the first pixel's centre."""
    return camera.fx_px, camera.fy_px, camera.cx_px + 0.5, camera.cy_px + 0.5


def _lines(rows: Iterable[Sequence[object]]) -> str:
    return "".join(" ".join(map(str, row)) + "\n" for row in rows)
