"""Wrong motions are refused and right ones accepted, where plain overlap would accept both."""

import os
import subprocess
import sys

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import apply, exp
from mapper.registration.acceptance import assess
from mapper.registration.config import AcceptanceConfig, KissMatcherConfig, NdtConfig
from mapper.registration.kiss_matcher import KissMatcher
from mapper.registration.ndt import Ndt, refine_by_cells
from mapper.registration.pair_refinement import measured
from mapper.registration.surfaces import prepared

VOXEL_M = 0.3


def yard(rng, *, points):
    """A floor 40 m wide with a few boxes on it: most of what is seen is floor."""
    floor = np.column_stack([*rng.uniform(-20.0, 20.0, (2, points)), np.zeros(points)])
    sides = []
    for x, y in ((5.0, 3.0), (-8.0, 6.0), (2.0, -9.0), (-6.0, -7.0), (12.0, -4.0)):
        along, height = rng.uniform(0.0, 3.0, (2, points // 50))
        zero = np.zeros_like(along)
        sides += [
            np.column_stack([x + along, y + zero, height]),
            np.column_stack([x + zero, y + along, height]),
        ]
    return np.concatenate([floor, *sides])


@pytest.fixture(scope="module")
def clouds():
    rng = np.random.default_rng(0)
    return tuple(prepared(yard(rng, points=n), voxel_m=VOXEL_M) for n in (200_000, 40_000))


def test_the_right_motion_is_accepted(clouds):
    alignment = assess(*clouds, np.eye(4), AcceptanceConfig())
    assert alignment.converged, alignment.reason
    assert alignment.inlier_ratio > 0.9


@pytest.mark.parametrize("limit", ["near_voxels", "surface_voxels"])
def test_points_agree_within_limits_of_distance_and_surface(clouds, limit):
    nearly = exp(np.zeros(3), np.array([0.0, 0.0, 0.03]))
    assert assess(*clouds, nearly, AcceptanceConfig()).converged
    assert not assess(*clouds, nearly, AcceptanceConfig(**{limit: 0.01})).converged


@pytest.mark.parametrize("turn_rad", [0.0, 1.0])
def test_a_wrong_motion_over_the_same_floor_is_not(clouds, turn_rad):
    wrong = exp(np.array([0.0, 0.0, turn_rad]), np.array([3.0, -2.0, 0.0]))
    assert measured(*clouds, wrong, max_pair_distance_m=1.0).inlier_ratio > 0.75

    alignment = assess(*clouds, wrong, AcceptanceConfig())

    assert not alignment.converged
    assert "surfaces that face" in alignment.reason
    assert np.array_equal(alignment.T_target_source, wrong)


def test_a_floor_alone_is_degenerate_and_the_reason_says_along_what():
    rng = np.random.default_rng(1)
    floors = [
        prepared(np.column_stack([*rng.uniform(-20.0, 20.0, (2, 50_000)), np.zeros(50_000)]), voxel_m=VOXEL_M)
        for _ in range(2)
    ]
    alignment = assess(*floors, np.eye(4), AcceptanceConfig())
    assert not alignment.converged
    assert alignment.reason == "degenerate: no surface shows translation along x and y, rotation about z"


def test_ndt_says_so_where_open3d_only_warns():
    rng = np.random.default_rng(2)
    target, source = yard(rng, points=20_000), yard(rng, points=5_000)
    far = exp(np.zeros(3), np.array([300.0, 0.0, 0.0]))
    assert "no overlap" in refine_by_cells(target, source, far, cells_m=(2.0,))
    assert "has 6 points" in refine_by_cells(target[:3], source, np.eye(4), cells_m=(2.0,))
    assert refine_by_cells(target, source[:0], np.eye(4), cells_m=(2.0,)) == "no points in the source"


def test_ndt_prints_nothing(capfd):
    target = Scan(0, yard(np.random.default_rng(3), points=20_000).astype(np.float32))
    Ndt(target, NdtConfig()).align(target, exp(np.zeros(3), np.array([300.0, 0.0, 0.0])))
    assert capfd.readouterr() == ("", "")


def test_clouds_without_features_do_not_crash_kiss_matcher():
    rng = np.random.default_rng(4)
    crowd = Scan(0, yard(rng, points=20_000).astype(np.float32))
    scattered = Scan(0, rng.uniform(-200.0, 200.0, (500, 3)).astype(np.float32))
    for target, source in ((crowd, scattered), (scattered, crowd)):
        found = KissMatcher(target, KissMatcherConfig()).align(source, np.eye(4))
        assert not found.converged
        assert "to have features" in found.reason


def test_a_dense_cloud_of_many_matches_is_the_same_every_time():
    """With more matches than it takes, the library draws from them without a seed."""
    rng = np.random.default_rng(5)
    dense = yard(rng, points=40_000)
    bumpy = (
        dense + np.column_stack([*np.zeros((2, len(dense))), np.sin(dense[:, 0]) + np.cos(dense[:, 1])])
    ).astype(np.float32)
    T_turned = exp(np.array([0.0, 0.0, 0.4]), np.array([2.0, 1.0, 0.0]))
    source = Scan(0, apply(T_turned, bumpy.astype(np.float64)).astype(np.float32))
    aligner = KissMatcher(Scan(0, bumpy), KissMatcherConfig(feature_voxels=1.0))
    answers = {aligner.align(source, np.eye(4)).T_target_source.tobytes() for _ in range(2)}
    assert len(answers) == 1


THREADS = """
import ctypes
import numpy as np
from mapper.core.frames import Scan
from mapper.registration.config import KissMatcherConfig
from mapper.registration.factory import aligner_to
points = np.random.default_rng(0).uniform(-3.0, 3.0, (3000, 3)).astype(np.float32)
scan = Scan(0, points, np.zeros(3))
aligner_to(scan, KissMatcherConfig()).align(scan, np.eye(4))
with open("/proc/self/maps") as maps:
    openmp = next(line.split()[-1] for line in maps if "kiss_matcher.libs/libgomp" in line)
print(ctypes.CDLL(openmp).omp_get_max_threads())
"""


@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2, reason="Linux, two cores"
)
def test_the_library_has_one_thread():
    pytest.importorskip("kiss_matcher")
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, "-c", THREADS], capture_output=True, text=True, env=environment, check=True
    )
    assert done.stdout.split()[-1] == "1"
