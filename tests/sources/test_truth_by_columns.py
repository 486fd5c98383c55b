"""Files and topics of truth that are known by what they hold."""

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.core.trajectory import Positions, Trajectory
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, TopicsConfig
from mapper.sources.ros.encode_ros import SerializedMessage
from mapper.sources.ros.typestore import make_header, make_message, serialize
from tests.support.recordings import shots, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS

STAMPS_NS = FIRST_NS // 1000 * 1000 + np.arange(4) * 100_000_000
POSES = [exp(np.array([0.0, 0.0, 0.1 * k]), np.array([0.5 * k, 0.1, 0.2])) for k in range(4)]
MULRAN = [",".join([f"{ns}", *map(str, T[:3].ravel())]) for ns, T in zip(STAMPS_NS, POSES, strict=True)]
TABLE = ["time,x,y,z", *(f"{ns / 1e9:.6f},{T[0, 3]},0.1,0.2" for ns, T in zip(STAMPS_NS, POSES, strict=True))]


@pytest.mark.parametrize(
    ("name", "lines", "kind"),
    [
        ("global_pose.csv", MULRAN, Trajectory),
        ("groundtruth_2012-01-08.csv", TABLE, Positions),
        ("site_gt.txt", TABLE, Positions),
        ("lengths.csv", TABLE, None),
        ("ground_truth_readme.txt", ["made by hand"], None),
    ],
)
def test_a_table_that_is_called_truth_is_one_in_a_folder_of_clouds(tmp_path, name, lines, kind):
    for stamp_ns in STAMPS_NS:
        points = np.random.default_rng(0).uniform(-9.0, 9.0, (60, 4)).astype("<f4")
        np.abs(points, out=points, where=[False, False, False, True])
        points.tofile(tmp_path / f"{stamp_ns}.bin")
    (tmp_path / name).write_text("\n".join(lines))
    truth = open_source(tmp_path).truth
    assert (None if truth is None else type(truth)) is kind
    if truth is not None:
        np.testing.assert_allclose(truth.positions[:, 0], [T[0, 3] for T in POSES])


def test_points_of_a_total_station_are_true_positions(tmp_path):
    points = []
    for k in range(6):
        point = make_message("geometry_msgs/msg/Point", x=0.1 * k, y=0.0, z=1.0)
        header = make_header(FIRST_NS + k * PERIOD_NS, "leica")
        cdr = serialize(make_message("geometry_msgs/msg/PointStamped", header=header, point=point))
        points.append(SerializedMessage(FIRST_NS, "/leica/position", "geometry_msgs/msg/PointStamped", cdr))
    path = write(tmp_path / "a.mcap", [*shots(6), *points])
    log = open_source(path, SourceConfig(topics=TopicsConfig(truth="/leica/position")))
    assert isinstance(log.truth, Positions)
    np.testing.assert_allclose(log.truth.positions[:, 0], 0.1 * np.arange(6))
    assert any("/leica/position" in note for note in open_source(path).notes)
