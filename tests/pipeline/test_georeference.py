"""A path is placed on Earth by its fixes, and corrected by them only where it has drifted."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.geodesy import GeodeticOrigin
from mapper.core.geometry import fit_rigid
from mapper.core.rotations import rotation_from_euler
from mapper.core.timebase import NS_PER_S
from mapper.graph.config import GnssFactorsConfig, GraphConfig
from mapper.graph.optimize import optimize
from mapper.pipeline.build import build
from mapper.pipeline.georeference import georeference
from mapper.sensing.gnss import GnssFixes
from mapper.simulation.config import STREET
from mapper.simulation.gnss_config import SynthGnssConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.simulation.readings import measure_gnss
from tests.support.drives import drive, tracked, truth_of

CONFIG = GraphConfig()
LENGTH_M, DURATION_S = 600.0, 58.0
MULTIPATH = {"multipath_start_s": 20.0, "multipath_duration_s": 12.0}
SEEDS = range(40, 43)


def fixes_of(seed: int, length_m: float = LENGTH_M, duration_s: float = DURATION_S, **settings) -> GnssFixes:
    config = SynthGnssConfig(**settings)
    rng = np.random.default_rng(seed + 1000)
    return measure_gnss(config, drive(length_m), duration_s=duration_s, rng=rng)


def truth(length_m: float = LENGTH_M, duration_s: float = DURATION_S):
    return truth_of(drive(length_m), duration_s)


def ate_m(tracking, known) -> float:
    return aligned_m(tracking.tracked_trajectory().positions_world, known)


def aligned_m(positions: np.ndarray, known) -> float:
    T, _ = fit_rigid(known.positions_world, positions)
    off = known.positions_world - (positions @ T[:3, :3].T + T[:3, 3])
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def true_enu(known, origin: GeodeticOrigin) -> np.ndarray:
    """The true positions in a map's frame."""
    config = SynthGnssConfig()
    of_scene = GeodeticOrigin(config.latitude_deg, config.longitude_deg, config.height_m)
    R_enu_scene = rotation_from_euler(0.0, 0.0, config.heading_rad)
    return origin.enu(of_scene.geodetic(known.positions_world @ R_enu_scene.T))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_path_without_drift_keeps_its_shape_and_gets_its_place(seed):
    known = truth()
    before = tracked(known, seed)
    placed = georeference(before, fixes_of(seed), CONFIG)
    assert placed.report is not None
    assert not placed.report.is_corrected
    assert placed.tracking.graph.fixes == ()
    assert ate_m(placed.tracking, known) == pytest.approx(ate_m(before, known), rel=1e-6)
    here = placed.tracking.tracked_trajectory().positions_world
    np.testing.assert_allclose(here[0], before.tracked_trajectory().positions_world[0], atol=1e-9)
    off_m = np.linalg.norm((here - true_enu(known, placed.report.origin))[:, :2], axis=1)
    assert off_m.max() < 3.0  # of receivers that err by 1.1 m
    assert [(w.kind, w.weight) for w in placed.warnings] == [("gnss", "note")]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("errors", [{}, MULTIPATH], ids=["open sky", "multipath"])
def test_a_path_that_drifted_is_corrected_and_multipath_does_not_bend_it(seed, errors):
    known = truth()
    before = tracked(known, seed, drift=0.02)
    placed = georeference(before, fixes_of(seed, **errors), CONFIG)
    assert placed.report.is_corrected
    assert ate_m(before, known) > 3.5
    assert ate_m(placed.tracking, known) < 1.8
    assert placed.report.residual_m < placed.report.residual_before_m
    reflected = round(MULTIPATH["multipath_duration_s"] * 5.0) if errors else 0
    assert placed.report.outliers == pytest.approx(reflected, abs=3)
    assert len(placed.tracking.graph.fixes) == placed.report.fixes - placed.report.outliers


