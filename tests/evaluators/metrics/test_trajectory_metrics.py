import json

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D

from mapper.core.errors import DataError
from mapper.core.geometry import exp, rotation_exp, transform
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.evaluators.metrics.trajectory_errors import Matched, align, associate, ate, rpe, start_end_offset
from mapper.sources.trajectory_files import read_kitti, read_tum, write_kitti
from tests.support.paths import SHARED

TRAJECTORIES = SHARED / "data/trajectories"
needs_trajectories = pytest.mark.skipif(not TRAJECTORIES.is_dir(), reason=f"{TRAJECTORIES} is not here")

MS = 1_000_000


def walk(n, *, seed, step_ns=33 * MS, jitter_ns=10 * MS, start_ns=1305031102175304000):
    rng = np.random.default_rng(seed)
    T, poses = exp(rng.normal(0, 1, 3), rng.normal(0, 1, 3)), []
    for _ in range(n):
        T = T @ exp(rng.normal(0, 0.05, 3), rng.normal(0, 0.1, 3))
        poses.append(T)
    stamps_ns = start_ns + np.arange(n) * step_ns + rng.integers(0, jitter_ns, n)
    return Trajectory(stamps_ns.astype(np.int64), np.array(poses))


def shaken(trajectory, *, seed, every=1, scale=1.0):
    """The same motion seen from elsewhere, with noise, at slightly other stamps, and with gaps."""
    rng = np.random.default_rng(seed)
    T_new_world = exp(rng.normal(0, 1, 3), rng.normal(0, 3, 3))
    poses = []
    for T in trajectory.T_world_body[::every]:
        moved = T_new_world @ T @ exp(rng.normal(0, 0.01, 3), rng.normal(0, 0.02, 3))
        moved[:3, 3] *= scale
        poses.append(moved)
    stamps_ns = trajectory.stamps_ns[::every] + rng.integers(-11 * MS, 11 * MS, len(poses))
    keep = rng.random(len(poses)) < 0.9
    return Trajectory(stamps_ns[keep], np.array(poses)[keep])


def in_evo(trajectory, zero_ns):
    # Seconds after the first stamp: floats hold those exactly enough, epoch seconds they do not.
    seconds = (trajectory.stamps_ns - zero_ns) * 1e-9
    return PoseTrajectory3D(poses_se3=list(trajectory.T_world_body), timestamps=seconds)


def evo_statistics(metric, pair):
    metric.process_data(pair)
    return metric.get_all_statistics()


def assert_same(ours, theirs):
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(ours, name) == pytest.approx(theirs[name], rel=1e-9, abs=1e-9), name


@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("swap", [False, True], ids=["few-estimates", "many-estimates"])
def test_evo_agrees(alignment, every, swap):
    truth = walk(400, seed=every)
    estimate = shaken(truth, seed=every + 10, every=every, scale=0.8 if alignment == "sim3" else 1.0)
    if swap:
        truth, estimate = estimate, truth

    zero_ns = int(truth.stamps_ns[0])
    reference, other = sync.associate_trajectories(
        in_evo(truth, zero_ns), in_evo(estimate, zero_ns), max_diff=0.02
    )
    if alignment != "none":
        other.align(reference, correct_scale=alignment == "sim3")
    matched = associate(estimate, truth)
    aligned = align(matched, alignment).moved(matched)

    assert len(matched) == reference.num_poses
    np.testing.assert_allclose(aligned.T_truth_body[:, :3, 3], reference.positions_xyz)
    np.testing.assert_allclose(aligned.T_map_body[:, :3, 3], other.positions_xyz, atol=1e-9)
    assert_same(ate(aligned), evo_statistics(metrics.APE(), (reference, other)))
    ours = rpe(aligned)
    assert_same(ours.translation_m, evo_statistics(metrics.RPE(), (reference, other)))
    angle = metrics.PoseRelation.rotation_angle_rad
    assert_same(ours.rotation_rad, evo_statistics(metrics.RPE(angle), (reference, other)))


@pytest.mark.parametrize(("delta", "unit"), [(7, "frames"), (1.0, "m"), (4.0, "m")])
def test_evo_agrees_over_longer_steps(delta, unit):
    truth = walk(300, seed=5)
    matched = associate(shaken(truth, seed=6), truth)
    pair = tuple(
        PoseTrajectory3D(poses_se3=list(poses), timestamps=np.arange(len(matched)))
        for poses in (matched.T_truth_body, matched.T_map_body)
    )
    evo_unit = {"frames": metrics.Unit.frames, "m": metrics.Unit.meters}[unit]
    oracle = metrics.RPE(delta=delta, delta_unit=evo_unit, all_pairs=True, pairs_from_reference=True)
    ours = rpe(matched, delta=delta, unit=unit)
    assert_same(ours.translation_m, evo_statistics(oracle, pair))
    assert ours.pairs == len(oracle.E) > 100


