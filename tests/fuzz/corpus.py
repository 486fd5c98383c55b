"""Corpus: a small valid input of every format that is read."""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
from foxglove import messages as fox
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer

from mapper.core.frames import Frame, PinholeCamera, RgbdFrame, Scan
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.export.exporters import EXPORTERS
from mapper.octree.map import OctreeMap
from mapper.octree.map_file import write_map
from mapper.octree.octomap_file import write_bt, write_ot
from mapper.simulation import write_tum_log
from mapper.sources.base import Accelerations, Log
from mapper.sources.ros.typestore import typestore
from mapper.sources.writers import LogKind, write_log
from tests.fuzz.image_logs import IMAGE_LOGS
from tests.fuzz.sensor_logs import SENSOR_LOGS
from tests.support.clouds import save_cloud
from tests.support.depth_cameras import write_unregistered
from tests.support.desk import DESK, build_desk_run
from tests.support.driver_recordings import write_livox
from tests.support.logs import log_in_memory, memory_entry
from tests.support.octree_maps import COLORED, mapped
from tests.support.posed_scans import WRITERS, shots_of
from tests.support.recordings import CAMERA, add_messages, shots, write, write_folder, write_foxglove
from tests.support.tum_logs import FIRST_NS, picture

FRAMES = 4
STAMPS_NS = FIRST_NS + np.arange(FRAMES, dtype=np.int64) * (NS_PER_S // 10)
TINY_DESK = DESK.model_copy(update={"width_px": 160, "height_px": 120, "duration_s": 0.8})

Maker = Callable[[Path], Path]
"""Makes an input in an empty folder, and returns the path to open."""


def sweep(seed: int, n: int = 300) -> np.ndarray:
    """Return (N, 3) float32 points around a sensor."""
    return np.random.default_rng(seed).uniform(-20.0, 20.0, (n, 3)).astype(np.float32)


def truth() -> Trajectory:
    T_world_body = np.tile(np.eye(4), (FRAMES, 1, 1))
    T_world_body[:, 0, 3] = 0.1 * np.arange(FRAMES)
    return Trajectory(STAMPS_NS, T_world_body)


def rgbd_log() -> Log:
    frames: list[Frame] = []
    for seed, stamp_ns in enumerate(STAMPS_NS.tolist()):
        rgb, units = picture(seed)
        frames.append(RgbdFrame(stamp_ns, rgb, units.astype(np.float32) / np.float32(5000.0), CAMERA))
    readings = Accelerations(STAMPS_NS, np.tile([0.0, 0.0, 9.81], (FRAMES, 1)))
    return _log_of(frames, sensor="rgbd", accelerations=readings)


def lidar_log() -> Log:
    times_s = np.linspace(0.0, 0.099, 300, dtype=np.float32)
    scans: list[Frame] = [
        Scan(stamp_ns, sweep(seed), times_s=times_s) for seed, stamp_ns in enumerate(STAMPS_NS.tolist())
    ]
    return _log_of(scans, sensor="lidar")


def _log_of(frames: list[Frame], **facts: object) -> Log:
    entries = [memory_entry(frame.stamp_ns, frame) for frame in frames]
    return log_in_memory(entries, truth=truth(), wheels=truth(), **facts)


def _written(log: Callable[[], Log], kind: LogKind, name: str) -> Maker:
    def make(folder: Path) -> Path:
        write_log(log(), folder / name, kind=kind)
        return folder / name

    return make


def _mcap(compression: CompressionType, *, chunked: bool = True) -> Maker:
    def make(folder: Path) -> Path:
        with (folder / "log.mcap").open("wb") as file:
            writer = McapWriter(file, compression=compression, use_chunking=chunked, chunk_size=20_000)
            writer.start()
            add_messages(writer, shots(FRAMES))
            writer.finish()
        return folder / "log.mcap"

    return make


def _bag(compression: Bag1Writer.CompressionFormat) -> Maker:
    def make(folder: Path) -> Path:
        writer = Bag1Writer(folder / "log.bag")
        writer.set_compression(compression)
        with writer:
            connections: dict[str, object] = {}
            for stamp_ns, topic, type_, cdr, _ in shots(FRAMES):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, type_, typestore=typestore("ros1"))
                writer.write(connections[topic], stamp_ns, typestore("cdr").cdr_to_ros1(cdr, type_))
        return folder / "log.bag"

    return make