@pytest.mark.parametrize("seed", SEEDS)
def test_multipath_leaves_a_path_without_drift_as_it_is(seed):
    known = truth()
    before = tracked(known, seed)
    placed = georeference(before, fixes_of(seed, **MULTIPATH), CONFIG)
    assert not placed.report.is_corrected
    assert placed.report.outliers == pytest.approx(60, abs=3)
    assert ate_m(placed.tracking, known) == pytest.approx(ate_m(before, known), rel=1e-6)


def test_accurate_fixes_place_the_path_as_accurately():
    known = truth()
    fixes = fixes_of(3, noise_m=0.01, bias_m=0.01)
    for drift in (0.0, 0.02):
        placed = georeference(tracked(known, 3, drift=drift), fixes, CONFIG)
        here = placed.tracking.tracked_trajectory().positions_world
        assert np.abs(here - true_enu(known, placed.report.origin)).max() < (1.8 if drift else 0.25)


def test_a_solve_of_the_corrected_graph_returns_to_it():
    placed = georeference(tracked(truth(), 5, drift=0.02), fixes_of(5), CONFIG).tracking.graph
    shift = np.eye(4)
    shift[:3, 3] = [30.0, -20.0, 5.0]
    away = placed.with_poses({node: shift @ T for node, T in placed.T_world_node.items()})
    solved = optimize(away, CONFIG)
    poses = np.array(list(solved.T_world_node.values()))
    np.testing.assert_allclose(poses[:, :3, 3], placed.poses[:, :3, 3], atol=0.2)


def test_fixes_during_a_part_of_the_path_are_enough():
    known = truth()
    before = tracked(known, 7, drift=0.02)
    placed = georeference(before, fixes_of(7, outage_start_s=15.0, outage_duration_s=25.0), CONFIG)
    assert placed.report.is_corrected
    assert ate_m(placed.tracking, known) < 0.6 * ate_m(before, known)


def refused(tracking, fixes, config=CONFIG) -> str:
    """The weight of the warning about fixes that are not used, and leave the path as it is."""
    placed = georeference(tracking, fixes, config)
    assert placed.tracking is tracking
    assert placed.report is None
    (warning,) = placed.warnings
    assert warning.kind == "gnss"
    return warning.weight


def test_a_path_that_is_too_short_for_its_fixes_is_not_placed():
    short = tracked(truth(duration_s=2.0), 1)
    assert refused(short, fixes_of(1, duration_s=2.0)) == "note"
    assert refused(short, fixes_of(1).of(np.arange(5))) == "note"
    accurate = georeference(short, fixes_of(1, duration_s=2.0, noise_m=0.01, bias_m=0.0), CONFIG)
    assert accurate.report.heading_sigma_rad < 0.1  # 0.5 m by the clock, on 20 m


@pytest.mark.parametrize("fault", ["mirrored", "scaled", "late"])
def test_fixes_that_contradict_the_path_are_left_out(fault):
    fixes = fixes_of(2)
    origin = GeodeticOrigin(*fixes.geodetic[0].tolist())
    points = origin.enu(fixes.geodetic)
    if fault == "late":  # GPS time, which is 18 s ahead of UTC
        wrong = replace(fixes, stamps_ns=fixes.stamps_ns + 18 * NS_PER_S)
    else:
        factors = np.array([-1.0, 1.0, 1.0]) if fault == "mirrored" else 0.5
        wrong = replace(fixes, geodetic=origin.geodetic(points * factors))
    assert refused(tracked(truth(), 2), wrong) == "doubt"


