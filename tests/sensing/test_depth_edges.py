"""Features on the outline of something nearer, whose pixel shows the background."""

import numpy as np
import pytest

from mapper.sensing.depth_edges import lies_behind_edge


def behind(depth_m, pixels, sigma_px=1.0):
    columns, rows = np.array(pixels).T
    found = lies_behind_edge(
        np.asarray(depth_m, np.float32), columns, rows, np.broadcast_to(sigma_px, len(columns))
    )
    return found.tolist()


@pytest.fixture
def box_before_a_wall():
    depth_m = np.full((40, 60), 3.0)
    depth_m[15:30, 20:40] = 2.5
    return depth_m


def test_the_background_beside_an_outline_is_found_and_the_foreground_is_not(box_before_a_wall):
    pixels = [(18, 20), (19, 20), (20, 20), (21, 20), (30, 13), (30, 14), (30, 15), (18, 13), (41, 31)]
    assert behind(box_before_a_wall, pixels) == [True, True, False, False, True, True, False, True, True]


def test_how_close_follows_the_uncertainty_of_the_pixel(box_before_a_wall):
    assert behind(box_before_a_wall, [(16, 20)] * 3, [1.0, 1.44, 2.0]) == [False, False, True]


def test_small_jumps_and_pixels_without_depth_do_not_count(box_before_a_wall):
    assert behind(np.where(box_before_a_wall < 3.0, 2.8, 3.0), [(19, 20)]) == [False]
    assert behind(np.where(box_before_a_wall < 3.0, 0.0, 3.0), [(19, 20), (25, 20)]) == [False, False]


@pytest.mark.parametrize("slope", [0.5, 2.0, 5.0])
def test_planes_have_no_edges_however_slanted_and_near(slope):
    rows, columns = np.mgrid[:120, :160]
    inverse = (1.0 + slope * (columns / 160 + rows / 120)) / 3.0  # affine in the pixels, as on any plane
    inner = [(c, r) for c in range(8, 152, 9) for r in range(8, 112, 9)]
    assert not any(behind(1.0 / inverse, inner, 3.0))


def test_the_image_border_is_no_edge():
    assert behind(np.full((20, 30), 2.0), [(0, 0), (29, 19), (29, 0), (0, 19)], 4.0) == [False] * 4
