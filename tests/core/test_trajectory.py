import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapper.core.errors import DataError
from mapper.core.geometry import exp, inverse
from mapper.core.trajectory import Trajectory, start_to_end, trajectory_from
from mapper.sources.trajectory_files import read_kitti, read_tum, write_kitti, write_tum

EPOCH_NS = 1_305_031_102_175_304_001


def random_trajectory(n=20, seed=0):
    rng = np.random.default_rng(seed)
    poses = [exp(rng.uniform(-2, 2, 3), rng.uniform(-5, 5, 3)) for _ in range(n)]
    stamps_ns = EPOCH_NS + np.cumsum(rng.integers(1, 10**8, n))
    return trajectory_from(zip(stamps_ns.tolist(), poses, strict=True))


def test_tum_text_keeps_every_stamp_and_position_exactly(tmp_path):
    trajectory = random_trajectory()
    write_tum(tmp_path / "t.tum", trajectory)
    again = read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_array_equal(again.positions_world, trajectory.positions_world)
    np.testing.assert_allclose(again.T_world_body, trajectory.T_world_body, atol=1e-14)


def test_tum_text_is_what_others_expect(tmp_path):
    path = tmp_path / "t.tum"
    T = np.eye(4)
    T[:3, 3] = [1.0, -2.5, 0.125]
    write_tum(path, trajectory_from([(1_500_000_000, T)]))
    assert path.read_text() == "# timestamp tx ty tz qx qy qz qw\n1.500000 1.0 -2.5 0.125 0.0 0.0 0.0 1.0\n"


def test_tum_accepts_commas_comments_and_unnormalised_quaternions(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text("# a comment\n\n1.0,1,2,3,0,0,0,2\n2.0\t1 2 4  0 0 0 -0.5\n")
    trajectory = read_tum(path)
    assert trajectory.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000]
    np.testing.assert_array_equal(trajectory.T_world_body[:, :3, :3], [np.eye(3)] * 2)


@pytest.mark.parametrize(
    "line", ["{};1.5;2;3;0;0;0;1", "{}; 1.5; 2; 3; 0; 0; 0; 1", "{} 1,5 2 3 0 0 0 1", "{};1,5;2,0;3;0;0;0;1"]
)
@pytest.mark.parametrize("stamp", ["1305031102", "1305031102000", "1305031102000000000"])
def test_tum_accepts_semicolons_decimal_commas_and_units_of_stamps(tmp_path, line, stamp):
    (tmp_path / "t.csv").write_text(line.format(stamp))
    trajectory = read_tum(tmp_path / "t.csv")
    assert trajectory.stamps_ns.tolist() == [1_305_031_102_000_000_000]
    np.testing.assert_array_equal(trajectory.positions_world, [[1.5, 2.0, 3.0]])


EUROC_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)


@pytest.mark.parametrize(
    "text",
    [
        f"{EUROC_HEADER}, v_RS_R_x\n1403636580838555648,1,2,3,0.5,0.5,-0.5,0.5,9,9,9,8,8,8,7,7,7\n",
        "1403636580838555648, 1, 2, 3, 0.5, 0.5, -0.5, 0.5\n",
        "1403636580838555648,1,2,3,0.5,0.5,-0.5,0.5,\n",
        "# stamp x y z qw qx qy qz\n1403636580.838555648 1 2 3 0.5 0.5 -0.5 0.5\n",
        "timestamp,x,y,z,qw,qx,qy,qz\n1403636580.838555648,1,2,3,0.5,0.5,-0.5,0.5\n",
        "timestamp,tx,ty,tz,qx,qy,qz,qw\n1403636580.838555648,1,2,3,0.5,-0.5,0.5,0.5\n",
    ],
)
def test_euroc_text_and_headers_tell_the_order_of_quaternions(tmp_path, text):
    (tmp_path / "data.csv").write_text(text)
    trajectory = read_tum(tmp_path / "data.csv")
    assert trajectory.stamps_ns.tolist() == [1403636580838555648]
    np.testing.assert_array_equal(trajectory.positions_world, [[1.0, 2.0, 3.0]])
    R = Rotation.from_quat([0.5, -0.5, 0.5, 0.5]).as_matrix()
    np.testing.assert_allclose(trajectory.T_world_body[0, :3, :3], R, atol=1e-12)


