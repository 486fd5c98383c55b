"""The check of where and when depth images show what colour images do."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.geometry import apply, exp, inverse, log
from mapper.core.timebase import NS_PER_S, seconds_text_from_ns
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.local_map.bundle.bundle import WINDOW_KEYFRAMES, Bundle
from mapper.odometry.local_map.calibration.depth_image_check import DepthElsewhere, DepthImageCheck
from mapper.odometry.local_map.observation.depth_surfaces import depth_cells, surface_of
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.writers import write_log
from tests.support.corner_of_walls import CAMERA, INTRINSICS, depth_image, inverse_depth
from tests.support.desk_frames import ate_rmse_m, desk_frames, desk_walk

FRAME_S = 1.0 / 30.0


@pytest.fixture(scope="module")
def any_observation():
    return build_frame_odometry(LocalMapConfig()).observe(desk_frames()[0])


def observed(any_observation, T_camera_world, pixels, **depth_camera):
    """Return an observation of features at pixels whose depth image is taken at a pose, by another camera."""
    return replace(
        any_observation,
        pixels=pixels,
        depth_m=np.ones(len(pixels)),
        intrinsics=INTRINSICS,
        depth_cells=depth_cells(depth_image(T_camera_world, **depth_camera), CAMERA),
    )


class Walk:
    """A camera's motion by hand, with changing velocity."""

    def __init__(self, rng, *, constant=False):
        self.constant = constant
        self.sizes = np.repeat([0.08, 0.1], 3) * rng.uniform(0.7, 1.3, 6)
        self.rates = rng.uniform(3.0, 7.0, 6)
        self.phases = rng.uniform(0.0, 6.0, 6)

    def pose(self, time_s):
        """Return T_camera_world."""
        if self.constant:
            return inverse(exp(np.zeros(3), np.array([0.3, 0.1, 0.2]) * (time_s - 0.7)))
        twist = self.sizes * np.sin(self.rates * time_s + self.phases)
        return inverse(exp(twist[:3], twist[3:]))


def window(rng, any_observation, walk, *, offset_s, noise=1.0, **depth_camera):
    """Return a bundle of keyframes, what they observe, and where they are."""
    times_s = 0.15 * np.arange(WINDOW_KEYFRAMES)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, 150), rng.uniform(-0.45, 0.45, 150), np.ones(150)])
    pixels = rays[:, :2] * INTRINSICS[:2] + INTRINSICS[2:4]
    z = 1.0 / inverse_depth(np.eye(4), pixels)
    points = rays * z[:, np.newaxis]
    edges, features, measured, observations = [], [], [], []
    for k, time_s in enumerate(times_s):
        x, y, z = apply(walk.pose(time_s), points).T
        pixels = np.column_stack([x / z, y / z]) * INTRINSICS[:2] + INTRINSICS[2:4]
        T_depth = walk.pose(time_s + offset_s)
        observations.append(observed(any_observation, T_depth, pixels, **depth_camera))
        in_view = np.flatnonzero((pixels >= 0).all(axis=1) & (pixels <= [319, 239]).all(axis=1))
        disparities = INTRINSICS[4] * inverse_depth(T_depth, pixels)
        edges += [(k, p) for p in in_view]
        features += in_view.tolist()
        measured += np.column_stack([pixels, disparities])[in_view].tolist()
    order = np.argsort(np.array(edges)[:, 1], kind="stable")
    sigma_px = np.array([0.5, 0.5, 0.3])
    bundle = Bundle(
        poses=np.array([walk.pose(time_s) for time_s in times_s]),
        points=points,
        edges=np.array(edges, np.int32)[order],
        features=np.array(features)[order],
        measured=np.array(measured)[order] + rng.normal(0.0, noise * sigma_px, (len(order), 3)),
        weights=np.tile(sigma_px**-2, (len(order), 1)),
        intrinsics=INTRINSICS,
    )
    return bundle, observations, times_s


def checked(
    any_observation, *, offset_s=0.0, delay_s=0.0, windows=4, constant=False, unknown=0, **depth_camera
):
    """Return a check that was given windows of keyframes whose depth images are late, by another camera."""
    rng = np.random.default_rng(5)
    check = DepthImageCheck()
    for n in range(windows):
        walk = Walk(rng, constant=constant)
        keyframes = range(n * WINDOW_KEYFRAMES, (n + 1) * WINDOW_KEYFRAMES)
        bundle, observations, times_s = window(rng, any_observation, walk, offset_s=offset_s, **depth_camera)
        for keyframe, time_s in list(zip(keyframes, times_s, strict=True))[unknown:]:
            around = ((round(t * NS_PER_S), walk.pose(t)) for t in (time_s - FRAME_S, time_s + FRAME_S))
            check.pass_keyframe(keyframe, *around)
        check.add(bundle, keyframes, [replace(o, depth_delay_s=delay_s) for o in observations])
    return check