def _rosbag2(plugin: StoragePlugin, mode: CompressionMode) -> Maker:
    def make(folder: Path) -> Path:
        writer = Bag2Writer(folder / "log", version=9, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        write_folder(writer, shots(FRAMES))
        return folder / "log"

    return make


def _foxglove_messages(i: int) -> list[tuple[str, object]]:
    stamp_ns = int(STAMPS_NS[i])
    stamp = fox.Timestamp(sec=stamp_ns // NS_PER_S, nsec=stamp_ns % NS_PER_S)
    rgb, units = picture(i)
    K = CAMERA.matrix.ravel().tolist()
    jpeg = cv2.imencode(".jpg", rgb)[1].tobytes()
    calibration = fox.CameraCalibration(
        timestamp=stamp, frame_id="optical", width=64, height=48, distortion_model="plumb_bob",
        D=list(CAMERA.distortion), K=K, R=np.eye(3).ravel().tolist(),
        P=[60.0, 0, 31.5, 0, 0, 61, 23.5, 0, 0, 0, 1, 0],
    )  # fmt: skip
    depth = fox.RawImage(
        timestamp=stamp, frame_id="optical", width=64, height=48, encoding="16UC1", step=128,
        data=units.tobytes(),
    )  # fmt: skip
    colour = fox.CompressedImage(timestamp=stamp, frame_id="optical", format="jpeg", data=jpeg)
    return [("/depth", depth), ("/color", colour), ("/calibration", calibration)]


def _foxglove(folder: Path) -> Path:
    messages = [
        (topic, int(STAMPS_NS[i]), one) for i in range(FRAMES) for topic, one in _foxglove_messages(i)
    ]
    return write_foxglove(folder / "log.mcap", messages)


def _foxglove_json(folder: Path) -> Path:
    path = folder / "log.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        number = writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"{}")
        channel = writer.register_channel("/ground_truth", "json", number)
        clouds = writer.register_channel(
            "/points", "protobuf", writer.register_schema("foxglove.PointCloud", "protobuf", b"")
        )
        for i, stamp_ns in enumerate(STAMPS_NS.tolist()):
            time = {"sec": stamp_ns // NS_PER_S, "nsec": stamp_ns % NS_PER_S}
            pose = {"position": {"x": i, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
            text = json.dumps({"timestamp": time, "frame_id": "world", "pose": pose}).encode()
            writer.add_message(channel, stamp_ns, text, stamp_ns)
            fields = [
                fox.PackedElementField(
                    name=axis, offset=4 * k, type=fox.PackedElementFieldNumericType.Float32
                )
                for k, axis in enumerate("xyz")
            ]
            cloud = fox.PointCloud(
                timestamp=fox.Timestamp(**time), frame_id="lidar", point_stride=12, data=sweep(i).tobytes(),
                fields=fields, pose=fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1.0)),
            )  # fmt: skip
            writer.add_message(clouds, stamp_ns, cloud.encode(), stamp_ns)
        writer.finish()
    return path


def _clouds(ending: str) -> Maker:
    def make(folder: Path) -> Path:
        log = folder / "log"
        log.mkdir()
        for i, stamp_ns in enumerate(STAMPS_NS.tolist()):
            save_cloud(log / f"{stamp_ns}{ending}", sweep(i))
        return log

    return make


def _octree(name: str, write_octree: Callable[[Path, OctreeMap], None]) -> Maker:
    def make(folder: Path) -> Path:
        write_octree(folder / name, mapped(1, config=COLORED))
        return folder / name

    return make


def _tiny_desk(folder: Path) -> Path:
    write_tum_log(folder / "log", TINY_DESK)
    return folder / "log"


_EDITS = """\
drop = []
[[accept]]
nodes = [0, 1]
translation_m = [0.1, 0.0, 0.02]
rotation_xyzw = [0.0, 0.0, 0.1, 0.995]
by_eye = true
[[erase]]
box_m = [[0.5, -0.5, 0.3], [0.9, 0.5, 0.9]]
[[keep]]
height_m = [-1.0, 2.5]
path_radius_m = 9.0
[[keepout]]
polygon_m = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]
"""


def _run(folder: Path) -> Path:
    build_desk_run(_tiny_desk(folder), folder / "run")
    (folder / "run/mine.toml").write_text(_EDITS)
    return folder / "run"


def _run_without_digests(folder: Path) -> Path:
    """Make a run as older versions left it: damage has to be found by whoever reads a file."""
    built = folder.parent / "run"  # where the corpus has made one, as a rule
    run = shutil.copytree(built, folder, dirs_exist_ok=True) / "run" if built.exists() else _run(folder)
    manifest = run / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"files": {}}))
    return run


