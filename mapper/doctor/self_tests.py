"""Self-tests: a tiny job with a known answer for every library that is used.

``python -m mapper.doctor.self_tests NAME`` does one of them in a process of its own, so that a library whose
compiled code crashes takes nothing else with it.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

_SHIFT_M = np.array([0.05, -0.03, 0.02])
_TOLERANCE_M = 0.01


class WrongAnswerError(Exception):
    """A library ran, and gave a wrong answer."""


def gtsam(_folder: Path) -> None:
    """Solve a graph of two poses a metre apart."""
    import gtsam

    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph, guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise))
    step = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0.0, 0.0]))
    graph.add(gtsam.BetweenFactorPose3(0, 1, step, noise))
    for node in range(2):
        guess.insert(node, gtsam.Pose3())
    solved = gtsam.LevenbergMarquardtOptimizer(graph, guess).optimize()
    expect_near(solved.atPose3(1).translation(), np.array([1.0, 0.0, 0.0]))


def opencv(_folder: Path) -> None:
    """Find ORB features in noise."""
    import cv2

    found = cv2.ORB.create(100).detectAndCompute(_texture(), None)[0]
    _expect(len(found) > 50, f"ORB found {len(found)} features in noise")


def open3d(_folder: Path) -> None:
    """Register by normal distributions."""
    import open3d as o3d

    source, target = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in _corners())
    found = o3d.pipelines.registration.registration_ndt(source, target)
    expect_near(found.transformation[:3, 3], _SHIFT_M)


def kiss_icp(_folder: Path) -> None:
    """Register points to a voxel map."""
    from kiss_icp.mapping import VoxelHashMap
    from kiss_icp.registration import Registration

    source, target = _corners()
    voxels = VoxelHashMap(voxel_size=0.5, max_distance=100.0, max_points_per_voxel=20)
    voxels.add_points(target)
    icp = Registration(max_num_iterations=100, convergence_criterion=1e-5, max_num_threads=1)
    expect_near(icp.align_points_to_map(source, voxels, np.eye(4), 0.5, 0.1)[:3, 3], _SHIFT_M)


def kiss_matcher(_folder: Path) -> None:
    """Build the matcher and register a cloud."""
    from kiss_matcher import KISSMatcher

    found = KISSMatcher(0.2).estimate(*(points.astype(np.float32) for points in _corners()))
    rotation = np.asarray(found.rotation)
    _expect(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6), f"no rotation: {rotation.tolist()}")


def numba(_folder: Path) -> None:
    """Compile a loop."""
    import numba

    @numba.njit
    def total(n: int) -> int:
        found = 0
        for i in range(n):
            found += i
        return found

    _expect(total(10) == 45, f"a compiled loop gave {total(10)}")


def mcap(folder: Path) -> None:
    """Write a message and read it back."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    path = folder / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/topic", "json", writer.register_schema("Any", "jsonschema", b""))
        writer.add_message(channel, log_time=1, data=b"{}", publish_time=1)
        writer.finish()
    with path.open("rb") as file:
        messages = [message.data for _, _, message in make_reader(file).iter_messages()]
    _expect(messages == [b"{}"], f"read {messages}")


def foxglove(_folder: Path) -> None:
    """Encode a message."""
    from foxglove.messages import Vector3

    _expect(len(Vector3(x=1.0, y=2.0, z=3.0).encode()) == 27, "a vector is not 27 bytes")


def rerun(folder: Path) -> None:
    """Save a recording."""
    import rerun as rr

    path = folder / "log.rrd"
    with rr.RecordingStream("mapper-doctor") as recording:
        recording.save(path)
        recording.log("points", rr.Points3D(np.eye(3)))
    _expect(path.read_bytes()[:3] == b"RRF", "the file is no recording")


def matplotlib(folder: Path) -> None:
    """Draw a line into a file."""
    from matplotlib.figure import Figure

    figure, path = Figure(figsize=(1.0, 1.0)), folder / "line.png"
    figure.subplots().plot([0.0, 1.0])
    figure.savefig(path)
    _expect(path.read_bytes()[1:4] == b"PNG", "the file is no PNG")


def laspy(folder: Path) -> None:
    """Write a compressed cloud and read it back."""
    import laspy

    cloud, path = laspy.create(point_format=0, file_version="1.2"), folder / "cloud.laz"
    cloud.header.scales = np.full(3, 0.001)
    cloud.xyz = np.eye(3)
    cloud.write(path)
    expect_near(np.array(laspy.read(path).xyz), np.eye(3))


def lz4(_folder: Path) -> None:
    """Compress and decompress."""
    from lz4 import frame

    _expect(frame.decompress(frame.compress(b"mapper")) == b"mapper", "the bytes came back others")


def pypcd4(folder: Path) -> None:
    """Write a cloud and read it back."""
    from pypcd4 import PointCloud

    path = folder / "cloud.pcd"
    PointCloud.from_xyz_points(np.eye(3, dtype=np.float32)).save(path)
    expect_near(PointCloud.from_path(path).numpy(("x", "y", "z")), np.eye(3))


