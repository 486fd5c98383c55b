import numpy as np
import pytest

import mapper
from mapper.api.register import parse_guess
from mapper.core.errors import ConfigError, MapperError
from mapper.core.rotations import rotation_from_euler


def room(seed=0):
    """Points of a floor, two walls and boxes, metres, z up."""
    rng = np.random.default_rng(seed)
    parts = [
        rng.uniform([-8, -8, 0], [8, 8, 0], (6000, 3)),
        rng.uniform([-8, 8, 0], [8, 8, 3], (3000, 3)),
        rng.uniform([8, -8, 0], [8, 8, 3], (3000, 3)),
        *(rng.uniform(c, np.add(c, 0.8), (600, 3)) for c in ([2, 2, 0], [-4, 1, 0], [1, -5, 0])),
    ]
    return np.vstack(parts)


def motion(yaw_rad, x_m, y_m):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]
    T[:2, 3] = x_m, y_m
    return T


@pytest.mark.parametrize(("method", "error_m"), [("icp", 0.03), ("plane-icp", 2e-3), ("gicp", 2e-3)])
@pytest.mark.parametrize("seed", range(2))
def test_arrays_and_lists(method, error_m, seed):
    T_target_source = motion(0.05, 0.2, -0.1)
    source = room(seed)
    target = source @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    found = mapper.register(source, target, method=method)
    assert found.converged
    np.testing.assert_allclose(found.T_target_source, T_target_source, atol=error_m)
    for guess in (T_target_source, f"0.2 -0.1 0 0 0 {np.degrees(0.05)}"):
        refined = mapper.register(source.tolist(), target, method=method, guess=guess)
        np.testing.assert_allclose(refined.T_target_source, T_target_source, atol=error_m)


def test_settings_reach_the_method():
    small = 0.1 * room()
    found = mapper.register(
        small, small + np.array([0.02, 0.0, 0.0]), method="gicp", settings={"registration.voxel_m": 0.03}
    )
    np.testing.assert_allclose(found.T_target_source[:3, 3], [0.02, 0.0, 0.0], atol=1e-3)
    with pytest.raises(MapperError, match="did you mean voxel_m"):
        mapper.register(small, small, method="gicp", settings={"registration.voxels_m": 0.03})


def test_clouds_that_do_not_fit_say_why():
    found = mapper.register(np.zeros((0, 3)), room(), method="icp")
    assert not found.converged
    assert found.reason


def test_files_and_frames_of_a_log(desk_log, tmp_path):
    np.save(tmp_path / "room.npy", room().astype(np.float32))
    found = mapper.register(str(tmp_path / "room.npy"), tmp_path / "room.npy", method="gicp")
    np.testing.assert_allclose(found.T_target_source, np.eye(4), atol=1e-4)
    log = mapper.open_log(desk_log)
    by_name = mapper.register(f"{desk_log}@2", f"{desk_log}@0", method="isvd")
    by_frame = mapper.register(log[2], log[0], method="isvd")
    assert by_name.converged
    np.testing.assert_array_equal(by_name.T_target_source, by_frame.T_target_source)


def test_a_guess_is_read_in_every_form(tmp_path):
    R = rotation_from_euler(*np.radians([10.0, -20.0, 30.0]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, [1.0, -2.0, 0.5]
    assert np.allclose(parse_guess("1, -2 0.5 10 -20 30"), T)
    assert np.array_equal(parse_guess(None), np.eye(4))
    matrix, rows, tum = tmp_path / "T.txt", tmp_path / "rows.txt", tmp_path / "pose.tum"
    np.savetxt(matrix, T)
    np.savetxt(rows, T[:3])
    tum.write_text("# stamp x y z qx qy qz qw\n1.5 1 -2 0.5 0 0 0.7071067811865476 0.7071067811865476\n")
    assert np.allclose(parse_guess(str(matrix)), T)
    assert np.allclose(parse_guess(str(rows)), T)
    assert np.allclose(parse_guess(str(tum))[:3, 3], T[:3, 3])
    assert np.allclose(parse_guess(str(tum))[:2, :2], [[0.0, -1.0], [1.0, 0.0]])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [("1 2 nan 0 0 0", "not finite"), ("somewhere", "no such file"), ("1 2 3 4 5 6 7", "7 numbers")],
)
def test_a_guess_that_is_none_says_why(content, complaint):
    with pytest.raises(ConfigError, match=complaint):
        parse_guess(content)


def test_a_matrix_that_is_no_motion_is_refused(tmp_path):
    path = tmp_path / "T.txt"
    np.savetxt(path, 2.0 * np.eye(4))
    with pytest.raises(ConfigError, match="no rigid motion"):
        parse_guess(str(path))