def test_of_two_equal_stamps_the_first_counts(tmp_path):
    path = tmp_path / "t.tum"
    path.write_text("1.0 1 0 0 0 0 0 1\n1.0 2 0 0 0 0 0 1\n2.0 3 0 0 0 0 0 1\n")
    assert read_tum(path).positions_world[:, 0].tolist() == [1.0, 3.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"t\.tum: no poses"),
        ("1.0 2.0\n", r"t\.tum:1: 2 columns, want 8"),
        ("# c\n1.0 0 0 x 0 0 0 1\n", r"t\.tum:2: could not convert string"),
        ("1.0 0 0 nan 0 0 0 1\n", r"t\.tum:1: a number is not finite"),
        ("1.0 0 0 0 0 0 0 0\n", r"t\.tum:1: quaternion .* has no direction"),
        ("x 0 0 0 0 0 0 1\n", r"t\.tum:1: stamp 'x'"),
        ("2.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", r"t\.tum:2: stamp 1\.0 comes before the line above"),
        (b"\xff\xfe\xfd", r"t\.tum: not a text file"),
    ],
)
def test_a_bad_tum_file_is_named_with_its_line(tmp_path, text, message):
    path = tmp_path / "t.tum"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=message):
        read_tum(path)


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(DataError, match=r"none\.tum: cannot be read: No such file"):
        read_tum(tmp_path / "none.tum")


def test_kitti_text_keeps_every_digit_and_takes_stamps_along(tmp_path):
    trajectory = random_trajectory()
    write_kitti(tmp_path / "k.txt", trajectory)
    again = read_kitti(tmp_path / "k.txt", trajectory.stamps_ns)
    np.testing.assert_array_equal(again.positions_world, trajectory.positions_world)
    np.testing.assert_allclose(again.T_world_body, trajectory.T_world_body, atol=1e-14)
    assert read_kitti(tmp_path / "k.txt").stamps_ns.tolist() == list(range(20))
    with pytest.raises(DataError, match="20 poses but 3 stamps"):
        read_kitti(tmp_path / "k.txt", trajectory.stamps_ns[:3])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0\n", r"k\.txt:1: want 12 finite numbers"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n", r"k\.txt: a pose is not a rigid motion"),
        ("1 0 0 0 0 1 0 0 0 0 1 x\n", r"k\.txt:1: could not convert"),
        ("\n", r"k\.txt: no poses"),
    ],
)
def test_a_bad_kitti_file_is_named(tmp_path, text, message):
    path = tmp_path / "k.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        read_kitti(path)


def test_kitti_rotations_of_few_digits_become_exact(tmp_path):
    path = tmp_path / "k.txt"
    path.write_text("0.99999 0.00447 0 1 -0.00447 0.99999 0 2 0 0 1 3\n")
    R = read_kitti(path).T_world_body[0, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)


def test_refuses_what_is_no_trajectory():
    poses = np.stack([np.eye(4)] * 2)
    with pytest.raises(DataError, match=r"stamps \(3,\) and poses \(2, 4, 4\)"):
        Trajectory(np.arange(3), poses)
    for stamps in ([5, 5], [5, 4]):
        with pytest.raises(DataError, match=rf"stamp {stamps[1]} comes after 5; stamps must increase"):
            Trajectory(np.array(stamps), poses)
    with pytest.raises(DataError, match="not a finite rigid motion"):
        Trajectory(np.arange(2), 2.0 * poses)


def test_path_length_and_move():
    poses = np.stack([np.eye(4)] * 3)
    poses[1, :3, 3], poses[2, :3, 3] = [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]
    trajectory = Trajectory(np.arange(3), poses)
    assert trajectory.path_length_m == 7.0
    T_new_world = exp(np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    moved = trajectory.moved(T_new_world)
    assert moved.path_length_m == pytest.approx(7.0)
    np.testing.assert_allclose(moved.T_world_body[2], T_new_world @ poses[2])
    np.testing.assert_allclose(start_to_end(moved), inverse(poses[0]) @ poses[2], atol=1e-12)


def test_a_trajectory_may_be_empty():
    empty = trajectory_from([])
    assert len(empty) == 0
    assert empty.path_length_m == 0.0