def rosbags(_folder: Path) -> None:
    """Turn a ROS message into bytes and back."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    time = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    data = store.serialize_cdr(time, time.__msgtype__)
    _expect(store.deserialize_cdr(data, time.__msgtype__) == time, "the message came back another")


def protobuf(_folder: Path) -> None:
    """Turn a protobuf message into bytes and back."""
    from google.protobuf.timestamp_pb2 import Timestamp

    time = Timestamp(seconds=1, nanos=2)
    _expect(Timestamp.FromString(time.SerializeToString()) == time, "the message came back another")


def isal(_folder: Path) -> None:
    """Deflate and inflate."""
    from isal import isal_zlib

    _expect(isal_zlib.decompress(isal_zlib.compress(b"mapper")) == b"mapper", "the bytes came back others")


def simplejpeg(_folder: Path) -> None:
    """Encode an image and decode it."""
    import simplejpeg

    grey = np.full((8, 8, 1), 128, np.uint8)
    found = simplejpeg.decode_jpeg(simplejpeg.encode_jpeg(grey, colorspace="GRAY"), "GRAY")
    _expect(np.array_equal(found, grey), "a grey image came back another")


def zstandard(_folder: Path) -> None:
    """Compress and decompress."""
    import zstandard

    packed = zstandard.compress(b"mapper")
    _expect(zstandard.decompress(packed) == b"mapper", "the bytes came back others")


def numpy(_folder: Path) -> None:
    """Solve three equations."""
    expect_near(np.linalg.solve(2.0 * np.eye(3), np.ones(3)), np.full(3, 0.5))


def scipy(_folder: Path) -> None:
    """Count the connected components of three nodes and one edge."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edge = coo_array((np.ones(1), (np.array([0]), np.array([1]))), shape=(3, 3))
    _expect(connected_components(edge, directed=False)[0] == 2, "the components are wrong")


def pyarrow(folder: Path) -> None:
    """Write a table and read it back."""
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table({"n": [1, 2]}), folder / "table.parquet")
    _expect(parquet.read_table(folder / "table.parquet").num_rows == 2, "the table has other rows")


def pydantic(_folder: Path) -> None:
    """Parse a number from text."""
    from pydantic import TypeAdapter

    _expect(TypeAdapter(float).validate_python("0.5") == 0.5, "0.5 was parsed as something else")


def rich(_folder: Path) -> None:
    """Measure a text."""
    from rich.cells import cell_len

    _expect(cell_len("map") == 3, "three letters do not take three cells")


def typer(_folder: Path) -> None:
    """Make a command line."""
    import typer

    _expect(callable(typer.Typer()), "no command line")


def distributed(_folder: Path) -> None:
    """Parse an address of a scheduler."""
    from distributed.comm import parse_address

    _expect(parse_address("tcp://127.0.0.1:8786") == ("tcp", "127.0.0.1:8786"), "an address was misread")


SELF_TESTS: dict[str, Callable[[Path], None]] = {
    "distributed": distributed,
    "foxglove-sdk": foxglove,
    "gtsam": gtsam,
    "isal": isal,
    "kiss-icp": kiss_icp,
    "kiss-matcher": kiss_matcher,
    "laspy": laspy,
    "lz4": lz4,
    "matplotlib": matplotlib,
    "mcap": mcap,
    "numba": numba,
    "numpy": numpy,
    "open3d": open3d,
    "opencv-contrib-python-headless": opencv,
    "protobuf": protobuf,
    "scipy": scipy,
    "pyarrow": pyarrow,
    "pydantic": pydantic,
    "pypcd4": pypcd4,
    "rerun-sdk": rerun,
    "rich": rich,
    "rosbags": rosbags,
    "simplejpeg": simplejpeg,
    "typer": typer,
    "zstandard": zstandard,
}
"""Tests by the name of the library at PyPI."""


def _expect(is_so: object, message: str) -> None:
    if not is_so:
        raise WrongAnswerError(message)


def expect_near(found: NDArray[np.floating], wanted: NDArray[np.floating]) -> None:
    """Refuse a result that is not near the right one, in metres."""
    _expect(np.allclose(found, wanted, atol=_TOLERANCE_M), f"got {np.round(found, 3).tolist()}")


def _texture() -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (120, 160), dtype=np.uint8)


def _corners() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N, 3) points on a floor and two walls, and the same moved by the shift."""
    across = np.random.default_rng(0).uniform(0.0, 5.0, (3, 2000, 2))
    walls = [np.insert(points, axis, 0.0, axis=1) for axis, points in enumerate(across)]
    source = np.concatenate(walls)
    return source, source + _SHIFT_M


if __name__ == "__main__":
    with TemporaryDirectory() as scratch:
        SELF_TESTS[sys.argv[1]](Path(scratch))
