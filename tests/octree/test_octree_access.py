"""What a caller asks of an octree: states, probabilities, centres, slices; arrays of any shape."""

import numpy as np
import pytest

from mapper.core.errors import DataError, MapFileError
from mapper.octree.config import SliceConfig
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN
from mapper.octree.map import read_octree
from mapper.octree.octomap_file import write_bt, write_ot
from mapper.octree.slice import cut_slice
from tests.support.octree_maps import octree_of


@pytest.fixture(scope="module", params=range(2))
def octree(request):
    rng = np.random.default_rng(request.param)
    return octree_of([(rng.normal(0.0, 1.0, (400, 3)).astype(np.float32), np.zeros(3)) for _ in range(4)])


def test_states_agree_with_the_leaves(octree):
    leaves = octree.leaves()
    expected = np.where(leaves.log_odds >= octree.occupied_log_odds, OCCUPIED, FREE)
    np.testing.assert_array_equal(octree.query(leaves.centres_world), expected)
    assert octree.query([50.0, 0.0, 0.0]) == UNKNOWN
    assert octree.query([[1e9, 0.0, np.nan]]).tolist() == [UNKNOWN]


def test_centres_are_those_of_the_states(octree):
    occupied, free = octree.occupied(), octree.free()
    assert len(occupied) + len(free) == len(octree)
    assert len(occupied) > 100
    assert len(free) > 100
    assert (octree.query(occupied) == OCCUPIED).all()
    assert (octree.query(free) == FREE).all()


def test_probabilities_are_those_of_the_log_odds(octree):
    leaves = octree.leaves()
    np.testing.assert_allclose(
        octree.probability(leaves.centres_world), 1.0 / (1.0 + np.exp(-leaves.log_odds)), rtol=1e-6
    )
    assert np.isnan(octree.probability([50.0, 0.0, 0.0]))


def test_points_have_any_shape_whose_last_axis_is_3(octree):
    grid = octree.occupied()[:24].reshape(2, 3, 4, 3)
    assert octree.query(grid).shape == octree.log_odds_at(grid).shape == (2, 3, 4)
    assert octree.query(np.empty((0, 3))).shape == (0,)
    assert octree.query(grid[0, 0, 0].tolist()).shape == ()


@pytest.mark.parametrize("wrong", [np.zeros((4, 2)), np.zeros((3, 5)), 1.0, [[1, 2], [3]], "abc"])
def test_other_shapes_are_refused_in_one_line(octree, wrong):
    with pytest.raises(DataError, match=r"octree: points") as caught:
        octree.query(wrong)
    assert "\n" not in str(caught.value)


def test_a_slice_is_the_band_between_two_heights(octree):
    grid = octree.slice(-0.2, 0.4)
    expected = cut_slice(octree, SliceConfig(min_height_m=-0.2, max_height_m=0.4))
    np.testing.assert_array_equal(grid.cells, expected.cells)
    centres = octree.occupied()
    centres = centres[(centres[:, 2] > -0.2) & (centres[:, 2] < 0.4)]
    columns = np.floor((centres[:, :2] - grid.origin_world_m) / grid.resolution_m).astype(int)
    assert (grid.cells[columns[:, 1], columns[:, 0]] == OCCUPIED).all()
    assert np.unique(columns, axis=0).shape[0] == (grid.cells == OCCUPIED).sum()
    with pytest.raises(DataError, match="nothing is known"):
        octree.slice(50.0, 51.0)


@pytest.mark.parametrize("height_m", [-0.35, 0.0, 0.15, 0.3, 0.5, 0.6])
def test_a_height_on_a_border_is_in_the_voxels_above_it_as_in_a_query(octree, height_m):
    """0.5 // 0.05 is 9."""
    at, within = octree.slice(height_m), octree.slice(height_m + 0.02)
    np.testing.assert_array_equal(at.cells, within.cells)
    x, y = at.origin_world_m + at.resolution_m * (np.argwhere((at.cells == OCCUPIED).T)[0] + 0.5)
    assert octree.query([x, y, height_m]) == OCCUPIED


@pytest.mark.parametrize("heights_m", [(1.2, 0.1), (0.3, 0.3), (np.nan,), (0.0, np.inf)])
def test_heights_that_are_no_band_are_refused_in_one_line(octree, heights_m):
    with pytest.raises(DataError, match=r"^slice: from .*; want finite heights, the lower one first$"):
        octree.slice(*heights_m)


@pytest.mark.parametrize("write", [write_bt, write_ot])
def test_a_file_is_named_by_text_or_path(octree, tmp_path, write):
    path = tmp_path / "map"
    write(path, octree)
    for name in (path, str(path)):
        np.testing.assert_array_equal(read_octree(name).occupied(), octree.occupied())
    with pytest.raises(MapFileError, match="gone: cannot be read"):
        read_octree(str(tmp_path / "gone"))
