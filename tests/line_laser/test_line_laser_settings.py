"""Settings of the line laser: each changes what it is said to change."""

import numpy as np
import pytest

from mapper.line_laser import detection
from mapper.line_laser.calibration import row_px
from mapper.line_laser.config import THESIS, LineLaserConfig
from mapper.line_laser.ranging import LineScan, line_scan, local_grid

CONFIG = LineLaserConfig()


@pytest.mark.parametrize(
    ("method", "setting", "value"),
    [
        ("hue", "hue_from_deg", 359.0),
        ("hue", "hue_to_deg", 0.5),
        ("hue", "saturation_threshold", 200),
        ("intensity", "intensity_threshold", 251),
        ("weight", "weight_threshold", 250),
        ("edges", "edge_threshold", 255),
        ("edges", "edge_sigma_px", 6.0),
    ],
)
def test_each_threshold_of_the_stripe_belongs_to_one_method(method, setting, value):
    image = np.full((60, 80, 3), 60, np.uint8)
    image[9:12] = (85, 60, 60)  # of little contrast
    image[29:32] = (250, 130, 125)  # of hue 2.4°
    image[29:32, 40:] = (250, 125, 130)  # of hue 357.6°
    stricter = CONFIG.stripe.model_copy(update={setting: value})
    before, after = (detection.responses(image, config) for config in (CONFIG.stripe, stricter))
    assert np.count_nonzero(after[method]) < np.count_nonzero(before[method])
    others = {"hue", "intensity", "weight", "edges"} - {method}
    assert all(np.array_equal(after[other], before[other]) for other in others)


def test_the_local_grid_ends_where_its_settings_say():
    points = np.array([[0.505, -0.105], [1.005, 0.995], [1.505, 0.0]])
    scan = LineScan(0, np.arange(3), np.zeros(3), points, np.zeros(3, np.bool_))
    smaller = CONFIG.map.model_copy(update={"width_cells": 40, "depth_cells": 120})
    assert np.argwhere(local_grid(scan, smaller)).tolist() == [[50, 20 + 10]]


def test_the_floor_begins_a_margin_before_the_reach():
    rows = np.array([row_px(THESIS, range_m) for range_m in (1.7, 1.79, 1.83, 1.89)])
    for margin_m, is_floor in ((0.08, [False, False, True, True]), (0.15, [False, True, True, True])):
        config = CONFIG.map.model_copy(update={"floor_margin_m": margin_m})
        assert line_scan(rows, THESIS, config, stamp_ns=0).is_floor.tolist() == is_floor
