"""The check of whether depth images are registered to colour images."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.geometry import apply, exp
from mapper.odometry.local_map.bundle import WINDOW_KEYFRAMES, Bundle
from mapper.odometry.local_map.depth_surfaces import depth_cells, surface_of
from mapper.odometry.local_map.registration_check import DepthElsewhere, RegistrationCheck
from tests.support.corner_of_walls import CAMERA, INTRINSICS, depth_image, inverse_depth

POINTS = 250


def window(rng, **depth_camera):
    """Return a bundle of keyframes before the walls, and their depth images, read at the colour's pixels."""
    rays = np.column_stack([rng.uniform(-0.6, 0.6, POINTS), rng.uniform(-0.45, 0.45, POINTS)])
    pixels = rays * INTRINSICS[:2] + INTRINSICS[2:4]
    points = np.column_stack([rays, np.ones(POINTS)]) / inverse_depth(np.eye(4), pixels)[:, np.newaxis]
    poses = [exp(rng.normal(0.0, 0.1, 3), rng.normal(0.0, 0.15, 3)) for _ in range(WINDOW_KEYFRAMES)]
    edges, measured, observations = [], [], []
    for k, T in enumerate(poses):
        x, y, z = apply(T, points).T
        pixels = np.column_stack([x / z, y / z]) * INTRINSICS[:2] + INTRINSICS[2:4]
        cells = depth_cells(depth_image(T, **depth_camera), CAMERA)
        observations.append(SimpleNamespace(pixels=pixels, depth_cells=cells))
        planes = surface_of(cells).planes_at(pixels)
        ideal = np.column_stack([(pixels - INTRINSICS[2:4]) / INTRINSICS[:2], np.ones(POINTS)])
        known = planes[:, 3] > 0.0
        inverse_m = (planes[known, :3] * ideal[known]).sum(axis=1) / planes[known, 3]
        edges += [(k, p) for p in np.flatnonzero(known)]
        measured += np.column_stack([pixels[known], INTRINSICS[4] * inverse_m]).tolist()
    edges, sigma_px = np.array(edges, np.int32), np.array([0.5, 0.5, 0.3])
    order = np.argsort(edges[:, 1], kind="stable")
    noisy = np.array(measured) + rng.normal(0.0, sigma_px, (len(edges), 3))
    weights = np.tile(sigma_px**-2, (len(edges), 1))
    bundle = Bundle(np.array(poses), points, edges[order], edges[order, 1], noisy[order], weights, INTRINSICS)
    return bundle, observations


def checked(*, windows=4, **depth_camera):
    rng = np.random.default_rng(2)
    check = RegistrationCheck()
    for _ in range(windows):
        check.add(*window(rng, **depth_camera))
    return check


@pytest.mark.parametrize("factor", [0.65, 0.9, 1.0, 1.1])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (-0.03, 0.01)])
def test_magnification_and_shift_of_depth_images_are_estimated(factor, shift):
    check = checked(factor=factor, shift=shift)
    found, sigmas = check.estimate()
    expected = np.array([np.log(factor), *shift])
    assert (sigmas < 0.02).all()
    assert (np.abs(found - expected) < 4.0 * sigmas + 0.1 * np.abs(expected).max()).all()
    doubt = check.contradiction()
    if factor == 1.0:
        assert doubt == ""
    else:
        assert doubt.startswith("depth images are not registered to the colour images: theirs is ")
        assert float(doubt.split("theirs is ")[1].split()[0]) == pytest.approx(factor, abs=0.04)


def test_few_windows_contradict_nothing():
    check = checked(windows=2, factor=0.65)
    assert check.estimate() is None
    assert check.contradiction() == ""


def test_slopes_are_those_of_the_disparities():
    bundle, observations = window(np.random.default_rng(0))
    depth, off, step = DepthElsewhere(bundle, observations), np.array([0.05, 0.01, -0.01]), 1e-6
    slopes = depth.read(bundle, off)[1][..., 2]
    for n in range(3):
        moved = step * np.eye(3)[n]
        behind, ahead = (depth.read(bundle, off + h)[0].measured[:, 2] for h in (-moved, moved))
        difference = (ahead - behind) / (2.0 * step)
        known = ~np.isnan(difference)
        assert known.mean() > 0.5
        assert np.median(np.abs(difference - slopes[n])[known]) < 1e-4 * np.abs(slopes[n]).max()
