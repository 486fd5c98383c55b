"""Exports of a run: the kinds of file, and the function that writes any of them."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mapper.core.errors import ConfigError, RunError
from mapper.run import files
from mapper.runtime.atomic import atomic_file, refuse_existing
from mapper.runtime.progress import SILENT, Progress

if TYPE_CHECKING:
    from mapper.config.build import BuildConfig
    from mapper.run.folder import Run
    from mapper.run.map_folder import MapFolder

Frame = Literal["map", "start", "base"]
"""Frame of an export: the levelled world, or the body or the robot's base at its first pose."""
Write = Callable[[Any, Path, Progress], None]
"""Writes one file of a ``Run``, or of any ``MapFolder``, atomically; long jobs report progress."""


@dataclass(frozen=True, slots=True)
class Exporter:
    """One kind of file.

    Attributes:
        summary: Description of the file, in a few words.
        function: ``module:name`` of the ``Write``, below :mod:`mapper.export`; imported at the first use.
        file_name: Its name inside the run. Empty for a folder, which is never in the run.
        endings: Endings that another name may have.
        sidecars: Endings of the files that are written with it.
        settings: The part of the configuration that it reads, if any.
        is_built: Whether each run has it since the build, so that of a whole one it is copied.
        of_merged: Whether a merged map has it, too.
        crops: Whether it can hold a part of the map.
        moves: Whether it can be in another frame than the levelled world.
    """

    summary: str
    function: str
    file_name: str = ""
    endings: tuple[str, ...] = ()
    sidecars: tuple[str, ...] = ()
    settings: str | None = None
    is_built: bool = False
    of_merged: bool = False
    crops: bool = False
    moves: bool = False

    @property
    def write(self) -> Write:
        """The function that writes it."""
        module, _, name = self.function.partition(":")
        found: Write = getattr(import_module(f"mapper.export.{module}"), name)
        return found


_TRAJECTORIES = ("tum", "kitti")
_MESH_ENDINGS = (".ply", ".obj", ".glb", ".stl")
_GRID = (".yaml", ".yml"), (".pgm", ".png")
_Part = partial(Exporter, crops=True)
_Moved = partial(_Part, moves=True)
_OfAny = partial(_Part, of_merged=True)

EXPORTERS = {
    "octomap": _OfAny(
        "octree for OctoMap and ROS", "exporters:octomap", "map.bt", (".bt", ".ot"), settings="octomap"
    ),
    "native": _Part(
        "octree with all attributes", "exporters:native", "map.octree", (".octree",), is_built=True
    ),
    "ply": _Moved("coloured cloud", "clouds:ply", "cloud.ply", (".ply",), is_built=True),
    "las": _Moved("coloured cloud for surveys and GIS", "clouds:las", "cloud.laz", (".laz", ".las")),
    "pcd": _Moved("coloured cloud for PCL", "clouds:pcd", "cloud.pcd", (".pcd",)),
    "e57": _Moved("coloured cloud for scanners' programs", "clouds:e57", "cloud.e57", (".e57",)),
    "voxels": _Part("occupied voxels' centres", "voxels:centres", "voxels.ply", (".ply",)),
    "voxel-mesh": _Part("occupied voxels as cubes", "voxels:cubes", "voxel_mesh.ply", _MESH_ENDINGS),
    "mesh": _Moved("coloured surface", "mesh:surface", "mesh.ply", _MESH_ENDINGS, settings="mesh"),
    "grid": _OfAny("slice for nav2", "exporters:grid", "slice.yaml", *_GRID),
    "costmap": _OfAny("slice inflated for nav2", "nav2:costmap", "costmap.yaml", *_GRID, settings="costmap"),
    "nav2": _OfAny("folder for nav2: map, masks, parameters", "nav2:nav2", settings="costmap"),
    "autoware": _Moved("folder for Autoware: cloud in tiles", "clouds:autoware"),
    "gis": _OfAny("folder for GIS: 2D maps with world files", "gis:gis"),
    "colmap": _Moved(
        "folder for COLMAP, nerfstudio and splatting: images, poses, points",
        "colmap:colmap",
        settings="cloud",
    ),
    "rosbag2": _Part("folder for ros2 bag play and RViz: paths, maps, images", "rosbag2:rosbag2"),
    "tum": Exporter(
        "trajectory as TUM text",
        "exporters:tum",
        "trajectory.tum",
        (".tum", ".txt"),
        is_built=True,
        moves=True,
    ),
    "kitti": Exporter(
        "trajectory as KITTI text", "exporters:kitti", "trajectory.kitti", (".kitti", ".txt"), moves=True
    ),
    "foxglove-layout": Exporter(
        "how Foxglove is to show run.mcap", "foxglove_layout:layout", "foxglove_layout.json", (".json",)
    ),
    "g2o": Exporter("pose graph", "exporters:g2o", "graph.g2o", (".g2o",), is_built=True, moves=True),
}


