import numpy as np
import pytest

from mapper.core.errors import DataError, SourceError
from mapper.core.geometry import apply, exp, inverse
from mapper.core.rotations import row_of_pose
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.trajectory_files import write_kitti
from tests.support.paths import DATA

N = 5
T_WORLD_LIDAR = np.array(
    [exp(np.array([0.0, 0.02 * i, 0.1 * i]), np.array([1.0 * i, 0.1, 0.0])) for i in range(N)]
)
T_CAMERA_LIDAR = np.array(
    [[0.0, -1.0, 0.0, -0.01], [0.0, 0.0, -1.0, -0.05], [1.0, 0.0, 0.0, -0.29], [0.0, 0.0, 0.0, 1.0]]
)
CALIBRATION = "\n".join(
    [f"P{i}: 7 0 6 0 0 7 1 0 0 0 1 0" for i in range(4)]
    + ["Tr: " + " ".join(f"{v:.12e}" for v in T_CAMERA_LIDAR[:3].ravel())]
)


def records_of(i):
    rng = np.random.default_rng(i)
    return np.column_stack((rng.normal(0.0, 10.0, (100, 3)), rng.uniform(0.0, 1.0, 100))).astype(np.float32)


def scans(folder, numbers=range(N)):
    (folder / "velodyne").mkdir(parents=True)
    for i in numbers:
        records_of(i).tofile(folder / f"velodyne/{i:06d}.bin")
    return folder


def poses(path, T=T_WORLD_LIDAR):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_kitti(path, Trajectory(np.arange(len(T)), T))


def test_poses_without_a_calibration_are_the_lidars(tmp_path):
    poses(scans(tmp_path / "drive") / "poses.txt")
    source = open_source(tmp_path / "drive")
    assert (source.kind, source.sensor, source.name, len(source)) == ("kitti", "lidar", "drive", N)
    assert source.stamps_ns.tolist() == [i * NS_PER_S // 10 for i in range(N)]
    assert source.notes == [
        "no stamps in the names or in a times.txt; 10 scans a second assumed (source.rate_hz)"
    ]
    np.testing.assert_allclose(source.truth.T_world_body, T_WORLD_LIDAR, atol=1e-12)
    assert source.truth.stamps_ns.tolist() == source.stamps_ns.tolist()
    np.testing.assert_array_equal(next(source.entries()).load().points_body, records_of(0)[:, :3])


def test_poses_with_a_calibration_are_the_cameras(tmp_path):
    folder = scans(tmp_path)
    (folder / "calib.txt").write_text(CALIBRATION)
    (folder / "image_2").mkdir()
    (folder / "image_2/000000.png").touch()
    poses(folder / "poses.txt", T_CAMERA_LIDAR @ T_WORLD_LIDAR @ inverse(T_CAMERA_LIDAR))
    np.testing.assert_allclose(open_source(folder).truth.T_world_body, T_WORLD_LIDAR, atol=1e-9)


def test_poses_that_move_as_a_cameras_are_told_where_a_calibration_is_missing(tmp_path):
    def notes_of(name, T, calibration=None):
        folder = scans(tmp_path / name)
        poses(folder / "poses.txt", T)
        if calibration:
            (folder / "calib.txt").write_text(calibration)
        return [note for note in open_source(folder).notes if "as a camera's do" in note]

    T_world_camera = np.array([exp(np.array([0, 0.02 * i, 0]), np.array([0, 0.1, i])) for i in range(N)])
    assert notes_of("camera", T_world_camera) == [
        "the true poses move along their z, as a camera's do; without calib.txt they count as the LiDAR's"
    ]
    assert notes_of("calibrated", T_world_camera, CALIBRATION) == []
    assert notes_of("lidar", T_WORLD_LIDAR) == []
    assert notes_of("still", np.array([np.eye(4)] * N)) == []


@pytest.mark.parametrize("opened", ["", "sequences", "sequences/07"])
def test_the_layout_of_the_benchmark(tmp_path, opened):
    sequence = scans(tmp_path / "sequences/07")
    (sequence / "times.txt").write_text("".join(f"{0.1037 * i:.6e}\n" for i in range(N)))
    poses(tmp_path / "poses/07.txt")
    source = open_source(tmp_path / opened)
    assert source.name == "07"
    assert source.stamps_ns.tolist() == [103_700_000 * i for i in range(N)]
    assert source.notes == []
    np.testing.assert_allclose(source.truth.T_world_body, T_WORLD_LIDAR, atol=1e-12)


def raw_drive(folder, numbers=range(N), lines=N):
    """A drive as KITTI's raw recordings keep it."""
    (scans(folder, numbers) / "velodyne").rename(folder / "data")
    (folder / "velodyne_points").mkdir()
    (folder / "data").rename(folder / "velodyne_points/data")
    text = "".join(f"2011-09-26 13:02:{25 + i}.594360375\n" for i in range(lines))
    (folder / "velodyne_points/timestamps.txt").write_text(text)
    return folder


@pytest.mark.parametrize(
    ("opened", "kind"), [("", "kitti"), ("drive", "kitti"), ("drive/velodyne_points", "clouds")]
)
def test_a_raw_recording_has_the_times_of_its_list(tmp_path, opened, kind):
    raw_drive(tmp_path / "drive", numbers=[0, 1, 3], lines=4)  # drives lack scans, but not their lines
    source = open_source(tmp_path / opened)
    assert (source.kind, source.notes) == (kind, [])
    first_ns = 1317042145594360375
    assert source.stamps_ns.tolist() == [first_ns, first_ns + NS_PER_S, first_ns + 3 * NS_PER_S]


def test_a_date_that_is_none_is_named_with_its_line(tmp_path):
    (raw_drive(tmp_path) / "velodyne_points/timestamps.txt").write_text("2011-13-26 13:02:25.5\n" * N)
    with pytest.raises(SourceError, match=r"timestamps\.txt:1: stamp '2011-13-26 13:02:25\.5' is no date"):
        open_source(tmp_path)


def test_several_sequences_are_named(tmp_path):
    scans(tmp_path / "sequences/00")
    scans(tmp_path / "sequences/11")
    with pytest.raises(SourceError, match="holds 2 sequences; open one of sequences/00, sequences/11"):
        open_source(tmp_path)


def test_more_or_fewer_poses_than_scans_pair_by_the_scans_numbers_and_another_truth_can_be_named(tmp_path):
    folder = scans(tmp_path / "more", numbers=[1, 3])
    poses(folder / "poses.txt")
    poses(folder / "gps/poses.txt", T_WORLD_LIDAR[::-1])
    source = open_source(folder)
    assert sum("poses.txt: 5 poses for 2 of 2 scans" in note for note in source.notes) == 1
    np.testing.assert_allclose(source.truth.T_world_body, T_WORLD_LIDAR[[1, 3]], atol=1e-12)
    assert source.truth.stamps_ns.tolist() == source.stamps_ns.tolist() == [100_000_000, 300_000_000]
    other = open_source(folder, SourceConfig(truth_file="gps/poses.txt")).truth
    np.testing.assert_allclose(other.T_world_body, T_WORLD_LIDAR[::-1][[1, 3]], atol=1e-12)
    folder = scans(tmp_path / "fewer")
    poses(folder / "poses.txt", T_WORLD_LIDAR[:3])
    source = open_source(folder)
    assert source.truth.stamps_ns.tolist() == source.stamps_ns.tolist()[:3]
    assert sum("poses.txt: 3 poses for 3 of 5 scans" in note for note in source.notes) == 1


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("Tr: 1 0 0 0", "calib.txt:1: 4 numbers, want 12"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 2 0", "calib.txt: Tr: not a rigid motion"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 nan 0", "calib.txt: Tr: not a rigid motion"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 one 0", "calib.txt:1: could not convert string to float: 'one'"),
    ],
)
def test_a_malformed_calibration_is_refused(tmp_path, line, says):
    (scans(tmp_path) / "calib.txt").write_text(line)
    with pytest.raises(SourceError, match=says):
        open_source(tmp_path)


