"""Correction of the depth of a log's frames."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.depth_correction import with_corrected_depth
from mapper.sources.selection import selected

OFFSET_PER_M = 0.04


def test_a_number_is_added_to_every_inverse_depth(tiny_tum_log):
    folder = tiny_tum_log(2)
    recorded, corrected = (
        open_source(folder, config).entry_at(0)
        for config in (SourceConfig(), SourceConfig(inverse_depth_offset_per_m=OFFSET_PER_M))
    )
    before_m, after_m = recorded.load().depth_m, corrected.load().depth_m
    known = before_m > 0.0
    assert known.any()
    assert after_m.dtype == np.float32
    np.testing.assert_allclose(1.0 / after_m[known], 1.0 / before_m[known] + OFFSET_PER_M, rtol=1e-5)
    assert (after_m[~known] == 0.0).all()
    np.testing.assert_allclose(
        corrected.scan().points_body, corrected.load().scan().points_body, rtol=1e-5, atol=1e-6
    )


def test_depth_without_an_inverse_left_is_no_measurement(tiny_tum_log):
    log = open_source(tiny_tum_log(1))
    depth_m = log.entry_at(0).load().depth_m
    farthest_m = float(depth_m.max())
    entry = with_corrected_depth(log, -1.0 / farthest_m).entry_at(0)
    assert (entry.load().depth_m[depth_m == farthest_m] == 0.0).all()
    assert np.isfinite(entry.load().depth_m).all()
    assert len(entry.scan().points_body) == (entry.load().depth_m > 0.0).sum()


def test_scans_have_no_such_depth(tiny_tum_log):
    scans = replace(open_source(tiny_tum_log(1)), sensor="lidar")
    with pytest.raises(SourceError, match="corrects depth images"):
        selected(scans, SourceConfig(inverse_depth_offset_per_m=OFFSET_PER_M))
