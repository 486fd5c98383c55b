"""The sensor's own vehicle: its returns are in no frame of a log, and inspect proposes where it is."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import apply, exp, inverse
from mapper.sources.base import SensorBeside
from mapper.sources.config import BodyConfig, SourceConfig
from mapper.sources.frame_selection import selected
from tests.support.logs import log_in_memory, memory_entry

BOX = (-2.0, -1.0, -1.5, 0.5, 1.0, -0.3)
INSIDE = [(-1.0, 0.0, -0.5), (0.5, 1.0, -1.5)]
OUTSIDE = [(0.6, 0.0, -0.5), (-1.0, 1.1, -0.5), (-1.0, 0.0, 0.0), (30.0, 0.0, 1.0)]


def scan_log(points, **facts):
    scan = Scan(
        5,
        np.array(points, np.float32),
        colors=np.arange(3 * len(points), dtype=np.uint8).reshape(-1, 3),
        times_s=np.arange(len(points), dtype=np.float32),
    )
    return log_in_memory([memory_entry(5, scan)], sensor="lidar", **facts)


def cleared(log, **body):
    return selected(log, SourceConfig(body=BodyConfig(**body))).entry_at(0)


@pytest.mark.parametrize(
    ("body", "kept"),
    [
        ({"box": BOX}, [2, 3, 4, 5]),
        ({"min_range_m": 1.3}, [1, 3, 5]),
        ({"max_range_m": 20.0}, [0, 1, 2, 3, 4]),
        ({"box": BOX, "max_range_m": 20.0}, [2, 3, 4]),
        ({}, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_returns_of_the_vehicle_are_left_out_of_scans(body, kept):
    points = np.array(INSIDE + OUTSIDE, np.float32)
    entry = cleared(scan_log(points), **body)
    for scan in (entry.load(), entry.scan()):
        np.testing.assert_array_equal(scan.points_body, points[kept])
        np.testing.assert_array_equal(scan.times_s, kept)
        np.testing.assert_array_equal(scan.colors[:, 0], 3 * np.array(kept))


def test_depth_of_the_vehicle_is_not_measured():
    camera = PinholeCamera(width_px=4, height_px=3, fx_px=4.0, fy_px=4.0, cx_px=1.5, cy_px=1.0)
    depth_m = np.array([[0.0, 2.0, 2.0, 2.0], [2.0, 2.0, 0.0, 2.0], [0.4, 0.4, 0.4, 0.4]], np.float32)
    frame = RgbdFrame(5, np.zeros((3, 4, 3), np.uint8), depth_m, camera)
    entry = cleared(log_in_memory([memory_entry(5, frame)]), box=(-1.0, 0.05, 0.0, 0.1, 1.0, 1.0))

    loaded = entry.load()
    np.testing.assert_array_equal(loaded.depth_m[:2], depth_m[:2])
    np.testing.assert_array_equal(loaded.depth_m[2] > 0.0, [False, False, False, True])
    np.testing.assert_array_equal(entry.scan().points_body, loaded.scan().points_body)
    assert depth_m[2].all(), "the recorded image stays as it is"


def test_sensors_beside_see_no_vehicle_either():
    T_body_rear = exp(np.array([0.0, 0.0, np.pi]), np.array([-1.0, 0.0, 0.0]))
    points = apply(inverse(T_body_rear), np.array(INSIDE[:1] + OUTSIDE))
    log = replace(scan_log(OUTSIDE), beside=[SensorBeside(scan_log(points), T_body_rear)])
    (rear,) = selected(log, SourceConfig(body=BodyConfig(box=BOX, max_range_m=20.0))).beside
    for scan in (rear.log.entry_at(0).load(), rear.log.entry_at(0).scan()):
        np.testing.assert_array_equal(scan.times_s, [1, 2, 3])


def test_a_scan_of_nothing_but_the_vehicle_is_refused():
    with pytest.raises(FrameError, match=r"all 2 returns are of the vehicle .*source\.body\.box"):
        cleared(scan_log(INSIDE), box=BOX).scan()


@pytest.mark.parametrize("body", [{"box": (1, 0, 0, 0, 1, 1)}, {"min_range_m": 2.0, "max_range_m": 1.0}])
def test_a_box_or_range_that_holds_nothing_is_refused(body):
    with pytest.raises(ValueError, match=r"want the least x y z|must be above"):
        BodyConfig(**body)
