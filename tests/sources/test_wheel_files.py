"""Wheel odometry beside a log: poses, encoders, mountings, malformed files."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.geometry import transform
from mapper.core.timebase import NS_PER_S as S
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, WheelsConfig
from mapper.sources.trajectory_files import write_tum
from tests.support.planar import arc
from tests.support.tum_logs import FIRST_NS

R_BASE_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def test_poses_beside_a_log_are_led_to_a_camera_that_looks_forward(tiny_tum_log):
    log = tiny_tum_log(3)
    base = arc(4, turn_rad=0.2)
    base = replace(base, stamps_ns=base.stamps_ns - base.stamps_ns[0] + FIRST_NS)
    write_tum(log / "wheels.txt", base)
    source = open_source(log)
    assert (source.choices[-1], source.notes) == ("wheels.txt: wheel odometry, 4 poses", [])
    expected = base.T_world_body @ transform(R_BASE_OPTICAL, np.zeros(3))
    np.testing.assert_allclose(source.wheels.T_world_body, expected, atol=1e-12)
    assert len(open_source(log, SourceConfig(first_frame=1)).wheels) == 4
    mounted = WheelsConfig(body_in_base=(0.1, 0.0, 0.4, 0.0, 0.0, 0.0, 1.0))
    wheels = open_source(log, SourceConfig(wheels=mounted)).wheels
    np.testing.assert_allclose(wheels.T_world_body[0][:3, 3], [0.1, 0.0, 0.4], atol=1e-12)


@pytest.mark.parametrize("header", ["", "timestamp,x,y,yaw\n", "# stamp x y yaw\n"])
def test_poses_in_the_plane_are_read(tiny_tum_log, header):
    log = tiny_tum_log(3)
    base = arc(4, turn_rad=0.2)
    stamps_s = (base.stamps_ns - base.stamps_ns[0] + FIRST_NS) / S
    yaw = np.arctan2(base.T_world_body[:, 1, 0], base.T_world_body[:, 0, 0])
    rows = np.column_stack([stamps_s, base.positions_world[:, :2], yaw])[::-1]
    text = "\n".join(",".join(f"{value:.9f}" for value in row) for row in rows)
    (log / "wheels.txt").write_text(header + text)
    wheels = open_source(log).wheels
    expected = base.T_world_body @ transform(R_BASE_OPTICAL, np.zeros(3))
    np.testing.assert_allclose(wheels.T_world_body, expected, atol=1e-6)


def test_encoders_beside_a_log_want_a_wheelbase(tiny_tum_log):
    log = tiny_tum_log(3)
    first_s, second_s = FIRST_NS // S, FIRST_NS // S + 1
    lines = f"{second_s} 1.5 0.0\n{first_s} 0.5 0.0\n"
    (log / "encoders.txt").write_text(f"# stamp path_m steering_rad\n{lines}")
    with pytest.raises(SourceError, match=r"encoders.txt: .*--set source.wheels.wheelbase_m"):
        open_source(log)
    source = open_source(log, SourceConfig(wheels=WheelsConfig(wheelbase_m=0.5)))
    assert source.wheels.stamps_ns.tolist() == [first_s * S, second_s * S]
    np.testing.assert_allclose(source.wheels.positions_world, [[0, 0, 0], [1, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("encoders.txt", "1.0 2.0\n", r"encoders.txt:1: 2 columns, want 3: stamp path_m steering_rad"),
        ("encoders.txt", "1.0 2.0 1.6\n", r"encoders.txt:1: .* within ±π/2 rad"),
        ("encoders.txt", "# none\n", r"encoders.txt: no readings"),
        ("wheels.txt", "1.0 0 0 0 0\n", r"wheels.txt:1: 5 columns, want 8"),
        ("wheels.txt", "1.0 0 0 nan\n", r"wheels.txt:1: want finite x, y and yaw"),
    ],
)
def test_malformed_files_are_named(tiny_tum_log, name, text, why):
    log = tiny_tum_log(2)
    (log / name).write_text(text)
    with pytest.raises(SourceError, match=why):
        open_source(log, SourceConfig(wheels=WheelsConfig(wheelbase_m=0.5)))


def test_a_mounting_without_a_rotation_is_refused(tiny_tum_log):
    log = tiny_tum_log(2)
    write_tum(log / "wheels.txt", arc(2))
    with pytest.raises(SourceError, match=r"body_in_base=\(0.0, .* its quaternion is zero"):
        open_source(log, SourceConfig(wheels=WheelsConfig(body_in_base=(0.0,) * 7)))