def found_offset(check):
    """Return the estimated offset and its standard deviation, seconds."""
    values, sigmas = check.estimate()
    return values[0], sigmas[0]


def test_depth_is_taken_where_points_were_when_it_was_measured(any_observation):
    rng = np.random.default_rng(0)
    walk, offset_s = Walk(rng), 0.04
    bundle, observations, times_s = window(rng, any_observation, walk, offset_s=offset_s, noise=0.0)
    twists = [
        np.concatenate(log(walk.pose(t) @ inverse(walk.pose(t + offset_s)))) / offset_s for t in times_s
    ]
    depth = DepthElsewhere(bundle, observations, [*twists[:-1], None])

    def disparities_px(value_s):
        return depth.read(bundle, np.array([value_s, 0.0, 0.0, 0.0]))[0].measured[:, 2]

    exact_px = INTRINSICS[4] / bundle.points_camera()[:, 2]
    before_px, found_px = disparities_px(0.0), disparities_px(offset_s)
    known = ~np.isnan(found_px)
    assert known.mean() > 0.6
    assert not known[bundle.edges[:, 0] == WINDOW_KEYFRAMES - 1].any()
    assert np.nanmedian(np.abs(found_px - exact_px)) < 0.1 * np.nanmedian(np.abs(before_px - exact_px))


def test_slopes_are_those_of_the_disparities(any_observation):
    rng = np.random.default_rng(0)
    bundle, observations, _ = window(rng, any_observation, Walk(rng), offset_s=0.04, noise=0.0)
    depth = DepthElsewhere(bundle, observations, rng.normal(0.0, 0.2, (WINDOW_KEYFRAMES, 6)))
    off, step = np.array([0.03, 0.05, 0.01, -0.01]), 1e-6
    slopes = depth.read(bundle, off)[1][..., 2]
    for n in range(4):
        moved = step * np.eye(4)[n]
        behind, ahead = (depth.read(bundle, off + h)[0].measured[:, 2] for h in (-moved, moved))
        difference = (ahead - behind) / (2.0 * step)
        known = ~np.isnan(difference)
        assert known.mean() > 0.5
        assert np.median(np.abs(difference - slopes[n])[known]) < 1e-4 * np.abs(slopes[n]).max()


def test_nothing_is_known_without_planes(any_observation):
    pixels = np.array([[100.0, 100.0], [-5.0, 90.0], [330.0, 90.0], [100.0, 300.0]])
    observation = observed(any_observation, np.eye(4), pixels)
    found = surface_of(observation.depth_cells).planes_at(pixels)
    assert (found[:, 3] > 0.0).tolist() == [True, False, False, False]
    x, y, z = np.append((pixels[0] - INTRINSICS[2:4]) / INTRINSICS[:2], 1.0)
    assert found[0, :3] @ [x, y, z] / found[0, 3] == pytest.approx(
        inverse_depth(np.eye(4), pixels[:1])[0], rel=0.01
    )


@pytest.mark.parametrize("offset_s", [-0.066, -0.033, 0.0, 0.033, 0.066])
def test_the_offset_is_estimated(any_observation, offset_s):
    check = checked(any_observation, offset_s=offset_s)
    found_s, sigma_s = found_offset(check)
    assert sigma_s < 0.003
    assert abs(found_s - offset_s) < 4.0 * sigma_s + 0.1 * abs(offset_s)
    doubts = check.contradictions()
    if offset_s == 0.0:
        assert doubts == []
    else:
        (doubt,) = doubts
        assert f"add {found_s:.3f} to source.depth_offset_s, which pairs images of one time" in doubt
        assert ("later" in doubt) == (offset_s > 0.0)


@pytest.mark.parametrize("factor", [0.65, 0.9, 1.0, 1.1])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (-0.03, 0.01)])
@pytest.mark.parametrize("unknown", [0, WINDOW_KEYFRAMES])
def test_magnification_and_shift_of_depth_images_are_estimated(any_observation, factor, shift, unknown):
    check = checked(any_observation, unknown=unknown, factor=factor, shift=shift)
    doubts = check.contradictions()
    if factor == 1.0:
        assert doubts == []
        return
    found, sigmas = (values[1:] for values in check.estimate())
    expected = np.array([np.log(factor), *shift])
    assert (sigmas < 0.02).all()
    assert (np.abs(found - expected) < 4.0 * sigmas + 0.1 * np.abs(expected).max()).all()
    (doubt,) = doubts
    assert doubt.startswith("depth images are not registered to the colour images: theirs is ")
    assert float(doubt.split("theirs is ")[1].split()[0]) == pytest.approx(factor, abs=0.04)


