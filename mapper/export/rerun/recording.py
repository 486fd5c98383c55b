"""Rerun recordings: the entities of a run, by name, and the archetype of each.

==========================  =======================  ====================================================
entity                      archetype                what it is
==========================  =======================  ====================================================
/world/body                 Transform3D              pose of every frame; /world/live/body while building
/world/body/camera          Pinhole, EncodedImage    images, and where they were taken
/…/camera/features          Points2D                 while building: features, and which hold the pose
/…/camera/matches           LineStrips2D             from where these were before
/world/path/NAME            LineStrips3D             a trajectory: estimate, truth
/world/graph/nodes          Points3D                 the solved keyframes
/world/graph/ORIGIN         LineStrips3D             factors by origin
/world/loops/VERDICT        LineStrips3D             loop candidates, accepted or rejected
/world/map/voxels           VoxelGridMap             occupied voxels by height
/world/map/cloud            Points3D                 coloured cloud
/world/map/NAME             GridMap                  slice and traversable floor, at z = 0
/slice                      Image                    the slice as a plan, y up; cells are pixels
/slice/NAME                 LineStrips2D             trajectories over it
/diagnostics/NAME           Scalars                  features, matches, inliers, residual, ms of each frame
/log/loops                  TextLog                  loop candidates with their verdicts
/about                      TextDocument             the run in words
==========================  =======================  ====================================================

All that changes has its place on one timeline, "stamp", the log's own clock in exact nanoseconds; what
belongs to the whole log is static. Two recordings of a run hold the same data, but not the same bytes: Rerun
numbers rows and chunks by time and chance, and writes chunks in the order in which its threads have them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Array, Transform
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory
from mapper.export.figures import ACCEPTED, ESTIMATE, FACTORS, REJECTED, TRUTH, Rgb
from mapper.export.grid import grid_image
from mapper.export.rerun.target import streaming
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure, Verdict
from mapper.mapping.cloud import height_colors
from mapper.mapping.map_building import Snapshot
from mapper.octree.grid import OccupancyGrid
from mapper.octree.keys import KEY_ZERO
from mapper.octree.map import OctreeMap
from mapper.run.frame_records import FrameRecord, stamps_of

_DIRECTION = np.array([-0.6, -1.0, 0.9])  # from what is looked at to the eye
_DISTANCE = 0.85  # in diagonals of what is looked at


def blueprint_for(looking_at: Array | None, camera: str | None) -> rrb.Blueprint:
    """Return the map at the left, the images, the plan and the curves at the right.

    Args:
        looking_at: (2, 3) lower and upper corner of what the 3D views look at first, metres.
        camera: The entity whose images are shown; None leaves no room for images.
    """
    eye = None if looking_at is None else _eye(looking_at)
    everything = ["+ /world/**", "- /world/map/traversable"]
    maps = rrb.Tabs(
        rrb.Spatial3DView(
            name="voxels", origin="/world", contents=[*everything, "- /world/map/cloud"], eye_controls=eye
        ),
        rrb.Spatial3DView(
            name="cloud",
            origin="/world",
            contents=[*everything, "- /world/map/voxels", "- /world/map/slice"],
            eye_controls=eye,
        ),
    )
    images = [] if camera is None else [rrb.Spatial2DView(name="camera", origin=camera)]
    right = rrb.Vertical(
        *images,
        rrb.Tabs(
            rrb.Spatial2DView(name="slice", origin="/slice"),
            rrb.TextDocumentView(name="about", origin="/about"),
            rrb.TextLogView(name="loops", origin="/log"),
        ),
        rrb.TimeSeriesView(
            name="features",
            origin="/diagnostics",
            contents=["+ $origin/features", "+ $origin/matches", "+ $origin/inliers"],
        ),
        rrb.Tabs(
            rrb.TimeSeriesView(name="ms per frame", origin="/diagnostics/ms"),
            rrb.TimeSeriesView(name="residual", origin="/diagnostics/residual"),
        ),
        row_shares=[*(3 for _ in images), 3, 2, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(maps, right, column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="stamp"),
        auto_views=False,
    )


def _eye(corners: Array) -> rrb.EyeControls3D:
    low, high = corners
    centre = (low + high) / 2.0
    distance_m = _DISTANCE * float(np.linalg.norm(high - low))
    return rrb.EyeControls3D(
        position=centre + distance_m * _DIRECTION / np.linalg.norm(_DIRECTION),
        look_target=centre,
        eye_up=[0.0, 0.0, 1.0],
    )


APPLICATION = "mapper"
BODY = "world/body"
TIMELINE = "stamp"
_PATHS: dict[str, Rgb] = {"estimate": ESTIMATE, "truth": TRUTH}
_VERDICTS: dict[Verdict, Rgb] = {"accepted": ACCEPTED, "rejected": REJECTED}
_SERIES: dict[str, Rgb] = {
    "features": (140, 146, 158),
    "matches": (45, 108, 178),
    "inliers": (38, 145, 87),
    "residual": (124, 58, 196),
    "ms": (214, 69, 37),
}
LINE_PX = rr.Radius.ui_points(1.5)
THIN_PX = rr.Radius.ui_points(0.7)


class RerunLog:
    """One open recording; made by :func:`recorded`.

    Attributes:
        body: The entity that moves with the body.
        camera: The entity that takes the images.
        keeps: Whether its file is to be kept when an error ends the block.
    """

    def __init__(self, stream: rr.RecordingStream, body: str, *, has_images: bool) -> None:
        self._stream = stream
        self.body, self.camera = body, f"{body}/camera"
        self._has_images = has_images
        self.keeps = False
        self.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self.log(body, rr.TransformAxes3D(0.2))
        for name, color in _SERIES.items():
            self.log(f"diagnostics/{name}", rr.SeriesLines(names=name, colors=[color]))

    def log(self, entity: str, what: Any, *, stamp_ns: int | None = None) -> None:
        """Log something at a stamp, or for the whole recording."""
        if stamp_ns is not None:
            self._stream.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
        self._stream.log(entity, what, static=stamp_ns is None, strict=True)

    def poses(self, trajectory: Trajectory) -> None:
        """Log where the body was at every stamp."""
        self._columns(
            self.body,
            trajectory.stamps_ns,
            rr.Transform3D.columns(
                translation=trajectory.positions_world, mat3x3=trajectory.T_world_body[:, :3, :3]
            ),
        )

    def images(self, snapshots: Sequence[Snapshot]) -> None:
        """Log images with the camera that took them, which sits still on the body."""
        if not snapshots:
            return
        self.mount(snapshots[0].camera, snapshots[0].T_body_camera)
        blobs = [np.frombuffer(snapshot.jpeg, np.uint8) for snapshot in snapshots]
        self._columns(
            self.camera,
            np.array([snapshot.stamp_ns for snapshot in snapshots]),
            rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs)),
        )

    def mount(self, camera: PinholeCamera, T_body_camera: Transform) -> None:
        """Log a camera and its pose on the body; Rerun has no lens distortion."""
        self.log(self.camera, transform_of(T_body_camera))
        self.log(
            self.camera,
            rr.Pinhole(
                image_from_camera=camera.matrix,
                resolution=[camera.width_px, camera.height_px],
                image_plane_distance=0.3,
            ),
        )

    def path(self, name: str, trajectory: Trajectory) -> None:
        """Log a whole trajectory, "estimate" or "truth"."""
        strip = trajectory.positions_world.astype(np.float32)
        self.log(f"world/path/{name}", rr.LineStrips3D([strip], colors=[_PATHS[name]], radii=LINE_PX))

    def graph(self, graph: PoseGraph) -> None:
        """Log the nodes, and the factors that are no loops, as lines by origin."""
        positions = {node: T[:3, 3] for node, T in graph.T_world_node.items()}
        self.log(
            "world/graph/nodes",
            rr.Points3D(np.array(list(positions.values())), colors=[ESTIMATE], radii=LINE_PX),
        )
        for origin, color in FACTORS.items():
            ends = [(positions[f.i], positions[f.j]) for f in graph.factors if f.origin == origin]
            if ends and origin != "loop":
                self.log(
                    f"world/graph/{origin}", rr.LineStrips3D(np.array(ends), colors=[color], radii=THIN_PX)
                )

    def loops(self, loops: Iterable[LoopClosure], T_world_node: Mapping[int, Transform]) -> None:
        """Log loop candidates as lines between their nodes, and in words where they were found."""
        loops = [loop for loop in loops if loop.i in T_world_node and loop.j in T_world_node]
        for verdict, color in _VERDICTS.items():
            ends = [
                (T_world_node[loop.i][:3, 3], T_world_node[loop.j][:3, 3])
                for loop in loops
                if loop.verdict == verdict
            ]
            if ends:
                self.log(
                    f"world/loops/{verdict}", rr.LineStrips3D(np.array(ends), colors=[color], radii=LINE_PX)
                )
        if loops:
            self._columns(
                "log/loops",
                np.array([loop.stamp_j_ns for loop in loops]),
                rr.TextLog.columns(
                    text=[_loop_text(loop) for loop in loops],
                    level=["INFO" if loop.verdict == "accepted" else "DEBUG" for loop in loops],
                ),
            )

    def voxels(self, octree: OctreeMap) -> None:
        """Log the occupied voxels, coloured by height."""
        leaves = octree.leaves()
        occupied = leaves.log_odds >= octree.occupied_log_odds
        if occupied.any():
            colors = height_colors(leaves.centres_world[occupied, 2])
            indices = leaves.keys[occupied].astype(np.int32) - KEY_ZERO
            self.log("world/map/voxels", rr.VoxelGridMap(indices, [leaves.edge_m] * 3, colors=colors))

    def cloud(self, points_world: NDArray[np.floating], colors: NDArray[np.uint8]) -> None:
        """Log (N, 3) points in metres with (N, 3) RGB bytes."""
        self.log("world/map/cloud", rr.Points3D(points_world, colors=colors, radii=rr.Radius.ui_points(1.2)))

    def grid(self, name: str, grid: OccupancyGrid) -> None:
        """Log a 2D grid in the world's z = 0 plane."""
        height, width = grid.cells.shape
        self.log(
            f"world/map/{name}",
            rr.GridMap(
                data=grid.cells[::-1].tobytes(),
                format=rr.components.ImageFormat(
                    width=width, height=height, color_model="L", channel_datatype="U8"
                ),
                cell_size=grid.resolution_m,
                translation=[*grid.origin_world_m, 0.0],
                colormap=rr.components.Colormap.RvizMap,
            ),
        )

    def plan(self, grid: OccupancyGrid, paths: Mapping[str, Trajectory]) -> None:
        """Log the slice as an image seen from above, with trajectories over it."""
        self.log("slice", rr.Image(np.ascontiguousarray(grid_image(grid)[::-1])))
        height = grid.cells.shape[0]
        for name, trajectory in paths.items():
            cells = (trajectory.positions_world[:, :2] - grid.origin_world_m) / grid.resolution_m
            strip = np.column_stack([cells[:, 0], height - cells[:, 1]])
            self.log(f"slice/{name}", rr.LineStrips2D([strip], colors=[_PATHS[name]], radii=LINE_PX))

    def diagnostics(self, records: Sequence[FrameRecord]) -> None:
        """Log how every frame went, as curves."""
        if not records:
            return
        stamps_ns = stamps_of(records)
        for name in ("features", "matches", "inliers", "residual"):
            values = np.array([getattr(record.diagnostics, name) for record in records], np.float64)
            self._columns(f"diagnostics/{name}", stamps_ns, rr.Scalars.columns(scalars=values))

    def times(self, frame_ms: Mapping[int, float]) -> None:
        """Log how many milliseconds each frame took, by stamp, as a curve."""
        if frame_ms:
            values = np.array(list(frame_ms.values()))
            self._columns("diagnostics/ms", np.array(list(frame_ms)), rr.Scalars.columns(scalars=values))

    def blueprint(self, looking_at: Array | None) -> rrb.Blueprint:
        """Return how the viewer is to arrange this recording."""
        return blueprint_for(looking_at, self.camera if self._has_images else None)

    def look_at(self, corners: Array) -> None:
        """Arrange the viewer anew, looking at the box between two (2, 3) corners, metres."""
        self._stream.send_blueprint(self.blueprint(corners))

    def about(self, markdown: str) -> None:
        """Log the run in words."""
        self.log("about", rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def _columns(self, entity: str, stamps_ns: Stamps, columns: Any) -> None:
        index = rr.TimeColumn(TIMELINE, timestamp=np.asarray(stamps_ns).astype("datetime64[ns]"))
        self._stream.send_columns(entity, [index], columns, strict=True)


@contextmanager
def recorded(
    target: str,
    *,
    name: str,
    has_images: bool,
    body: str = BODY,
    looking_at: Array | None = None,
) -> Iterator[RerunLog]:
    """Yield a recording that goes to a target, see :func:`mapper.export.rerun.target.streaming`.

    Args:
        target: FILE.rrd, "spawn", "connect" or "connect:URL".
        name: Name in the viewer.
        has_images: Leave room for images.
        body: The entity that is to move with the body.
        looking_at: (2, 3) lower and upper corner of what to look at first, metres; None leaves it to Rerun.
    """
    stream = new_recording()
    log = RerunLog(stream, body, has_images=has_images)
    with streaming(stream, target, log.blueprint(looking_at), keeps=lambda: log.keeps):
        stream.send_recording_name(name)
        yield log


def new_recording() -> rr.RecordingStream:
    """Return a recording whose only timeline is the log's clock."""
    recording = rr.RecordingStream(APPLICATION)
    recording.set_log_time_enabled(False)
    return recording


def transform_of(T_parent_child: Transform) -> rr.Transform3D:
    """Return a pose as Rerun has it."""
    return rr.Transform3D(translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3])


def _loop_text(loop: LoopClosure) -> str:
    why = f": {loop.reason}" if loop.reason else ""
    return f"{loop.i} → {loop.j} ({loop.proposed_by}, {loop.inliers} inliers) {loop.verdict}{why}"
