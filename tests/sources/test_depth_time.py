"""Depth at the time of its own stamps, or at that which the images show."""

import numpy as np
import pytest

from mapper.core.geometry import exp
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.mapping.placed_frames import placed_frames
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.depth_time import with_depth_on_time
from mapper.sources.multi_session_log import chained
from tests.support.logs import log_in_memory, memory_entry
from tests.support.paths import DATA

MS = 1_000_000
real = pytest.mark.skipif(not (DATA / "tum_fr1_xyz").exists(), reason=f"{DATA}/tum_fr1_xyz is not there")


def moment(stamp_ns):
    """Pose of a camera that moves and turns evenly."""
    seconds = stamp_ns / NS_PER_S
    return exp(seconds * np.array([0.0, 0.7, 0.2]), seconds * np.array([0.5, 0.0, 0.1]))


@pytest.mark.parametrize("delay_ms", [0, 16, -30])
def test_a_frame_has_the_pose_of_the_time_of_its_depth(delay_ms):
    entries = [memory_entry(k * 33 * MS, None, depth_delay_ns=delay_ms * MS) for k in range(5)]
    log = log_in_memory(entries)
    path = Trajectory(log.stamps_ns, np.array([moment(stamp_ns) for stamp_ns in log.stamps_ns]))
    for placed in placed_frames(log, path):
        wanted = moment(placed.entry.stamp_ns + delay_ms * MS)
        np.testing.assert_allclose(placed.T_world_body, wanted, atol=1e-9)
    second = chained(log, log).entry_at(7)
    assert second.depth_stamp_ns - second.stamp_ns == delay_ms * MS


@real
def test_late_depth_is_put_where_the_images_show_it():
    config = SourceConfig(last_frame=300)
    log = open_source(DATA / "tum_fr1_xyz", config)
    moved, sentence = with_depth_on_time(log, config)
    delays_ms = [(moved.entry_at(k).depth_stamp_ns - log.entry_at(k).depth_stamp_ns) / MS for k in (0, 150)]
    assert delays_ms[0] == delays_ms[1] == pytest.approx(-24.0, abs=5.0)
    assert "source.depth_offset_s=-0.02" in sentence
    assert np.array_equal(moved[10].depth_m, log[10].depth_m)
    for set_s in (0.0, delays_ms[0] / 1e3):
        chosen = SourceConfig(last_frame=300, depth_offset_s=set_s)
        log = open_source(DATA / "tum_fr1_xyz", chosen)
        assert with_depth_on_time(log, chosen) == (log, "")


@pytest.mark.parametrize("name", ["tum_fr3_cabinet_1_5hz", "tum_fr3_teddy"])
def test_time_that_images_do_not_tell_stays_as_stamped(name):
    if not (DATA / name).exists():
        pytest.skip(f"{DATA / name} is not there")
    log = open_source(DATA / name)
    assert with_depth_on_time(log, SourceConfig()) == (log, "")
