"""What disturbs a synthetic recording, and the errors of a sensor that nobody calibrated."""

import json

import numpy as np
import pytest

from mapper.simulation import CameraSimulator, write_tum_log
from mapper.simulation.config import (
    DisturbanceConfig,
    SensorConfig,
    SynthConfig,
)
from mapper.simulation.kinect import BASELINE_M, DISPARITY_FOCAL_PX
from mapper.simulation.path import seconds_of
from mapper.simulation.shutter import make_lens
from mapper.simulation.source import camera_of, gain_at
from tests.support.ideal_sensors import IDEAL_SENSOR

PLAIN = SynthConfig(
    furniture_per_room=2,
    posters_per_room=2,
    texture_px_per_m=16,
    width_px=160,
    height_px=120,
    frame_rate_hz=10.0,
    duration_s=6.0,
    sensor=IDEAL_SENSOR,
)
SPIN = PLAIN.model_copy(update={"path": "spin", "max_yaw_rate_rad_s": 2.0})


def changed(config, **knobs):
    return config.model_copy(update=knobs)


def disturbed(source, **knobs):
    return CameraSimulator(changed(PLAIN, disturbances=DisturbanceConfig(**knobs)), source.scene)


def seen_by(source, **knobs):
    return CameraSimulator(changed(SPIN, sensor=changed(IDEAL_SENSOR, **knobs)), source.scene)


@pytest.fixture(scope="module")
def source():
    return CameraSimulator(PLAIN)


def test_a_gap_has_no_frames_and_the_rest_is_as_it_was(source):
    gap = disturbed(source, gap_start_s=2.0, gap_duration_s=1.5).log()

    seconds = seconds_of(gap.stamps_ns)
    assert len(gap) == len(source.truth) - 15
    assert not ((seconds >= 2.0) & (seconds < 3.5)).any()
    np.testing.assert_array_equal(gap.entry_at(25).load().image, source.observe(40).image)


def test_a_frozen_camera_repeats_a_frame_while_the_truth_goes_on(source):
    frozen = disturbed(source, freeze_start_s=2.0, freeze_duration_s=1.0)

    before, during, after = (frozen.observe(index) for index in (19, 29, 30))
    np.testing.assert_array_equal(during.image, before.image)
    np.testing.assert_array_equal(during.depth_m, before.depth_m)
    assert during.stamp_ns == source.observe(29).stamp_ns
    np.testing.assert_array_equal(after.image, source.observe(30).image)
    moved_m = np.linalg.norm(frozen.truth.positions_world[29] - frozen.truth.positions_world[19])
    assert moved_m > 0.3


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_a_hand_covers_its_share_of_image_and_depth(source, share):
    behind = disturbed(source, hand_start_s=2.0, hand_duration_s=1.0, hand_share=share, hand_distance_m=0.45)

    for index in (20, 27):
        bare, covered = source.observe(index), behind.observe(index)
        is_near = covered.depth_m < 0.55
        assert is_near.mean() == pytest.approx(share, abs=0.03)
        assert covered.depth_m[is_near].min() >= 0.45
        np.testing.assert_array_equal(covered.depth_m[~is_near], bare.depth_m[~is_near])
        assert (covered.image[is_near] != bare.image[is_near]).any(axis=1).mean() > 0.95
    np.testing.assert_array_equal(behind.observe(30).image, source.observe(30).image)


def test_the_gain_jumps_at_each_step_and_saturates(source):
    config = DisturbanceConfig(gain_step_s=1.0, gain_factor=4.0)
    gains = [gain_at(config, step + 0.5, seed=PLAIN.seed) for step in range(6)]

    assert gains[0] == 1.0
    assert all(2.0 <= gain <= 4.0 for gain in gains[1::2])
    assert all(0.25 <= gain <= 0.5 for gain in gains[2::2])
    stepping = CameraSimulator(changed(PLAIN, disturbances=config), source.scene)
    bright, dark = stepping.observe(15), stepping.observe(25)
    assert (bright.image == 255).mean() > 0.1 + (source.observe(15).image == 255).mean()
    assert dark.image.mean() == pytest.approx(gains[2] * source.observe(25).image.mean(), rel=0.02)
    np.testing.assert_array_equal(dark.depth_m, source.observe(25).depth_m)


def test_people_cross_the_view_and_keep_off_the_camera():
    hall = changed(PLAIN, scene="hall", hall_length_m=9.0, hall_width_m=8.0, hall_clearance_m=2.6, people=4)
    crowd = CameraSimulator(hall)
    empty = CameraSimulator(changed(hall, people=0), crowd.scene)

    shares = []
    for index in range(0, len(crowd.truth), 2):
        seen, bare = crowd.render(index).depth_m, empty.render(index).depth_m
        shares.append((seen < bare - 0.05).mean())
        camera = crowd.truth.positions_world[index]
        people = crowd.movers.boxes_at(float(seconds_of(crowd.truth.stamps_ns[index : index + 1])[0]))
        assert people.signed_distance_m(camera[None])[0] > 0.2
    assert np.mean(np.array(shares) > 0.03) > 0.25, "in many frames somebody is seen"
    assert max(shares) > 0.1


def test_people_stand_in_the_middle_of_the_view_before_they_walk_on():
    hall = changed(PLAIN, scene="hall", hall_length_m=9.0, hall_width_m=8.0, hall_clearance_m=2.6, people=2)
    standing = CameraSimulator(changed(hall, people_stand_s=1.5)).movers.walkers
    np.testing.assert_array_equal(standing.positions.shape, (2, 2))
    for person, stop_s in enumerate(standing.stops_s):
        where = [standing.at(float(stop_s + after_s))[person] for after_s in (-0.5, 0.0, 0.7, 1.5, 2.0)]
        np.testing.assert_allclose(where[1:4], [where[1]] * 3)
        step = 0.5 * standing.velocities_mps[person]
        np.testing.assert_allclose([where[1] - where[0], where[4] - where[3]], [step, step])


