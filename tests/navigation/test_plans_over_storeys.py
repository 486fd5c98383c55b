"""Paths over storeys that ramps and stairs join."""

import numpy as np
import pytest

from mapper.core.errors import PlanError
from mapper.navigation.config import PlanConfig, TraversableConfig
from mapper.navigation.planner import plan_storeys
from mapper.navigation.reachable_floor import reachable_floor
from mapper.navigation.traversable_grid import traversable
from tests.support.floor_scenes import bridge, two_storeys
from tests.support.floor_worlds import Block, Slab, World

ROBOT = TraversableConfig(max_step_m=0.2, head_room_m=1.8, max_gap_m=0.2)
PLAN = PlanConfig(layer="traversable", radius_m=0.15)


def floor_of(world):
    floor = reachable_floor(world.octree(0.1), ROBOT, positions_world=world.positions())
    return traversable(floor, ROBOT, with_links=True)


def spiral(turns):
    """Square spiral stairs 1.2 m wide: 32 steps of 10 cm a turn, every other turn right above."""
    corners = [(0.6, 0.6), (3.4, 0.6), (3.4, 3.4), (0.6, 3.4)]
    centres = [
        (x0 + (x1 - x0) * k / 8, y0 + (y1 - y0) * k / 8)
        for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True)
        for k in range(8)
    ]
    blocks, path = [], []
    for step in range(int(32 * turns)):
        x, y = centres[step % 32]
        top = 0.1 * (step + 1)
        half_x, half_y = (0.2, 0.6) if step // 8 % 2 == 0 else (0.6, 0.2)
        if step % 8 == 0:
            half_x = half_y = 0.6
        blocks.append(Block(x - half_x, x + half_x, y - half_y, y + half_y, top - 0.15, top))
        path.append((x, y, top))
    return World([Slab(-1.0, 5.0, -1.0, 5.0, -3.0)], blocks, path)


def test_a_path_leads_up_the_stairs_and_its_waypoints_have_heights():
    floor = floor_of(two_storeys())
    plan = plan_storeys(floor, np.array([8.0, 6.0]), np.array([2.0, 5.0, 3.06]), config=PLAN)
    assert plan.storeys == (0, 1)
    np.testing.assert_allclose(plan.waypoints_world[[0, -1]], [[8.0, 6.0, 0.0], [2.0, 5.0, 3.1]], atol=0.11)
    climbing = plan.waypoints_world[(plan.waypoints_world[:, 2] > 0.3) & (plan.waypoints_world[:, 2] < 2.8)]
    assert (climbing[:, 1] < 1.5).all()  # on the stairs
    assert len(climbing)
    assert 15.0 < plan.length_m < 35.0
    assert plan.min_clearance_m >= 0.15 - 1e-6


def test_any_two_places_of_the_path_are_joined():
    for world in (two_storeys(), bridge()):
        floor = floor_of(world)
        for start in world.path[::2]:
            for goal in world.path[1::3]:
                plan = plan_storeys(floor, np.array(start), np.array(goal), config=PLAN)
                np.testing.assert_allclose(
                    plan.waypoints_world[[0, -1], :2], [start[:2], goal[:2]], atol=0.11
                )


@pytest.mark.parametrize("turns", [1.5, 2.0, 2.9])
def test_spiral_stairs_are_one_way_up_and_down(turns):
    """A turn fills a storey, so that storeys share no floor but where they meet."""
    world = spiral(turns)
    floor = floor_of(world)
    assert len(floor.storeys) >= 2
    assert floor.links
    for start, goal in ((0, -1), (-1, 0), (3, 40), (45, 20)):
        plan = plan_storeys(floor, np.array(world.path[start]), np.array(world.path[goal]), config=PLAN)
        ends = [world.path[start], world.path[goal]]
        np.testing.assert_allclose(plan.waypoints_world[[0, -1]], ends, atol=0.21)
        assert set(plan.storeys) <= set(range(len(floor.storeys)))
        climbed_m = np.abs(np.diff(plan.waypoints_world[:, 2])).sum()
        assert climbed_m == pytest.approx(abs(ends[1][2] - ends[0][2]), abs=0.5)


def test_a_point_without_a_height_is_on_the_storey_where_the_log_begins():
    floor = floor_of(two_storeys())
    plan = plan_storeys(floor, np.array([8.0, 6.0]), np.array([2.0, 5.0]), config=PLAN)
    assert plan.storeys == (0,)
    assert plan.waypoints_world[:, 2].max() <= 0.1


def test_storeys_that_only_a_narrower_robot_can_change_are_named():
    with pytest.raises(PlanError, match="plan with a smaller radius"):
        plan_storeys(
            floor_of(two_storeys()),
            np.array([8.0, 6.0]),
            np.array([2.0, 5.0, 3.06]),
            config=PlanConfig(layer="traversable", radius_m=0.8),
        )