def export(
    run: "MapFolder",
    kind: str,
    out: Path | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    frame: Frame = "map",
    poses_of: str | None = None,
    box_m: Sequence[float] | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Path:
    """Write one kind of file and return where it is.

    Args:
        run: A finished run, or a merged map, which has some kinds only.
        kind: A key of ``EXPORTERS``.
        out: The file; None keeps it in the run, under the name that this kind has there.
        settings: Values by dotted name that the kind reads, such as ``{"mesh.voxel_m": 0.01}``.
        frame: Frame of its poses and points.
        poses_of: Of a trajectory whose poses it has: "base", or the name of a frame in the manifest; None is
            the body.
        box_m: Lowest and highest corner of what is written, x y z x y z in the levelled world; None is all.
        overwrite: Replace what is at OUT.
        progress: Receives stages, counts and notes.

    Raises:
        ConfigError: No such kind, a name that does not end like one, settings that the kind does not read, or
            a frame, poses or a box that it cannot have.
        RunError: OUT is there already, or a file of the run is missing.
    """
    if kind not in EXPORTERS:
        near = get_close_matches(kind, EXPORTERS, n=1)
        known = f"did you mean {near[0]}?" if near else f"want one of {', '.join(EXPORTERS)}"
        raise ConfigError(f"no exporter {kind!r}; {known}")
    exporter = EXPORTERS[kind]
    if not exporter.of_merged:
        _refuse_merged(run, kind)
    if settings:
        from mapper.config.loading import overridden

        config = overridden(run.config, settings=settings)
        _refuse_idle_settings(run, config, kind=kind)
        run = run.with_config(config)
    whole, run = run, _part_of(run, kind, out, frame=frame, box_m=box_m, poses_of=poses_of)
    if out is None:
        if not exporter.file_name:
            raise ConfigError(f"{kind}: is a folder beside the run; name it with --out")
        path = run.path / exporter.file_name
    else:
        path = out
        _refuse_out(path, exporter, kind=kind, overwrite=overwrite)
    is_copy = exporter.is_built and run is whole
    with _recording(whole, exporter, path):
        (partial(_copy, name=exporter.file_name) if is_copy else exporter.write)(run, path, progress)
    return path


def _part_of(
    run: "MapFolder",
    kind: str,
    out: Path | None,
    *,
    frame: Frame,
    box_m: Sequence[float] | None,
    poses_of: str | None,
) -> "MapFolder":
    if frame == "map" and box_m is None and poses_of is None:
        return run
    if poses_of is not None and kind not in _TRAJECTORIES:
        raise ConfigError(f"{kind}: has no poses of {poses_of}; {', '.join(_TRAJECTORIES)} have")
    for given, name in ((frame != "map", "moves"), (box_m is not None, "crops")):
        if given and not getattr(EXPORTERS[kind], name):
            kinds = ", ".join(known for known, exporter in EXPORTERS.items() if getattr(exporter, name))
            raise ConfigError(f"{kind}: has no {'frame' if name == 'moves' else 'crop'}; {kinds} have")
    if out is None or out.resolve().parent == run.path.resolve():
        raise ConfigError(f"{kind}: the run keeps what is whole; name a file beside it with --out")
    from mapper.export.part_of_run import part_of

    return part_of(run, frame, box_m, poses_of)


def _refuse_merged(run: "MapFolder", kind: str) -> None:
    from mapper.run.folder import Run

    if not isinstance(run, Run):
        kinds = ", ".join(name for name, exporter in EXPORTERS.items() if exporter.of_merged)
        raise ConfigError(f"{run.path}: a merged map has no {kind}, only {kinds}; export its runs one by one")


@contextmanager
def _recording(run: "MapFolder", exporter: Exporter, path: Path) -> Iterator[None]:
    """Record in the manifest what an export writes into the run; files of the build stay as they are."""
    written = {path.name, *(path.with_suffix(ending).name for ending in exporter.sidecars)}
    names = written & files.names_of("poses", "exported maps")
    inside = path.parent.resolve() == run.path.resolve()
    with run.changing(names) if inside and names else nullcontext():
        yield


def _refuse_idle_settings(run: "MapFolder", config: "BuildConfig", *, kind: str) -> None:
    settings = EXPORTERS[kind].settings
    for name in type(config).model_fields:
        if name != settings and getattr(config, name) != getattr(run.config, name):
            reads = f"reads {settings} settings only" if settings else "has no settings"
            raise ConfigError(f"{name}: export --as {kind} {reads}; to change the maps run mapper fuse")


def _refuse_out(path: Path, exporter: Exporter, *, kind: str, overwrite: bool) -> None:
    if not exporter.file_name:
        refuse_existing(path, overwrite=overwrite)
        return
    if path.suffix.lower() not in exporter.endings:
        raise ConfigError(
            f"{path}: {kind} files end with {' or '.join(exporter.endings)}; choose such a name"
        )
    for file in (path, *(path.with_suffix(ending) for ending in exporter.sidecars)):
        if file.is_dir():
            raise RunError(f"{file}: is a folder; name a file")
        refuse_existing(file, overwrite=overwrite)


def octomap(run: "MapFolder", path: Path, progress: Progress) -> None:
    """Write the octree: free or occupied as ``.bt``, log-odds as ``.ot``; with wider voxels if so configured.

    Raises:
        RunError: Wider voxels are to replace the run's own octree.
    """
    level, full = run.config.octomap.level, path.suffix.lower() == ".ot"
    name = files.OCTREE_OT if full else files.OCTREE_BT
    if level == 0 and getattr(run, "region", None) is None:
        _copy(run, path, progress, name=name)
        return
    if _is_same(run.path / name, path):
        raise RunError(f"{path}: is the run's own octree; name another file to write level {level} to")
    from mapper.octree.octomap_file import write_bt, write_ot

    octree = run.octree.coarser(level, parent=run.config.octomap.parent) if level else run.octree
    (write_ot if full else write_bt)(path, octree)


def native(run: "Run", path: Path, _progress: Progress) -> None:
    """Write a part of the octree with all that it has."""
    run.octree.write(path)


def tum(run: "Run", path: Path, _progress: Progress) -> None:
    """Write the trajectory with its stamps."""
    from mapper.sources.trajectory_files import write_tum

    write_tum(path, run.trajectory)


def kitti(run: "Run", path: Path, _progress: Progress) -> None:
    """Write the trajectory without its stamps, for which KITTI text has no place."""
    from mapper.sources.trajectory_files import write_kitti

    write_kitti(path, run.trajectory)


def g2o(run: "Run", path: Path, _progress: Progress) -> None:
    """Write the pose graph, solved."""
    from mapper.graph.g2o import write_g2o

    write_g2o(path, run.graph)


def grid(run: "MapFolder", path: Path, _progress: Progress) -> None:
    """Write the slice's YAML with PGM and PNG beside it; the YAML names the PGM, so this is no copy."""
    slice_world = run.slice
    if not _is_same(run.path / f"{files.SLICE}.yaml", path):
        from mapper.export.grid import write_grid

        write_grid(path.parent, path.stem, slice_world)


def _copy(run: "MapFolder", path: Path, _progress: Progress, *, name: str) -> None:
    source = run.file(name)
    if not source.is_file():
        raise RunError(f"{source}: is missing from the run; build it again")
    if not _is_same(source, path):
        with atomic_file(path) as part:
            shutil.copyfile(source, part)


def _is_same(source: Path, path: Path) -> bool:
    return path.exists() and source.exists() and source.samefile(path)
