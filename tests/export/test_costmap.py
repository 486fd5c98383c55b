import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.export.nav2 import FREE_SPACE, INSCRIBED, LETHAL, NO_INFORMATION, inflate
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


def grid_of(cells):
    return OccupancyGrid(np.array(cells, np.int8), np.array([0.0, 0.0]), 0.05)


def nav2_cost(cells, *, radius_m, scaling):
    """nav2_costmap_2d's InflationLayer::computeCost, word for word."""
    if cells == 0:
        return LETHAL
    if cells * 0.05 <= radius_m:
        return INSCRIBED
    return int((INSCRIBED - 1) * np.exp(-scaling * (cells * 0.05 - radius_m)))


def test_costs_fall_as_nav2_s_do():
    cells = np.full((1, 30), FREE)
    cells[0, 0] = OCCUPIED

    got = inflate(grid_of(cells), robot_radius_m=0.2, inflation_radius_m=0.55, cost_scaling=3.0)

    expected = [nav2_cost(n, radius_m=0.2, scaling=3.0) for n in range(30)]
    reach = int(np.ceil(0.55 / 0.05))
    assert got[0, : reach + 1].tolist() == expected[: reach + 1]
    assert (got[0, reach + 1 :] == FREE_SPACE).all()
    assert got[0, 4] == INSCRIBED  # 0.2 m is on the radius, whatever 4 · 0.05 rounds to
    assert got.dtype == np.uint8


def test_costs_depend_on_the_straight_distance():
    cells = np.full((11, 11), FREE)
    cells[5, 5] = OCCUPIED
    got = inflate(grid_of(cells), robot_radius_m=0.0, inflation_radius_m=1.0, cost_scaling=5.0)
    assert got[8, 9] == got[5, 10] == nav2_cost(5.0, radius_m=0.0, scaling=5.0)  # 3-4-5
    np.testing.assert_array_equal(got, got.T)


def test_unknown_stays_unknown_unless_the_robot_would_touch():
    cells = np.full((1, 10), UNKNOWN)
    cells[0, 0] = OCCUPIED
    got = inflate(grid_of(cells), robot_radius_m=0.1, inflation_radius_m=0.5, cost_scaling=1.0)[0]
    assert got.tolist() == [LETHAL, INSCRIBED, INSCRIBED] + [NO_INFORMATION] * 7


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ((-0.1, 0.5, 1.0), "robot radius -0.1"),
        ((0.1, 0.05, 1.0), "inflation radius 0.05 m, want at least the robot's 0.1 m"),
        ((0.1, np.inf, 1.0), "inflation radius inf"),
        ((0.1, 0.5, np.nan), "cost scaling nan"),
    ],
)
def test_impossible_settings_are_refused(settings, complaint):
    radius_m, inflation_m, scaling = settings
    with pytest.raises(DataError, match=complaint):
        inflate(
            grid_of([[FREE]]), robot_radius_m=radius_m, inflation_radius_m=inflation_m, cost_scaling=scaling
        )