def test_a_rolling_shutter_shows_each_row_at_its_own_time(source):
    rolling = seen_by(source, readout_s=0.1)
    still = seen_by(source)
    index, camera = 20, camera_of(SPIN)
    seconds = seconds_of(still.truth.stamps_ns[index : index + 1])

    image = rolling.render(index)
    differs = np.abs(image.depth_m - still.render(index).depth_m) > 0.01
    height = camera.height_px
    assert differs[: height // 4].mean() > 2.0 * differs[height // 2 - 4 : height // 2 + 4].mean()
    early = still._shutter.take(float(seconds[0]) - 0.05, still.motion.poses(seconds - 0.05)[0])
    np.testing.assert_allclose(image.depth_m[0], early.depth_m[0], atol=0.05)


def test_depth_of_a_delay_is_that_of_the_later_pose(source):
    late = seen_by(source, depth_delay_s=0.1).render(20)
    now, later = seen_by(source).render(20), seen_by(source).render(21)

    np.testing.assert_array_equal(late.rgb, now.rgb)
    np.testing.assert_allclose(late.depth_m, later.depth_m, atol=1e-5)


def test_a_lens_moves_points_as_brown_says():
    camera, k1, k2 = camera_of(changed(PLAIN, width_px=320, height_px=240)), 0.05, -0.08
    lens = make_lens(camera, k1=k1, k2=k2)

    row, column = 30, 290
    ideal = np.array([lens.columns[row, column] - lens.wide.cx_px, lens.rows[row, column] - lens.wide.cy_px])
    x, y = ideal / camera.fx_px
    square = x**2 + y**2
    bend = 1.0 + k1 * square + k2 * square**2
    assert camera.fx_px * x * bend + camera.cx_px == pytest.approx(column, abs=1e-3)
    assert camera.fy_px * y * bend + camera.cy_px == pytest.approx(row, abs=1e-3)
    assert lens.columns.min() >= 0.0
    assert lens.columns.max() <= lens.wide.width_px - 1
    assert abs(lens.columns[row, column] - (column + lens.wide.cx_px - camera.cx_px)) > 0.5


@pytest.mark.parametrize("distortion", [{"radial_k1": -0.1}, {"radial_k2": -0.3}], ids=["k1", "k2"])
def test_a_lens_bends_image_and_depth(source, distortion):
    bent, straight = seen_by(source, **distortion).render(20), seen_by(source).render(20)
    middle = (slice(58, 62), slice(78, 82))
    np.testing.assert_allclose(bent.depth_m[middle], straight.depth_m[middle], atol=0.02)
    assert (np.abs(bent.rgb.astype(int) - straight.rgb)[:20] > 10).mean() > 0.1


def test_depth_ends_where_it_is_too_near_and_fades_far_away(source):
    exact = seen_by(source).observe(20).depth_m
    low_m, middle_m, high_m = np.quantile(exact, [0.2, 0.6, 1.0])
    near = seen_by(source, min_depth_m=middle_m).observe(20).depth_m
    np.testing.assert_array_equal(near, np.where(exact < np.float32(middle_m), np.float32(0.0), exact))

    faded = seen_by(source, fade_depth_m=low_m, max_depth_m=high_m).observe(20).depth_m == 0.0
    parts = (exact < low_m, (exact > low_m) & (exact < middle_m), exact > middle_m)
    near_lost, middle_lost, far_lost = (faded[part].mean() for part in parts)
    assert near_lost < 0.05
    assert near_lost < middle_lost < far_lost


def test_depth_is_scaled_and_its_disparity_warped_alike_in_all_frames(source):
    scaled = seen_by(source, depth_scale=1.02).observe(20).depth_m
    exact = seen_by(source).observe(20).depth_m
    np.testing.assert_allclose(scaled, 1.02 * exact, rtol=1e-5)

    warped = seen_by(source, disparity_warp_px=0.3)
    errors = [
        BASELINE_M * DISPARITY_FOCAL_PX * (1.0 / warped.observe(k).depth_m - 1.0 / warped.render(k).depth_m)
        for k in (5, 40)
    ]
    np.testing.assert_allclose(errors[0], errors[1], atol=1e-3)
    assert errors[0].std() == pytest.approx(0.3, rel=0.1)
    assert np.abs(np.diff(errors[0], axis=1)).max() < 0.05


def test_later_settings_are_written_only_where_they_are_set(tmp_path):
    tiny = changed(PLAIN, duration_s=0.1)
    rough = changed(
        tiny,
        people=1,
        people_stand_s=0.5,
        sensor=SensorConfig(readout_s=0.01),
        disturbances=DisturbanceConfig(hand_share=0.5),
    )
    written = {}
    for name, config in {"plain": tiny, "rough": rough}.items():
        write_tum_log(tmp_path / name, config)
        written[name] = json.loads((tmp_path / name / "scene.json").read_text())["config"]

    later = {"scene", "people", "people_stand_s", "disturbances", "texture_contrast", "hall_length_m"}
    assert not later & set(written["plain"])
    assert not {"readout_s", "radial_k1", "depth_scale"} & set(written["plain"]["sensor"])
    assert written["rough"]["people"] == 1
    assert written["rough"]["sensor"]["readout_s"] == 0.01
    assert written["rough"]["disturbances"]["hand_share"] == 0.5
    assert SynthConfig(**written["rough"]) == rough
