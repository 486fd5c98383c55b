import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapper.core.errors import DataError
from mapper.sensing.depth import dif

DEPTHS = arrays(
    np.float32,
    st.tuples(st.integers(1, 8), st.integers(1, 8)),
    elements=st.one_of(st.just(0.0), st.floats(0.5, 8.0, width=32)),
)


def dif_by_the_book(depth_m):
    """Somlyai (PhD thesis), alg. 4, line by line."""
    filtered = np.zeros_like(depth_m)
    for y, x in np.ndindex(depth_m.shape):
        patch = depth_m[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].astype(np.float64)
        if (patch > 0).any():
            filtered[y, x] = patch[patch > 0].mean()
    return filtered


@settings(max_examples=80)
@given(DEPTHS)
def test_equals_the_thesis_algorithm(depth_m):
    before = depth_m.copy()
    np.testing.assert_allclose(dif(depth_m), dif_by_the_book(depth_m), rtol=1e-6)
    np.testing.assert_array_equal(depth_m, before, err_msg="the input is not changed")


@settings(max_examples=40)
@given(DEPTHS)
def test_stays_within_the_measured_neighbours(depth_m):
    filtered = dif(depth_m)
    measured = filtered[filtered > 0]
    if len(measured):
        assert measured.min() >= depth_m[depth_m > 0].min() * (1 - 1e-6)
        assert measured.max() <= depth_m.max() * (1 + 1e-6)


def test_a_hole_of_one_pixel_is_filled_and_a_wide_one_keeps_its_heart():
    depth_m = np.full((9, 9), 2.0, np.float32)
    depth_m[1, 1] = 0.0
    depth_m[4:9, 4:9] = 0.0
    filtered = dif(depth_m)
    assert filtered[1, 1] == 2.0
    assert (filtered[5:, 5:] == 0.0).all()
    assert (filtered[:4] == 2.0).all()


def test_halves_the_noise_of_a_wall_at_least():
    rng = np.random.default_rng(1)
    noisy = (2.0 + 0.01 * rng.standard_normal((100, 100))).astype(np.float32)
    assert dif(noisy).std() == pytest.approx(0.01 / 3, rel=0.1)


def test_a_strided_view_is_read_right():
    depth_m = np.random.default_rng(0).uniform(0.5, 4.0, (20, 30)).astype(np.float32)
    np.testing.assert_array_equal(dif(depth_m[::2, ::3]), dif(depth_m[::2, ::3].copy()))


@pytest.mark.parametrize("bad", [np.zeros((3, 3)), np.zeros((3, 3, 1), np.float32)])
def test_refuses_what_is_no_depth_image(bad):
    with pytest.raises(DataError, match=r"DIF: depth image of .*want \(H, W\) float32"):
        dif(bad)