def _depth_camera(folder: Path) -> Path:
    wide = PinholeCamera(106, 60, 53.0, 53.0, 52.4, 30.1)
    write_unregistered(folder / "log", rgbd_log(), wide, stated_in="topic")
    return folder / "log"


def _scan(kind: str) -> Maker:
    def make(folder: Path) -> Path:
        frames = [frame for frame in rgbd_log() if isinstance(frame, RgbdFrame)]
        write_scan, name = WRITERS[kind]
        return write_scan(folder / name, shots_of(frames, truth().T_world_body))

    return make


def _livox(folder: Path) -> Path:
    return write_livox(folder / "log.bag", (scan for scan in lidar_log() if isinstance(scan, Scan)))


FORMATS: Mapping[str, Maker] = {
    "tum": _written(rgbd_log, "tum", "log"),
    "mbag": _written(rgbd_log, "mbag", "log"),
    "mcap": _written(rgbd_log, "mcap", "log.mcap"),
    "mcap, plain": _mcap(CompressionType.NONE),
    "mcap, zstd": _mcap(CompressionType.ZSTD),
    "mcap, unchunked": _mcap(CompressionType.NONE, chunked=False),
    "bag": _written(rgbd_log, "bag", "log.bag"),
    "bag, plain": lambda folder: write(folder / "log.bag", shots(FRAMES)),
    "bag, bz2": _bag(Bag1Writer.CompressionFormat.BZ2),
    "bag, lz4": _bag(Bag1Writer.CompressionFormat.LZ4),
    "rosbag2": lambda folder: write(folder / "log", shots(FRAMES)),
    "rosbag2, messages": _rosbag2(StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "rosbag2, mcap": _rosbag2(StoragePlugin.MCAP, CompressionMode.STORAGE),
    "rosbag2, depth camera": _depth_camera,
    "foxglove": _foxglove,
    "foxglove, json": _foxglove_json,
    "lidar mcap": _written(lidar_log, "mcap", "log.mcap"),
    "lidar bag": _written(lidar_log, "bag", "log.bag"),
    "kitti": _written(lidar_log, "kitti", "log"),
    **IMAGE_LOGS,
    **{kind: _scan(kind) for kind in WRITERS if kind != "redwood"},
    "redwood, npy": _scan("redwood"),
    "bag, livox": _livox,
    **SENSOR_LOGS,
    **{
        f"clouds, {ending[1:]}": _clouds(ending)
        for ending in (".bin", ".pcd", ".ply", ".xyz", ".csv", ".npy", ".las", ".laz")
    },
    "map.octree": _octree("map.octree", write_map),
    "map.ot": _octree("map.ot", write_ot),
    "map.bt": _octree("map.bt", write_bt),
    "built log": _tiny_desk,
    "run": _run,
    "run, old": _run_without_digests,
}
"""Makers of an input of every format."""

_OF_A_RUN = (
    "doctor {}",
    "eval {}",
    "eval {}/trajectory.tum --truth {}/truth.tum",
    "fuse {} --quiet",
    "loops {}",
    "merge {} --out {}/../o --place truth --quiet",
    "plan {} --from 0 0 --to 0.3 0 --unknown free --radius 0.05",
    "report {} --out {}/../o.html",
    "solve {}/graph.g2o --out {}/../o.g2o",
    "view {} --rrd {}/../o.rrd",
    # Open3D, which makes meshes, takes more address space than the child has.
    *(
        f"export {{}} --as {kind} --overwrite"
        for kind, exporter in EXPORTERS.items()
        if exporter.file_name and kind != "mesh"
    ),
    "edit {} --from {}/mine.toml --quiet",
)
_VERBS: Mapping[str, tuple[str, ...]] = {
    "built log": ("inspect {}", "convert {} --as mcap --out {}/../o.mcap", "build {} --out {}/../o --quiet"),
    "run": _OF_A_RUN,
    "run, old": _OF_A_RUN,
}


def commands_of(name: str) -> tuple[str, ...]:
    """Return the commands of ``tests.fuzz.child`` that read a format; ``{}`` stands for the path."""
    return _VERBS.get(name, ("all {}",))


class Corpus:
    """Inputs of all formats, made once in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._inputs: dict[str, Path] = {}

    def copy(self, name: str, to: Path) -> Path:
        """Copy an input to an empty folder and return the path to open there."""
        home = self._folder / name.replace(" ", "_")
        if name not in self._inputs:
            home.mkdir(parents=True)
            self._inputs[name] = FORMATS[name](home)
        shutil.copytree(home, to, dirs_exist_ok=True)
        return to / self._inputs[name].relative_to(home)
