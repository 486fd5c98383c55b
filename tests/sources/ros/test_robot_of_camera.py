"""The robot below an RGB-D camera, by tf: which frame, where at each stamp, how high above the floor."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.frames import Scan
from mapper.core.geometry import exp, inverse
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import shifted
from mapper.sources.ros.encode_ros import cloud_message
from tests.support.recordings import shots, transforms, write
from tests.support.tum_logs import FIRST_NS, PERIOD_NS

STAMPS_NS = [FIRST_NS + i * PERIOD_NS for i in range(6)]
T_FOOT_BASE = exp(np.zeros(3), np.array([0.0, 0.0, 0.13]))
T_BASE_MAST = exp(np.zeros(3), np.array([0.2, 0.0, 0.8]))


def head(stamp_ns):
    """T_mast_optical of a camera that pans and tilts."""
    seconds = (stamp_ns - FIRST_NS) / 1e9
    pan, tilt = (
        exp(np.array([0.0, 0.0, 0.9 * seconds]), np.zeros(3)),
        exp(np.array([0.0, 0.4 * seconds, 0.0]), np.array([0.05, 0.0, 0.1])),
    )
    return pan @ tilt @ exp(np.array([1.2, -1.2, 1.2]), np.zeros(3))


def robot(*, namespace="", rate_hz=50, last_ns=STAMPS_NS[-1]):
    """tf of base_footprint, base_link and mast, which stay, and of the camera, which moves on the mast."""
    foot, base, mast = (namespace + name for name in ("base_footprint", "base_link", "mast"))
    period_ns = 1_000_000_000 // rate_hz
    return [
        transforms((foot, base, T_FOOT_BASE), (base, mast, T_BASE_MAST)),
        *(
            transforms((mast, "optical", head(t)), topic="/tf", stamp_ns=t)
            for t in range(FIRST_NS - period_ns, last_ns + 2 * period_ns, period_ns)
        ),
    ]


def opened(path, messages, **config):
    return open_source(write(path, [*messages, *shots(6)]), SourceConfig(**config))


@pytest.mark.parametrize(("name", "rate_hz"), [("log.mcap", 100), ("log.bag", 10), ("log", 50)])
@pytest.mark.parametrize("namespace", ["", "robot1/"])
def test_base_is_where_tf_has_it_at_each_frame_s_time(tmp_path, name, rate_hz, namespace):
    log = opened(tmp_path / name, robot(namespace=namespace, rate_hz=rate_hz))

    assert (log.base_frame, log.body_frame) == (f"{namespace}base_link", "optical")
    assert log.T_base_body is None
    assert log.base_height_m == pytest.approx(0.13)
    assert log.T_body_base.stamps_ns.tolist() == STAMPS_NS
    T_body_base = [inverse(T_BASE_MAST @ head(t)) for t in STAMPS_NS]
    np.testing.assert_allclose(log.T_body_base.T_world_body, T_body_base, atol=1e-3)
    assert not any("base.tum" in note for note in log.sentences)
    later = shifted(log, 5)
    assert (later.T_body_base.stamps_ns - later.stamps_ns == 0).all()


def test_frames_outside_the_time_of_tf_have_no_base(tmp_path):
    log = opened(tmp_path / "log.mcap", robot(rate_hz=100, last_ns=STAMPS_NS[2]))

    assert log.T_body_base.stamps_ns.tolist() == STAMPS_NS[:3]
    assert sum("3 of 6 frames" in choice for choice in log.choices) == 1
    assert list(log.notes) == []  # which are possible causes of doubts
    assert log[1::2].T_body_base.stamps_ns.tolist() == STAMPS_NS[1:2]


@pytest.mark.parametrize(
    ("body_frame", "T_frame_base", "height_m"),
    [("base_footprint", T_FOOT_BASE, 0.0), ("/mast", inverse(T_BASE_MAST), 0.93)],
)
def test_body_frame_names_another_frame_of_the_robot(tmp_path, body_frame, T_frame_base, height_m):
    log = opened(tmp_path / "log.mcap", robot(rate_hz=100), body_frame=body_frame)

    assert log.base_frame == body_frame.lstrip("/")
    assert log.base_height_m == pytest.approx(height_m)
    T_body_base = log.T_body_base.T_world_body @ T_frame_base
    np.testing.assert_allclose(T_body_base, [inverse(T_BASE_MAST @ head(t)) for t in STAMPS_NS], atol=1e-4)


def test_body_frame_can_be_the_camera_s_own(tmp_path):
    for messages in ([], robot()):
        log = opened(tmp_path / f"{len(messages)}.mcap", messages, body_frame="optical")
        assert log.base_frame == "optical"
        np.testing.assert_array_equal(log.T_base_body, np.eye(4))


def test_a_sensor_that_stays_on_the_base_only_is_told_there(tmp_path):
    laser = transforms(("base_link", "laser", T_FOOT_BASE))
    scan = cloud_message("/scan", Scan(FIRST_NS, np.ones((3, 3), np.float32)), frame="laser")
    (sensor,) = opened(tmp_path / "log.mcap", [laser, *robot(), scan]).sensors
    assert (sensor.frame, sensor.parent) == ("laser", "base_link")
    np.testing.assert_allclose(sensor.T_parent_sensor, T_FOOT_BASE, atol=1e-12)


def test_footprint_alone_is_the_base(tmp_path):
    log = opened(tmp_path / "log.mcap", [transforms(("base_footprint", "optical", T_BASE_MAST))])

    assert (log.base_frame, log.base_height_m) == ("base_footprint", 0.0)
    np.testing.assert_allclose(log.T_base_body, T_BASE_MAST, atol=1e-12)


@pytest.mark.parametrize(
    ("body_frame", "why"),
    [("wheel", "frames: base_footprint, base_link, mast, odom, optical"), ("odom", "robot: base_footprint")],
)
def test_frame_that_is_none_of_the_robot_s_is_refused(tmp_path, body_frame, why):
    odom = transforms(("odom", "base_footprint", np.eye(4)))
    with pytest.raises(SourceError, match=f"body_frame={body_frame}: .*{why}"):
        opened(tmp_path / "log.mcap", [odom, *robot()], body_frame=body_frame)