@pytest.mark.parametrize("duration_s", [2.0, 10.0, DURATION_S])
def test_fixes_in_radians_are_those_in_degrees(duration_s):
    """Of a short path they are as near to each other as the fixes of a receiver that stands."""
    before = tracked(truth(duration_s=duration_s), 2)
    fixes = fixes_of(2, duration_s=duration_s)
    radians = replace(fixes, geodetic=fixes.geodetic * [np.pi / 180.0, np.pi / 180.0, 1.0])
    expected, found = (georeference(before, one, CONFIG) for one in (fixes, radians))
    np.testing.assert_allclose(found.T_map_world, expected.T_map_world, atol=1e-6)
    assert (found.report is None) == (expected.report is None)
    assert ["radians" in warning.sentence for one in (expected, found) for warning in one.warnings] == [
        False,
        True,
    ]


def test_fixes_in_degrees_near_the_equator_are_no_radians():
    known = truth()
    placed = georeference(tracked(known, 2), fixes_of(2, latitude_deg=0.0, longitude_deg=0.0), CONFIG)
    assert placed.report is not None
    assert abs(placed.report.latitude_deg) < 0.01


def test_an_antenna_of_unknown_place_makes_fixes_less_accurate():
    known = truth()
    before = tracked(known, 8)
    far = fixes_of(8, noise_m=0.01, bias_m=0.01, antenna_body=(-1.0, 0.5, 1.0))
    placed = georeference(before, replace(far, antenna_body=None), CONFIG)
    assert not placed.report.has_antenna
    assert not placed.report.is_corrected
    assert ate_m(placed.tracking, known) == pytest.approx(ate_m(before, known), rel=1e-6)


def test_fixes_without_a_covariance_count_as_a_plain_receivers():
    known = truth()
    fixes = fixes_of(9)
    unknown = replace(fixes, covariances_enu=np.full_like(fixes.covariances_enu, np.nan))
    placed = georeference(tracked(known, 9, drift=0.0), unknown, CONFIG)
    assert (
        placed.report.heading_sigma_rad
        > georeference(tracked(known, 9), fixes, CONFIG).report.heading_sigma_rad
    )


def test_without_fixes_or_with_use_off_nothing_changes():
    tracking = tracked(truth(), 1)
    off = CONFIG.model_copy(update={"gnss": GnssFactorsConfig(use=False)})
    for placed in (georeference(tracking, None, CONFIG), georeference(tracking, fixes_of(1), off)):
        assert placed.tracking is tracking
        assert (placed.report, list(placed.warnings)) == (None, [])


def test_a_run_keeps_its_place_and_the_fixes_that_correct_it(tmp_path):
    sensor = STREET.sensor.model_copy(update={"rings": 8, "azimuth_steps": 180})
    street = STREET.model_copy(
        update={
            "rate_hz": 2.0,
            "duration_s": 30.0,
            "sensor": sensor,
            "gnss": SynthGnssConfig(noise_m=0.02, bias_m=0.02),
        }
    )
    log = LidarSimulator(street).log()
    T = log.truth.T_world_body.copy()
    T[:, :3, 3] *= 1.02  # wheels of another size
    overrides = ["odometry.kind=given", "loops.kind=none", "octree.resolution_m=0.5"]
    config = load_config(None, overrides, sensor="lidar")
    run = build(log, config, tmp_path / "run", odometry=replace(log.truth, T_world_body=T))
    found = run.manifest.georeference
    assert found.is_corrected
    assert "gnss.csv" in run.manifest.files
    assert len(run.graph.fixes) == found.fixes - found.outliers
    off = run.trajectory.positions_world - true_enu(log.truth, found.origin)
    assert np.abs(off[:, :2]).max() < 0.8
    before_m, after_m = (aligned_m(p, log.truth) for p in (T[:, :3, 3], run.trajectory.positions_world))
    assert after_m < 0.9 * before_m  # given poses are stiff
    (warning,) = [warning for warning in run.manifest.warnings if warning.kind == "gnss"]
    assert warning.weight == "note"
    solved = optimize(run.graph, config.graph)
    moved = np.array([T[:3, 3] for T in solved.T_world_node.values()]) - run.graph.positions
    assert np.abs(moved).max() < 0.2
