"""Unobservable motions are named, and carried into the information."""

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.geometry import apply, exp, transform
from mapper.registration.degeneracy import degeneracy_of, projected
from mapper.registration.pair_refinement import measured
from mapper.registration.surfaces import prepared

N = 20_000


def corridor(rng):
    x, across = rng.uniform(-20.0, 20.0, N), rng.uniform(-1.5, 1.5, N)
    side = np.full(N, 1.5)
    return np.concatenate(
        [np.column_stack(c) for c in ((x, -side, across), (x, side, across), (x, across, -side))]
    )


def plain(rng):
    x, y = rng.uniform(-20.0, 20.0, (2, N))
    return np.column_stack([x, y, np.full(N, -1.7)])


def tunnel(rng):
    """A cylinder along x, of which the sensor stands 1.5 m off the axis."""
    x, angle = rng.uniform(-10.0, 10.0, 2 * N), rng.uniform(0.0, 2.0 * np.pi, 2 * N)
    return np.column_stack([x, 3.0 * np.cos(angle) + 1.5, 3.0 * np.sin(angle)])


def room(rng):
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = rng.uniform(-1.0, 1.0, (N // 2, 3))
            side[:, axis] = sign
            sides.append(side * [4.0, 3.0, 1.5])
    return np.concatenate(sides)


def registered(scene, *, T_turned=None, noise_m=0.02):
    """Register two noisy samples of a scene; return the information and its degeneracy."""
    rng = np.random.default_rng(7)
    clouds = []
    for _ in range(2):
        points = scene(rng)
        points = apply(np.eye(4) if T_turned is None else T_turned, points)
        clouds.append(prepared(points + rng.normal(scale=noise_m, size=points.shape), voxel_m=0.2))
    information = measured(*clouds, np.eye(4), max_pair_distance_m=0.5).information
    return information, degeneracy_of(information, points=clouds[1].points)


def test_directions_are_those_of_unobservable_translations():
    along = registered(corridor)[1].directions
    assert along.shape == (1, 3)
    assert abs(along[0, 0]) > 0.999
    level = registered(plain)[1].directions  # rotation about z is unobservable, too
    assert level.shape == (2, 3)
    assert np.abs(level[:, 2]).max() < 0.05
    assert registered(room)[1].directions.shape == (0, 3)


@pytest.mark.parametrize(
    ("scene", "text"),
    [
        (corridor, "translation along x"),
        (plain, "translation along x and y, rotation about z"),
        (tunnel, "translation along x, rotation about x"),
        (room, ""),
    ],
)
def test_unobservable_motions_are_named(scene, text):
    _, degeneracy = registered(scene)
    assert degeneracy.text == text
    assert (degeneracy.unobservable_count > 0) == bool(degeneracy.reason) == bool(text)


def test_a_corridor_turned_half_right_is_named_by_its_direction():
    _, degeneracy = registered(corridor, T_turned=exp(np.array([0.0, 0.0, np.pi / 4]), np.zeros(3)))
    assert degeneracy.text in ("translation along (0.71, 0.71, 0.00)", "translation along (0.70, 0.71, 0.00)")


def test_shares_do_not_depend_on_where_the_sensor_stands_nor_on_metres():
    information, degeneracy = registered(tunnel)
    T_other_body = transform(np.eye(3), np.array([30.0, -20.0, 5.0]))
    _, shifted = registered(tunnel, T_turned=T_other_body)
    assert np.allclose(degeneracy.shares, shifted.shares, atol=5e-3)
    assert degeneracy.text == shifted.text

    thousandth = np.diag([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
    points = np.random.default_rng(0).normal(size=(1000, 3)) * [5.0, 3.0, 2.0]
    metres = degeneracy_of(information, points=points).shares
    kilometres = degeneracy_of(thousandth @ information @ thousandth, points=points / 1e3).shares
    assert np.allclose(metres, kilometres)


def test_unobservable_motions_move_the_cloud_by_a_metre_and_no_surface_notices():
    rng = np.random.default_rng(1)
    points = tunnel(rng)
    _, degeneracy = registered(tunnel)
    assert degeneracy.unobservable_count == 2
    radius_before = np.hypot(points[:, 1] - 1.5, points[:, 2])
    for tangent in degeneracy.motions[:2]:
        moved = apply(exp(0.01 * tangent[:3], 0.01 * tangent[3:]), points)
        assert np.sqrt(((moved - points) ** 2).sum(axis=1).mean()) == pytest.approx(0.01, rel=0.02)
        assert np.abs(np.hypot(moved[:, 1] - 1.5, moved[:, 2]) - radius_before).max() < 2e-3


@pytest.mark.parametrize("scene", [corridor, plain, tunnel, room])
def test_the_noise_grows_along_unobservable_motions_and_only_there(scene):
    information, degeneracy = registered(scene)
    without = projected(information, degeneracy)

    assert np.linalg.eigvalsh(without)[0] > 0.0
    for k, motion in enumerate(degeneracy.motions):
        before, after = motion @ information @ motion, motion @ without @ motion
        if k < degeneracy.unobservable_count:
            assert after <= degeneracy.extent_m**-2 * 1.001 < before
        else:
            assert after == pytest.approx(before)


def test_information_of_nothing_is_an_error():
    with pytest.raises(DataError, match="want some of both"):
        degeneracy_of(np.zeros((6, 6)), points=np.ones((5, 3)))
    with pytest.raises(DataError, match="from 0 points"):
        degeneracy_of(np.eye(6), points=np.empty((0, 3)))