@pytest.mark.parametrize(("factor", "offset_s"), [(0.9, 0.0), (1.0, 0.066), (0.9, 0.05), (1.1, -0.05)])
def test_late_depth_and_depth_that_is_not_registered_are_told_apart(any_observation, factor, offset_s):
    check = checked(any_observation, offset_s=offset_s, factor=factor, windows=6)
    said = " ".join(check.contradictions())
    assert ("not registered" in said) == (factor != 1.0)
    assert ("source.depth_offset_s" in said) == (offset_s != 0.0)
    assert check.are_registered == (factor == 1.0)
    found, sigmas = check.estimate()
    assert abs(found[0] - offset_s) < 4.0 * sigmas[0] + 0.1 * abs(offset_s)
    assert abs(found[1] - np.log(factor)) < 4.0 * sigmas[1] + 0.01


def test_an_offset_that_the_stamps_tell_is_none(any_observation):
    found_s, sigma_s = found_offset(checked(any_observation, offset_s=0.033, delay_s=0.033))
    assert abs(found_s) < 4.0 * sigma_s


def test_windows_of_which_half_the_velocities_are_known_tell_it(any_observation):
    found_s, sigma_s = found_offset(checked(any_observation, offset_s=0.066, unknown=5))
    assert sigma_s < 0.005
    assert abs(found_s - 0.066) < 4.0 * sigma_s + 0.0066
    assert checked(any_observation, offset_s=0.066, unknown=6).contradictions() == []


def test_a_camera_at_rest_tells_no_offset(any_observation):
    still = Walk(np.random.default_rng(1))
    still.sizes = np.zeros(6)
    check = DepthImageCheck()
    rng = np.random.default_rng(2)
    for n in range(3):
        keyframes = range(n * WINDOW_KEYFRAMES, (n + 1) * WINDOW_KEYFRAMES)
        bundle, observations, times_s = window(rng, any_observation, still, offset_s=0.0)
        for keyframe, time_s in zip(keyframes, times_s, strict=True):
            trembling = exp(rng.normal(0.0, 1e-5, 3), rng.normal(0.0, 1e-5, 3))
            stamps_ns = (round(t * NS_PER_S) for t in (time_s - FRAME_S, time_s + FRAME_S))
            check.pass_keyframe(keyframe, *zip(stamps_ns, (np.eye(4), trembling), strict=True))
        check.add(bundle, keyframes, observations)
    assert abs(found_offset(check)[0]) < 0.1
    assert check.contradictions() == []


def test_constant_velocity_hardly_tells_it(any_observation):
    checks = [checked(any_observation, offset_s=0.033, constant=constant) for constant in (False, True)]
    sigmas_s = [found_offset(check)[1] for check in checks]
    assert sigmas_s[1] > 5.0 * sigmas_s[0]


def test_few_windows_contradict_nothing(any_observation):
    check = checked(any_observation, offset_s=0.066, factor=0.65, windows=2)
    assert check.estimate() is None
    assert check.contradictions() == []


def test_a_late_depth_camera_is_told_and_mended(tmp_path):
    walk = desk_walk()
    write_log(walk, tmp_path, kind="tum")
    depth_list = tmp_path / "depth.txt"
    images = [line.split()[1] for line in depth_list.read_text().splitlines() if not line.startswith("#")]
    frame_ns = int(walk.stamps_ns[1] - walk.stamps_ns[0])
    late = [
        f"{seconds_text_from_ns(int(stamp_ns) - frame_ns)} {image}\n"
        for stamp_ns, image in zip(walk.stamps_ns[1:], images[1:], strict=True)
    ]
    depth_list.write_text("".join(late))
    doubt, error_m = tracked(tmp_path)
    assert "ms later than colour images of the same stamps" in doubt
    offset_s = float(doubt.split("add ")[1].split(" to source.depth_offset_s")[0])
    assert abs(offset_s - frame_ns / NS_PER_S) < 0.01
    mended, mended_m = tracked(tmp_path, f"source.depth_offset_s={offset_s}")
    assert mended == ""
    assert mended_m < 0.8 * error_m


def tracked(folder, *overrides):
    """Return the warning about the camera, if any, and the ATE."""
    settings = ["odometry.max_keyframe_gap=1", "loops.kind=none", *overrides]
    config = load_config(None, settings, sensor="rgbd")
    source = open_source(folder, config.source)
    result = track_log(source, config, progress=SILENT)
    doubts = [warning.sentence for warning in result.warnings if warning.kind == "camera"]
    return "".join(doubts), ate_rmse_m(result.trajectory(), desk_walk().truth)
