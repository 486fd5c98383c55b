"""The offset between the clocks of colour and depth, in every format that pairs their images."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.writers import write_log
from tests.support.tum_logs import CALIBRATION, DEPTH_LEAD_NS, PERIOD_NS, picture, write_picture

LATE = SourceConfig(depth_offset_s=PERIOD_NS * 1e-9)


def depth_of(entry):
    return entry.load().depth_m


@pytest.mark.parametrize("kind", ["tum", "mbag", "mcap", "bag"])
def test_depth_is_paired_by_corrected_stamps(tiny_tum_log, tmp_path, kind):
    log = tmp_path / ("out" if kind in ("tum", "mbag") else f"out.{kind}")
    write_log(open_source(tiny_tum_log(5)), log, kind=kind)
    plain, late = open_source(log), open_source(log, LATE)
    assert late.stamps_ns.tolist() == plain.stamps_ns[1:].tolist()
    for i in range(4):
        then, now = plain.entry_at(i), late.entry_at(i)
        np.testing.assert_array_equal(depth_of(now), depth_of(then))
        assert now.depth_stamp_ns == then.depth_stamp_ns + PERIOD_NS
        assert now.load().depth_delay_s == pytest.approx(-DEPTH_LEAD_NS * 1e-9)
    assert any("1 of 5 colour images" in note for note in late.notes)


@pytest.mark.parametrize("truth", ["icl", "poznan", "redwood"])
def test_numbered_images_are_paired_by_corrected_stamps(tmp_path, truth):
    for i in range(4):
        write_picture(tmp_path / f"rgb/{i}.png", tmp_path / f"depth/{i}.png", i)
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    if truth == "icl":
        (tmp_path / "walk.gt.freiburg").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(4)))
    elif truth == "poznan":
        (tmp_path / "groundtruth.txt").write_text("".join(f"{i} {i} 0 0 0 0 0\n" for i in range(4)))
    else:
        (tmp_path / "trajectory.log").write_text("".join(f"{i} {i} {i + 1}\n{_pose(i)}" for i in range(4)))
    plain = open_source(tmp_path)
    period_s = float(plain.stamps_ns[1] - plain.stamps_ns[0]) * 1e-9
    late = open_source(tmp_path, SourceConfig(depth_offset_s=-2.0 * period_s))
    assert late.stamps_ns.tolist() == plain.stamps_ns[:2].tolist()
    np.testing.assert_array_equal(late.truth.stamps_ns, plain.truth.stamps_ns)
    for i in range(2):
        np.testing.assert_array_equal(depth_of(late.entry_at(i)), depth_of(plain.entry_at(i + 2)))
        np.testing.assert_array_equal(late.entry_at(i).load().rgb, picture(i)[0])


def test_an_offset_that_leaves_nothing_is_refused(tiny_tum_log):
    with pytest.raises(SourceError, match=r"no colour image has a depth image within 20 ms"):
        open_source(tiny_tum_log(3), SourceConfig(depth_offset_s=5.0))


def _pose(i):
    return f"1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