def test_steps_in_seconds_are_found_by_the_stamps():
    stamps_ns = np.array([0, 400, 1000, 1450, 2600, 9000]) * MS
    position = np.arange(6.0) ** 2
    truth = np.array([transform(np.eye(3), [x, 0.0, 0.0]) for x in position])
    matched = Matched(stamps_ns, np.array([np.eye(4)] * 6), truth)
    errors = rpe(matched, delta=1.0, unit="s")  # 0 → 1000, 400 → 1450; the others miss by more than a tenth
    assert errors.pairs == 2
    assert (errors.translation_m.min, errors.translation_m.max) == (4.0, 8.0)


@needs_trajectories
@pytest.mark.parametrize(
    ("row", "estimate", "truth"),
    [
        ("fr1_xyz rgbdslam", "freiburg1_xyz-rgbdslam.txt", "freiburg1_xyz-groundtruth.txt"),
        ("fr2_desk ORB", "fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt"),
        ("KITTI_00 ORB", "KITTI_00_ORB.txt", "KITTI_00_gt.txt"),
    ],
)
def test_published_values_are_met(row, estimate, truth):
    published = json.loads((SHARED / "reference/published.json").read_text())["trajectory_oracle"]["rows"]
    pairs, ate_m, rpe_m, rpe_deg = published[row]
    read = read_kitti if row.startswith("KITTI") else read_tum

    found = {
        m.name: m
        for m in evaluate(read(TRAJECTORIES / estimate), read(TRAJECTORIES / truth), alignment="se3")
    }

    assert found["matched poses"].value == pairs
    # The KITTI figure is printed with five decimals only.
    assert found["ATE RMSE, SE(3)-aligned"].value == pytest.approx(ate_m, abs=1e-6 if ate_m < 1.0 else 5e-6)
    if rpe_m is not None:
        assert found["RPE translation RMSE, consecutive"].value == pytest.approx(rpe_m, abs=1e-6)
        # One estimate lies exactly between two truths of fr2_desk: in nanoseconds that is a tie, which the
        # earlier wins; in evo's float seconds the later one is nearer by rounding, worth 2e-6 degrees.
        assert np.degrees(found["RPE rotation RMSE, consecutive"].value) == pytest.approx(rpe_deg, abs=5e-6)


def test_a_gap_of_exactly_the_limit_still_counts():
    truth = walk(50, seed=0, jitter_ns=1)
    assert len(associate(Trajectory(truth.stamps_ns[:1] + 20 * MS, truth.T_world_body[:1]), truth)) == 1
    before = Trajectory(truth.stamps_ns[:1] - 20 * MS - 1, truth.T_world_body[:1])
    with pytest.raises(DataError, match="the closest pair is 20 ms apart"):
        associate(before, truth)


def test_too_few_poses_are_refused():
    two = walk(2, seed=0)
    with pytest.raises(DataError, match="2 matched poses: an alignment by se3 needs 3"):
        evaluate(two, two)
    with pytest.raises(DataError, match="no two of the 2 matched poses are that far apart"):
        rpe(associate(two, two), delta=5)
    with pytest.raises(DataError, match="the step must be > 0"):
        rpe(associate(two, two), delta=0.0)
    nothing = Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4)))
    with pytest.raises(DataError, match="the truth has no poses"):
        associate(two, nothing)
    with pytest.raises(DataError, match="no poses"):
        evaluate(nothing, two)


def test_a_closed_log_tells_its_offset_without_truth():
    closed = walk(30, seed=1)
    T_start_end = exp(np.array([0.0, 0.2, 0.0]), np.zeros(3)) @ transform(np.eye(3), [0.03, 0.04, 0.0])
    T_world_body = np.concatenate([closed.T_world_body, [closed.T_world_body[0] @ T_start_end]])
    log = Trajectory(np.append(closed.stamps_ns, closed.stamps_ns[-1] + MS), T_world_body)
    assert start_end_offset(log) == pytest.approx((0.05, 0.2))
    names = [metric.name for metric in evaluate(log, None)]
    assert names == ["path length", "start-to-end offset", "start-to-end rotation"]


def test_the_alignment_is_stated_and_scale_only_where_it_was_fitted():
    truth = walk(50, seed=2)
    half = Trajectory(truth.stamps_ns, truth.T_world_body.copy())
    half.T_world_body[:, :3, 3] *= 0.5
    values = {m.name: m.value for m in evaluate(half, truth, alignment="sim3")}
    assert values["ATE RMSE, Sim(3)-aligned"] == pytest.approx(0.0, abs=1e-9)
    assert values["scale of the estimate"] == pytest.approx(2.0)
    for kind, stated in (("none", "ATE RMSE, not aligned"), ("se3", "ATE RMSE, SE(3)-aligned")):
        names = [metric.name for metric in evaluate(half, truth, alignment=kind)]
        assert stated in names
        assert "scale of the estimate" not in names


