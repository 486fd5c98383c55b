"""The files of a run folder: what each is called, what it holds, and which step writes it."""

from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Literal

from mapper.runtime.atomic import MANIFEST_NAME, FolderKind

TRAJECTORY = "trajectory.tum"
KEYFRAMES = "keyframes.tum"
BASE = "base.tum"
POSES = "poses.csv"
TRUTH = "truth.tum"
ODOMETRY = "odometry.tum"
KITTI = "trajectory.kitti"
GRAPH = "graph.g2o"
FIXES = "gnss.csv"
LOOPS = "loops.jsonl"
PLACES = "places.bin"
FRAMES = "frames.csv"
FRAME_MS = "frame_ms.csv"
OCTREE_BT = "map.bt"
OCTREE_OT = "map.ot"
OCTREE_MAP = "map.octree"
SLICE = "slice"
TRAVERSABLE = "traversable"
KEEPOUT = "keepout"
CLOUD = "cloud.ply"
CLOUD_VIEWS = "cloud.png"
DYNAMIC = "dynamic.ply"
MCAP = "run.mcap"
SUMMARY = "summary.png"
SCAN_UPDATES = "scan_updates.bin"
EDITS = "edits.toml"
CONFIG = "config.json"
MANIFEST = MANIFEST_NAME
MESH = "mesh.ply"
VOXELS = "voxels.ply"
VOXEL_MESH = "voxel_mesh.ply"
CLOUD_LAZ = "cloud.laz"
CLOUD_PCD = "cloud.pcd"
CLOUD_E57 = "cloud.e57"
COSTMAP = "costmap"
FOXGLOVE_LAYOUT = "foxglove_layout.json"
PLAN = "plan.json"
PLAN_VIEW = "plan.png"
RERUN = "run.rrd"


@dataclass(frozen=True, slots=True)
class RunFiles:
    """Files of a run that are written together.

    Attributes:
        names: Names of the files.
        content: Their content, as docs/formats.md describes it.
        depends_on: "tracking": written once the log is tracked and its graph is solved; "maps": written by
            every fuse; "poses" and "exported maps": written on request, and outdated when the poses, or the
            maps, are made again; "user": a user's own work, which may change at any time.
    """

    names: tuple[str, ...]
    content: str
    depends_on: Literal["tracking", "maps", "poses", "exported maps", "user"]


def _grid(stem: str) -> tuple[str, ...]:
    return f"{stem}.pgm", f"{stem}.yaml", f"{stem}.png"


RUN_FILES = (
    RunFiles(
        (TRAJECTORY, KEYFRAMES), "poses of the body in the levelled world: z up, floor at 0", "tracking"
    ),
    RunFiles(
        (BASE,),
        "poses of the robot's base (`base_link`), if the recording's tf says where the sensor is on it",
        "tracking",
    ),
    RunFiles(
        (POSES,),
        "the poses of `trajectory.tum` with outcome and covariance: upper triangle, in the body's tangent "
        "(rotation, translation), the first node fixed",
        "tracking",
    ),
    RunFiles((TRUTH,), "the log's own truth, in its own frame, if there is any", "tracking"),
    RunFiles((ODOMETRY,), "the poses of a caller's own odometry, if the build was given one", "tracking"),
    RunFiles((GRAPH,), "the pose graph at its solution", "tracking"),
    RunFiles(
        (FIXES,),
        "the GNSS fixes that correct the path: position, antenna in its node, information along the map's "
        "axes, and weight",
        "tracking",
    ),
    RunFiles(
        (LOOPS,),
        "every loop candidate: who proposed it, what was measured, its verdict and why, its weight",
        "tracking",
    ),
    RunFiles((OCTREE_BT, OCTREE_OT), "the octree, as OctoMap's C++ library reads it", "maps"),
    RunFiles(
        (OCTREE_MAP,),
        "the octree with all its data, compressed: `mapper.octree.map.read_octree`",
        "maps",
    ),
    RunFiles(_grid(SLICE), "the 2D map for ROS map_server and nav2, and a picture of it", "maps"),
    RunFiles(
        _grid(TRAVERSABLE),
        "the floor that a robot can drive on, in the same form; where floors lie above each other, the one"
        " on which the log begins, and `traversable_0.pgm` and so on, from below, for each",
        "maps",
    ),
    RunFiles(
        _grid(KEEPOUT),
        "the keep-out regions over the slice's cells, in the same form, if `edits.toml` has any: occupied "
        "where a robot is kept out, otherwise free",
        "maps",
    ),
    RunFiles((CLOUD, CLOUD_VIEWS), "the coloured cloud, and two views of it", "maps"),
    RunFiles((DYNAMIC,), "the coloured points of what moved, which are in no map", "maps"),
    RunFiles((MCAP,), "all of it over time, for Foxglove and Rerun", "maps"),
    RunFiles((RERUN,), "the same arranged for Rerun, written by `mapper view`", "exported maps"),
    RunFiles((SUMMARY,), "the trajectory over the slice, with the truth", "maps"),
    RunFiles(
        (SCAN_UPDATES,),
        "the voxels that each frame updated, so that fusing again along new poses reads only frames that "
        "moved",
        "maps",
    ),
    RunFiles(
        (PLACES,),
        "the features or points by which keyframes are recognised: `mapper localise` and `--place auto` need "
        "no log",
        "tracking",
    ),
    RunFiles(
        (FRAMES, FRAME_MS),
        "the outcome of every frame, its doubts and standard deviations, and how long it took",
        "tracking",
    ),
    RunFiles(
        (EDITS,),
        "regions of the map that `mapper edit` or you erased, kept or blocked; every fuse applies them again",
        "user",
    ),
    RunFiles((CONFIG,), "every setting as it was used; `mapper build --config` accepts it", "maps"),
    RunFiles(
        (MANIFEST,),
        "the verdict and all warnings, versions, the input's fingerprint, counts, seconds, memory, how the "
        "run ended, and size and SHA-256 of every other file",
        "maps",
    ),
    RunFiles((KITTI,), "the trajectory as KITTI text, written by `mapper export --as kitti`", "poses"),
    RunFiles((MESH,), "a coloured surface, written by `mapper export --as mesh`", "poses"),
    RunFiles((VOXELS, VOXEL_MESH), "the octree's occupied voxels as points and as cubes", "exported maps"),
    RunFiles(
        (CLOUD_LAZ, CLOUD_PCD, CLOUD_E57), "the coloured cloud for surveys, and for PCL", "exported maps"
    ),
    RunFiles(_grid(COSTMAP), "the slice inflated for nav2", "exported maps"),
    RunFiles((FOXGLOVE_LAYOUT,), "a layout of `run.mcap` for Foxglove", "exported maps"),
    RunFiles((PLAN, PLAN_VIEW), "the last path that `mapper plan` found", "exported maps"),
)