@pytest.mark.parametrize("name", ["poses.txt", "groundtruth.txt"])
def test_poses_of_other_programs_are_the_truth(tmp_path, name):
    T = T_WORLD_LIDAR
    quaternions = [" ".join(map(repr, row.tolist())) for row in row_of_pose(T)]
    tum = [f"{0.1 * i:.1f} {row}" for i, row in enumerate(quaternions)]
    whole = [" ".join(map(repr, one.ravel().tolist())) for one in T]
    (scans(tmp_path) / name).write_text("\n".join(whole if name == "poses.txt" else tum))
    np.testing.assert_allclose(open_source(tmp_path).truth.T_world_body, T, atol=1e-9)


def test_malformed_poses_are_refused(tmp_path):
    (scans(tmp_path) / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1\n")
    with pytest.raises(DataError, match=r"poses.txt:1: want 12 finite numbers"):
        open_source(tmp_path)


@pytest.mark.parametrize("name", ["kitti_00", "mulran_kaist03"])
def test_truth_of_real_logs_lays_scans_onto_each_other(name):
    """Wrong axes or a wrong calibration would bring fewer points onto the first scan than none at all."""
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA / name} is missing")
    source = open_source(DATA / name)
    entries = list(source.entries())
    assert source.truth.stamps_ns.tolist() == [entry.stamp_ns for entry in entries]
    steps = inverse(source.truth.T_world_body[0]) @ source.truth.T_world_body
    ahead_or_back = np.abs(steps[-1, 0, 3]) / np.linalg.norm(steps[-1, :3, 3])
    assert ahead_or_back > 0.95  # x points along the road
    first, later = (entries[i].scan().points_body.astype(float) for i in (0, 2))
    assert overlap(first, apply(steps[2], later)) > 4.0 * overlap(first, later)


def overlap(points, others):
    """Return the part of points' 0.3 m cells, walls and not ground, that the others have too."""
    cells = [{tuple(c) for c in np.floor(p[p[:, 2] > 0.0] / 0.3).astype(int)} for p in (points, others)]
    return len(cells[0] & cells[1]) / len(cells[0])
