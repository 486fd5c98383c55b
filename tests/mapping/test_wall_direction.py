import numpy as np
import pytest

from mapper.core.geometry import rotation_exp
from mapper.mapping.wall_direction import wall_heading
from mapper.registration.planes import Patches

UP = np.array([0.0, 0.0, 1.0])


def upright(angles_rad):
    normals = np.column_stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(len(angles_rad))])
    return Patches(np.zeros((len(angles_rad), 3)), normals)


@pytest.mark.parametrize("heading_deg", [-44.0, -10.0, 0.0, 31.3, 44.9])
def test_walls_of_four_directions_share_a_heading(heading_deg):
    rng = np.random.default_rng(1)
    walls_deg = heading_deg + 90.0 * rng.integers(0, 4, 120) + rng.normal(0.0, 1.5, 120)
    clutter_deg = rng.uniform(0.0, 360.0, 60)
    found = wall_heading(upright(np.radians(np.concatenate([walls_deg, clutter_deg]))), np.eye(3))
    assert found.determined
    assert np.degrees(found.angle_rad) == pytest.approx(heading_deg, abs=0.6)


def test_normals_in_all_directions_have_no_heading():
    angles_rad = np.random.default_rng(2).uniform(0.0, 2.0 * np.pi, 400)
    assert not wall_heading(upright(angles_rad), np.eye(3)).determined


def test_few_walls_and_none_have_no_heading():
    assert not wall_heading(upright(np.zeros(12)), np.eye(3)).determined
    level = Patches(np.zeros((50, 3)), np.tile(UP, (50, 1)))
    assert wall_heading(level, np.eye(3)).upright == 0


def test_the_vertical_is_the_level_frame_s():
    R_level_world = rotation_exp(np.array([0.4, -0.2, 0.0]))
    patches = upright(np.radians(20.0 + 90.0 * np.arange(60)))
    world = Patches(patches.centres_world, patches.normals_world @ R_level_world)
    assert np.degrees(wall_heading(world, R_level_world).angle_rad) == pytest.approx(20.0, abs=0.1)
