"""Box of the sensor's own vehicle, proposed from returns that stand still in the body frame."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.sources.config import BodyConfig, SourceConfig
from mapper.sources.vehicle import clear_vehicle, vehicle_box
from tests.support.logs import log_in_memory, memory_entry
from tests.support.street_scans import on_street, street, view

FRAMES = 12
CAMERA = PinholeCamera(width_px=80, height_px=60, fx_px=70.0, fy_px=70.0, cx_px=39.5, cy_px=29.5)


def bonnet_and_driver(rng):
    """Return points of a bonnet before the sensor, and of a person who walks behind it and sways."""
    bonnet = rng.uniform((0.8, -0.7, -0.85), (1.9, 0.7, -0.8), (400, 3))
    angle = rng.uniform(0.0, 2.0 * np.pi, 500)
    driver = np.column_stack([0.25 * np.cos(angle), 0.25 * np.sin(angle), rng.uniform(-1.1, 0.1, 500)])
    driver += [-1.4 + rng.normal(0.0, 0.05), rng.normal(0.0, 0.08), 0.0]
    return np.concatenate([bonnet, driver])


def street_log(*, vehicle, parked=False):
    """Return a drive along a synthetic street, and the points that belong to the vehicle and its driver."""
    scene, rng, entries, own = street(1), np.random.default_rng(4), [], []
    for k in range(FRAMES):
        points = view(scene, on_street(scene, 5.0 + (0.0 if parked else 2.5 * k)), seed=k).points_body
        own.append(bonnet_and_driver(rng))
        if vehicle:
            points = np.concatenate([points, own[-1].astype(np.float32)])
        entries.append(memory_entry(k, Scan(k, points.astype(np.float32))))
    return log_in_memory(entries, sensor="lidar"), np.concatenate(own)


def test_the_box_holds_vehicle_and_driver_and_little_else():
    log, own = street_log(vehicle=True)
    box = vehicle_box(log)
    lower, upper = np.array(box).reshape(2, 3)
    inside = ((own >= lower) & (own <= upper)).all(axis=1)
    assert inside.mean() > 0.97
    assert (lower >= own.min(axis=0) - 0.4).all()
    assert (upper <= own.max(axis=0) + 0.4).all()

    left, config = clear_vehicle(log, SourceConfig())
    assert config.body.box == box
    assert len(left.notes) == len(log.notes) + 1
    assert vehicle_box(left) is None
    kept = sum(len(entry.scan().points_body) for entry in left.entries())
    total = sum(len(entry.scan().points_body) for entry in log.entries())
    assert total - kept == pytest.approx(len(own), rel=0.03)


def test_rings_on_a_ceiling_are_no_vehicle():
    log, _ = street_log(vehicle=False)
    azimuth = np.linspace(0.0, 2.0 * np.pi, 300)
    rings = [1.3 / np.tan(elevation) for elevation in (0.79, 0.68, 0.58, 0.47, 0.37)]
    ceiling = np.concatenate(
        [np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), 0.0 * azimuth + 1.3]) for r in rings]
    )

    def under_it(index):
        scan = log.entry_at(index).scan()
        points = np.concatenate([scan.points_body, ceiling.astype(np.float32)])
        return memory_entry(index, Scan(index, points))

    assert vehicle_box(replace(log, entry_at=under_it)) is None


@pytest.mark.parametrize("body", [{"find_box": False}, {"box": (9.0, 9.0, 9.0, 10.0, 10.0, 10.0)}])
def test_nothing_is_cleared_against_the_settings(body):
    log, _ = street_log(vehicle=True)
    config = SourceConfig(body=BodyConfig(**body))
    assert clear_vehicle(log, config) == (log, config)


@pytest.mark.parametrize(
    ("vehicle", "parked", "frames"), [(False, False, FRAMES), (True, True, FRAMES), (True, False, 5)]
)
def test_a_street_alone_a_sensor_that_stands_and_few_frames_show_no_vehicle(vehicle, parked, frames):
    log, _ = street_log(vehicle=vehicle, parked=parked)
    assert vehicle_box(log.subset(np.arange(frames))) is None


def box_before_a_camera(pixels):
    """Return the box proposed where some pixels show 0.4 m while a wall goes away."""
    entries = []
    for k in range(FRAMES):
        depth_m = np.full((60, 80), 1.3 + 0.12 * k, np.float32)
        depth_m[pixels] = 0.4
        entries.append(memory_entry(k, RgbdFrame(k, np.zeros((60, 80), np.uint8), depth_m, CAMERA)))
    return vehicle_box(log_in_memory(entries))


def test_a_bumper_below_a_camera_is_found_and_what_takes_up_most_of_the_view_is_scanned():
    lower, upper = np.array(box_before_a_camera(np.s_[48:, 20:60])).reshape(2, 3)
    assert (lower <= (-0.11, 0.11, 0.4)).all()
    assert (upper >= (0.11, 0.16, 0.4)).all()
    assert (upper - lower < 0.5).all()
    assert box_before_a_camera(np.s_[:, 30:50]) is not None
    for no_vehicle in (np.s_[:, 10:70], np.s_[:0]):
        assert box_before_a_camera(no_vehicle) is None