MOST_STOREYS = 32


def storey(number: int) -> str:
    """Return the stem of the traversable floor of a storey; the lowest is 0."""
    return f"{TRAVERSABLE}_{number}"


_STOREY_FILES = frozenset(name for number in range(MOST_STOREYS) for name in _grid(storey(number)))

RUN = FolderKind(
    "a run folder",
    manifest_keys=frozenset({"status", "mapper_version", "input"}),
    files=frozenset(name for files in RUN_FILES for name in files.names if files.depends_on != "user")
    | _STOREY_FILES,
)
LOCALISED_LOG = FolderKind(
    "a localised log",
    manifest_keys=frozenset({"status", "mapper_version", "input", "map"}),
    files=frozenset({TRAJECTORY, POSES, TRUTH, LOOPS, FRAMES, FRAME_MS, SUMMARY, CONFIG}),
    kind="localised log",
)


def names_of(*depends_on: str) -> frozenset[str]:
    """Return the names of all files that depend on any of these."""
    names = frozenset(name for files in RUN_FILES if files.depends_on in depends_on for name in files.names)
    return names | _STOREY_FILES if "maps" in depends_on else names


DISPENSABLE = names_of("poses", "exported maps") | {SCAN_UPDATES, PLACES}
"""Files that a user may delete: a run is whole without them."""


CHECKPOINTS = ".checkpoints.part"
"""Folder of an unfinished build's checkpoints; a temporary one by its name, which a kill at the very end of a
build leaves in the run."""

EDITABLE = frozenset(
    f"{stem}{ending}"
    for stem in (SLICE, TRAVERSABLE, *map(storey, range(MOST_STOREYS)))
    for ending in (".pgm", ".yaml")
)
"""Files that a user may edit by hand: maps for map_server and nav2."""

_REMEDIES = {
    SCAN_UPDATES: "delete it, and mapper fuse RUN casts every frame afresh",
    CONFIG: "restore it, or build again; settings are changed with mapper fuse RUN --set",
    KITTI: "make it again with mapper export RUN --as kitti",
    MESH: "make it again with mapper export RUN --as mesh",
    VOXELS: "make it again with mapper export RUN --as voxels",
    VOXEL_MESH: "make it again with mapper export RUN --as voxel-mesh",
    CLOUD_LAZ: "make it again with mapper export RUN --as las",
    CLOUD_PCD: "make it again with mapper export RUN --as pcd",
    CLOUD_E57: "make it again with mapper export RUN --as e57",
    FOXGLOVE_LAYOUT: "make it again with mapper export RUN --as foxglove-layout",
    RERUN: "make it again with mapper view RUN",
    **dict.fromkeys(_grid(COSTMAP), "make it again with mapper export RUN --as costmap"),
    **dict.fromkeys((PLAN, PLAN_VIEW), "make it again with mapper plan RUN"),
    **dict.fromkeys(names_of("tracking"), "only mapper build makes it again; restore it, or build again"),
}


def remedy_for(name: str, folder: Path) -> str:
    """Return how a user gets a file of a run back, or keeps it as it is, for messages."""
    remedy = _REMEDIES.get(name, "make it again with mapper fuse RUN")
    if name in EDITABLE:
        remedy = f"{remedy}; if you edited it, mapper doctor RUN --accept {name}"
    return remedy.replace("RUN", quote(str(folder)))
