"""GNSS fixes go over with a log into other formats, and come back; inspection tells of them."""

import json

import numpy as np
import pytest

from mapper.core.geodesy import GeodeticOrigin
from mapper.core.geometry import exp
from mapper.core.rotations import rotation_from_euler
from mapper.simulation.config import STREET
from mapper.simulation.gnss_config import SynthGnssConfig
from mapper.simulation.lidar import LidarSimulator, write_lidar_log
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, TopicsConfig
from mapper.sources.ros.encode_ros import fix_message
from mapper.sources.writers import left_out, write_log
from tests.support.command_line import invoke
from tests.support.recordings import shots, transforms, write

EXACT = SynthGnssConfig(noise_m=0.0, bias_m=0.0, rate_hz=20.0)
SHORT = STREET.model_copy(
    update={
        "duration_s": 0.5,
        "gnss": SynthGnssConfig(rate_hz=20.0),
        "sensor": STREET.sensor.model_copy(update={"rings": 4, "azimuth_steps": 90}),
    }
)


@pytest.fixture(scope="module")
def street():
    return LidarSimulator(SHORT).log()


@pytest.mark.parametrize("name", ["kitti", "log.mcap", "log.bag"])
def test_fixes_come_back(street, tmp_path, name):
    kind = name.removeprefix("log.")
    write_log(street, tmp_path / name, kind=kind)
    again = open_source(tmp_path / name).gnss
    for part in ("stamps_ns", "geodetic", "covariances_enu", "status"):
        np.testing.assert_array_equal(getattr(again, part), getattr(street.gnss, part))
    np.testing.assert_allclose(again.antenna_body, SHORT.gnss.antenna_body, atol=1e-12)
    assert left_out(street, kind) == []
    assert left_out(street, "mbag") == ["mbag has no place for GNSS fixes; left out"]


def test_exact_fixes_are_where_the_antenna_is():
    config = SHORT.model_copy(update={"gnss": EXACT})
    simulator = LidarSimulator(config)
    fixes = simulator.log().gnss
    origin = GeodeticOrigin(EXACT.latitude_deg, EXACT.longitude_deg, EXACT.height_m)
    index = np.searchsorted(fixes.stamps_ns, simulator.truth.stamps_ns)
    T = simulator.truth.T_world_body
    expected = T[:, :3, :3] @ np.array(EXACT.antenna_body) + T[:, :3, 3]
    R_enu_world = rotation_from_euler(0.0, 0.0, EXACT.heading_rad)
    np.testing.assert_allclose(origin.enu(fixes.geodetic[index]), expected @ R_enu_world.T, atol=1e-6)
    far = EXACT.model_copy(
        update={"outage_duration_s": 0.2, "multipath_start_s": 0.3, "multipath_duration_s": 0.1}
    )
    away = LidarSimulator(SHORT.model_copy(update={"gnss": far})).log().gnss
    assert len(fixes) - len(away) == 4
    off_m = np.linalg.norm(origin.enu(away.geodetic) - origin.enu(fixes.geodetic[4:]), axis=1)
    assert off_m[2:4].min() > 15.0 * (1.0 - 1e-6)
    assert np.delete(off_m, [2, 3]).max() < 1e-6


def test_inspection_tells_number_rate_status_and_sigma(tmp_path):
    write_lidar_log(tmp_path / "log", SHORT)
    (row,) = [
        line for line in invoke("inspect", tmp_path / "log").stdout.splitlines() if line.startswith("gnss")
    ]
    assert "11 fixes (11 without augmentation), σ 1.1 m" in row
    facts = json.loads(invoke("inspect", tmp_path / "log", "--json").stdout)["log"]
    assert (facts["gnss"]["count"], facts["gnss"]["rate_hz"]) == (11, 20.0)
    assert facts["gnss_sigma_m"] == pytest.approx(np.hypot(0.5, 1.0))


def test_a_receivers_topic_goes_before_a_filters_and_another_can_be_chosen(tmp_path):
    T_camera_antenna = exp(np.array([0.0, 0.1, 0.0]), np.array([0.2, -0.5, 1.0]))
    messages = [*shots(3), transforms(("optical", "antenna", T_camera_antenna))]
    for topic, status in (("/a/filtered", 0), ("/ublox/fix", 2)):
        for k, shot in enumerate(shots(3)[::3]):
            messages.append(
                fix_message(
                    shot.stamp_ns,
                    topic,
                    geodetic=np.array([47.0, 19.0, 100.0 + k]),
                    covariance_enu=np.eye(3) if k else np.full((3, 3), np.nan),
                    status=status,
                    frame="antenna",
                )
            )
    write(tmp_path / "a.mcap", messages)
    log = open_source(tmp_path / "a.mcap")
    assert log.gnss.name == "/ublox/fix"
    np.testing.assert_allclose(log.gnss.antenna_body, T_camera_antenna[:3, 3])
    assert set(log.gnss.status.tolist()) == {2}
    assert np.isnan(log.gnss.covariances_enu[0]).all()
    np.testing.assert_array_equal(log.gnss.covariances_enu[1], np.eye(3))
    assert any(note.endswith(": /a/filtered") for note in log.notes)
    chosen = open_source(tmp_path / "a.mcap", SourceConfig(topics=TopicsConfig(gnss="/a/filtered")))
    assert chosen.gnss.name == "/a/filtered"