@pytest.mark.parametrize("seed", range(4))
def test_a_yaw_alignment_is_the_best_of_all_turns_about_z(seed):
    truth = walk(80, seed=seed)
    matched = associate(shaken(truth, seed=seed + 20), truth)
    positions, true = matched.T_map_body[:, :3, 3], matched.T_truth_body[:, :3, 3]

    def rmse(yaw_rad):
        R = rotation_exp(np.array([0.0, 0.0, yaw_rad]))
        misses = (true - true.mean(axis=0)) - (positions - positions.mean(axis=0)) @ R.T
        return np.sqrt((misses**2).sum(axis=1).mean())

    T_truth_map = align(matched, "yaw").T_truth_map
    found = ate(align(matched, "yaw").moved(matched)).rmse

    np.testing.assert_allclose(T_truth_map[2, :3], [0.0, 0.0, 1.0], atol=1e-12)
    assert found <= min(rmse(yaw) for yaw in np.linspace(-np.pi, np.pi, 3601)) + 1e-12
    assert found >= ate(align(matched, "se3").moved(matched)).rmse


def test_a_level_estimate_is_laid_on_the_truth_by_yaw_alone_and_a_tilted_one_is_told():
    truth = walk(60, seed=8)
    T_turned = transform(rotation_exp(np.array([0.0, 0.0, 2.5])), [4.0, -3.0, 2.0])
    level = {m.name: m.value for m in evaluate(truth.moved(T_turned), truth, alignment="yaw")}
    assert level["ATE RMSE, yaw-aligned"] < 1e-9
    assert level["tilt that SE(3) would add"] < 1e-6
    tilted = truth.moved(exp(np.array([0.3, 0.0, 0.0]), np.zeros(3)))
    values = {m.name: m.value for m in evaluate(tilted, truth, alignment="yaw")}
    assert values["tilt that SE(3) would add"] == pytest.approx(0.3)
    assert values["ATE RMSE, yaw-aligned"] > 0.1


def test_two_kitti_texts_of_different_lengths_are_refused(tmp_path):
    """Lines are all that pairs them: without the first five poses of one, all pairs would be wrong."""
    truth = walk(40, seed=3)
    write_kitti(tmp_path / "truth.txt", truth)
    write_kitti(tmp_path / "same.txt", truth)
    write_kitti(tmp_path / "late.txt", truth[5:])
    assert evaluate(tmp_path / "same.txt", tmp_path / "truth.txt").ate_m < 1e-6
    with pytest.raises(DataError, match=r"late\.txt has 35 poses and .*truth\.txt 40: .* paired by line"):
        evaluate(tmp_path / "late.txt", tmp_path / "truth.txt")


def mulran_text(trajectory):
    pairs = zip(trajectory.stamps_ns.tolist(), trajectory.T_world_body, strict=True)
    return "".join(f"{stamp_ns},{','.join(map(repr, T[:3].ravel().tolist()))}\n" for stamp_ns, T in pairs)


def test_mulran_s_poses_are_matrices_and_not_euroc_s(tmp_path):
    """global_pose.csv has whole nanoseconds, as EuRoC's files have, and twelve numbers in UTM coordinates."""
    truth = walk(40, seed=4)
    far = Trajectory(truth.stamps_ns, transform(np.eye(3), [3.5e5, 4.02e6, 20.0]) @ truth.T_world_body)
    lines = mulran_text(far).splitlines(keepends=True)
    (tmp_path / "global_pose.csv").write_text("".join([*lines, lines[-1]]))
    found = evaluate(truth, tmp_path / "global_pose.csv")
    assert found.ate_m < 1e-6


def test_what_only_begins_as_euroc_s_is_refused(tmp_path):
    (tmp_path / "gps.csv").write_text("".join(f"140363657976355558{k},1,2,3,4,5,6,7\n" for k in range(5)))
    with pytest.raises(DataError, match=r"gps\.csv:1: columns 5 to 8 have length 11\.22; want EuRoC's unit"):
        evaluate(walk(5, seed=5), tmp_path / "gps.csv")


def test_mulran_s_poses_in_disorder_are_refused(tmp_path):
    lines = mulran_text(walk(5, seed=6)).splitlines()
    (tmp_path / "poses.csv").write_text("\n".join([lines[1], lines[0]]) + "\n")
    with pytest.raises(DataError, match=r"poses\.csv:2: stamp \d+ comes before the line above"):
        evaluate(walk(5, seed=6), tmp_path / "poses.csv")
