import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.geometry import exp
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.trajectory_files import write_kitti, write_tum

FIRST_NS = 1_544_676_777_123_456_789
PERIOD_NS = 100_000_000
SWEEP_S = np.linspace(0.0, 0.09, 40)
POSES = np.array([exp(np.array([0.0, 0.0, 0.1 * i]), np.array([1.0 * i, 0.2, 0.0])) for i in range(12)])


def points_of(i):
    return np.random.default_rng(i).normal(0.0, 10.0, (40, 3)).astype(np.float32)


def write_scan(path, i, *, times=None):
    """Write scan ``i`` in the format of the path, with times where the format and the caller have some."""
    path.parent.mkdir(parents=True, exist_ok=True)
    points = points_of(i)
    if path.suffix == ".bin":
        np.column_stack([points, np.ones(len(points))]).astype(np.float32).tofile(path)
    elif path.suffix == ".npy" and times is None:
        np.save(path, points)
    elif path.suffix == ".npy":
        records = np.zeros(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("timestamp", "f8")])
        records["x"], records["y"], records["z"] = points.T
        records["timestamp"] = times
        np.save(path, records)
    else:
        np.savetxt(path, points, fmt="%.9g")


def cloud_folder(folder, names):
    for i, name in enumerate(names):
        write_scan(folder / name, i)
    return folder


def first_x(source):
    """Which scans these are, by their first coordinate."""
    return [entry.scan().points_body[0, 0] for entry in source.entries()]


def assumed(rate):
    return f"no stamps in the names or in a times.txt; {rate} scans a second assumed (source.rate_hz)"


@pytest.mark.parametrize("ending", [".bin", ".npy", ".xyz", ".txt", ".csv"])
def test_a_folder_of_clouds_is_a_lidar_log(tmp_path, ending):
    folder = cloud_folder(tmp_path / "yard", [f"{i}{ending}" for i in range(12)])
    (folder / "README.txt").write_text("no cloud\n")
    source = open_source(folder)
    assert (source.kind, source.sensor, source.name, len(source)) == ("clouds", "lidar", "yard", 12)
    assert source.truth is None
    assert source.notes == [assumed(10)]
    assert source.stamps_ns.tolist() == [i * PERIOD_NS for i in range(12)]
    assert first_x(source) == [points_of(i)[0, 0] for i in range(12)]  # 10 comes after 9
    for _ in range(2):
        scan = next(iter(source.entries())).load()
        assert scan.stamp_ns == 0
        assert scan.times_s is None
        np.testing.assert_array_equal(scan.points_body, points_of(0))


def test_nothing_is_read_before_it_is_asked_for(tmp_path):
    folder = cloud_folder(tmp_path, ["0.npy", "1.npy", "2.npy"])
    (folder / "1.npy").write_bytes(b"damaged")
    entries = list(open_source(folder).entries())
    assert len(entries[2].scan().points_body) == 40
    with pytest.raises(FrameError, match=r"1\.npy: not a sound npy file"):
        entries[1].scan()


@pytest.mark.parametrize(
    ("names", "step_ns"),
    [
        (["1544676777.123456789", "1544676777.223456789", "1544676777.323456789"], PERIOD_NS),
        (["cloud_1544676777_123456789", "cloud_1544676777_223456789"], PERIOD_NS),
        (["1544676777123456789", "1544676777223456789"], PERIOD_NS),
        (["os1-1544676777123456", "os1-1544676777223456"], PERIOD_NS),
        (["1544676777123", "1544676777223"], PERIOD_NS),
        (["1544676777", "1544676778"], NS_PER_S),
        (["1544676777.123456789_7", "1544676777.223456789_8"], PERIOD_NS),
        (["2018-12-13-04-52-57.123456", "2018-12-13-04-52-57.223456"], PERIOD_NS),
        (["lidar_20181213_045257_123", "lidar_20181213_045257_223"], PERIOD_NS),
        (["2018-12-13T04-52-57.12Z", "2018-12-13T04-52-57.22Z"], PERIOD_NS),
    ],
)
def test_names_that_are_stamps(tmp_path, names, step_ns):
    source = open_source(cloud_folder(tmp_path, [f"{name}.npy" for name in names]))
    assert source.notes == []
    stamps_ns = source.stamps_ns.tolist()
    assert np.diff(stamps_ns).tolist() == [step_ns] * (len(names) - 1)
    assert 0 <= FIRST_NS - stamps_ns[0] < NS_PER_S


def test_names_sort_by_time_even_where_text_would_not(tmp_path):
    source = open_source(cloud_folder(tmp_path, ["100.05.npy", "99.9.npy", "100.0.npy"]))
    assert source.stamps_ns.tolist() == [99_900_000_000, 100_000_000_000, 100_050_000_000]
    assert first_x(source) == [points_of(i)[0, 0] for i in (1, 2, 0)]


KITTI_LABELS = "Car 0.00 0 -1.57 614.24 181.78 727.31 284.77 1.57 1.73 4.15 1.65 1.87 46.70 -1.65\n"
YOLO_LABELS = "".join(f"{i % 3} 0.5{i} 0.41 0.1 0.2\n" for i in range(12))
TRACKS = "".join(f"7,{i},614.2,181.7,113.1,102.9,1,-1,-1,-1\n" for i in range(12))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (KITTI_LABELS, r"'Car 0\.00 0 -1\.57 614\.24 .*' is not three or more numbers"),
        (YOLO_LABELS, "the first column holds whole numbers only, as classes of objects do"),
        (TRACKS, "the first column holds whole numbers only, as classes of objects do"),
        ("0.51 0.41 0.1\n0.51 0.41 0.1\n", "2 lines, want 10 points or more"),
        ("1 2 3\n" * 20 + "1 2 DontCare\n", "'1 2 DontCare' is not three or more numbers"),
        ("", "the file is empty"),
    ],
)
@pytest.mark.parametrize("pattern", [None, "0*.txt"])
def test_a_folder_of_labels_is_refused_with_the_reason(tmp_path, text, reason, pattern):
    folder = tmp_path / "label_2"
    folder.mkdir()
    for i in range(20):
        (folder / f"{i:06d}.txt").write_text("" if i == 0 else text)
    for opened in (folder, tmp_path):
        with pytest.raises(SourceError, match=rf"label_2: 20 \.txt files .*: 0000\d\d\.txt: {reason}"):
            open_source(opened, SourceConfig(pattern=pattern))


def test_labels_beside_clouds_are_left_out_with_a_note(tmp_path):
    folder = cloud_folder(tmp_path / "log/scans", [f"{i:03d}.pcd.npy" for i in range(3)])
    for i in range(9):
        (folder / f"{i:03d}.txt").write_text(KITTI_LABELS)
    labels = tmp_path / "log/labels"
    labels.mkdir()
    for i in range(3):
        (labels / f"{i:03d}.txt").write_text(YOLO_LABELS)
    source = open_source(tmp_path / "log")
    assert len(source) == 3
    assert any(note.startswith("9 .txt files are no clouds: 000.txt: 'Car 0.00") for note in source.notes)
    assert any(
        "labels: 3 .txt files are no clouds: 000.txt: the first column" in note for note in source.notes
    )


@pytest.mark.parametrize(
    "text",
    [
        "x y z\n" + "".join(f"{i} 0.5 {i}.25\n" for i in range(12)),
        "".join(f"{i} {2 * i} {-i}\n" for i in range(12)),
        "".join(f"{-i} 0.5 {i}.25\n" for i in range(12)),
        "".join(f"{i}.5;0.5;1;0\n" for i in range(12)),
    ],
)
def test_points_in_whole_numbers_are_no_labels(tmp_path, text):
    for i in range(3):
        (tmp_path / f"{i}.txt").write_text(text)
    assert len(next(open_source(tmp_path).entries()).load().points_body) >= 11


@pytest.mark.parametrize("listed", ["times.txt", "stamps.txt", "timestamps.txt"])
def test_a_list_of_stamps(tmp_path, listed):
    folder = cloud_folder(tmp_path, ["a.npy", "b.npy", "c.npy"])
    (folder / listed).write_text("1544676777.123456789\n1544676777223456789\n1.544676777323456789e9\n")
    source = open_source(folder)
    assert source.stamps_ns.tolist() == [FIRST_NS + i * PERIOD_NS for i in range(3)]
    assert source.notes == []


@pytest.mark.parametrize(
    "text",
    [
        "frame,timestamp\n2,1544676777.3\n0,1544676777.1\n1,1544676777.2\n",
        "#timestamp [ns],filename\n" + "".join(f"1544676777{k + 1}00000000,{k}.npy\n" for k in range(3)),
        "000000.npy 1544676777100.0\n000001.npy 1544676777200.0\n000002.npy 1544676777300.0\n",
    ],
)
def test_a_list_of_files_and_stamps(tmp_path, text):
    folder = cloud_folder(tmp_path, ["000000.npy", "000001.npy", "000002.npy"])
    (folder / "timestamps.csv").write_text(text)
    assert open_source(folder).stamps_ns.tolist() == [1544676777100000000 + i * PERIOD_NS for i in range(3)]


@pytest.mark.parametrize(
    "first_ms", [12_000, 800]
)  # ns of the second have as many digits as seconds since 1970
@pytest.mark.parametrize(("unit", "per_s"), [("milli", 1000), ("micro", 10**6), ("nano", 10**9)])
def test_whole_numbers_that_advance_as_times_do_are_in_their_unit(tmp_path, unit, per_s, first_ms):
    folder = cloud_folder(tmp_path, ["0.npy", "1.npy", "2.npy"])
    first = first_ms * per_s // 1000
    (folder / "times.txt").write_text("".join(f"{first + i * per_s // 10}\n" for i in range(3)))
    source = open_source(folder)
    assert source.stamps_ns.tolist() == [first_ms * 1_000_000 + i * PERIOD_NS for i in range(3)]
    assert unit in source.notes[0]


def test_a_list_for_all_numbers_serves_some_of_the_scans(tmp_path):
    folder = cloud_folder(tmp_path, ["000002.npy", "000005.npy"])
    (folder / "times.txt").write_text("".join(f"{0.5 * i}\n" for i in range(9)))
    log = open_source(folder)
    assert log.stamps_ns.tolist() == [1_000_000_000, 2_500_000_000]
    assert sum("9 stamps for 2 scans" in note for note in log.notes) == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1\n2\n", "times.txt: 2 stamps for 3 scans; want a line for each"),
        ("1\n2\n3\n4\n", "times.txt: 4 stamps for 3 scans"),
        ("1\n2\nthree\n", "times.txt:3: stamp 'three' is not a decimal number of seconds"),
        ("0 1 7\n1 2 7\n2 3 7\n", "times.txt:1: 3 columns, want 1: a stamp"),
        ("a.npy 1\nb.npy 2\nd.npy 3\n", "times.txt: no line has the stamp of c.npy"),
        ("1\n2 3\n", "times.txt:2: 2 columns"),
    ],
)
def test_a_list_that_does_not_fit_is_refused(tmp_path, text, says):
    folder = cloud_folder(tmp_path, ["a.npy", "b.npy", "c.npy"])
    (folder / "times.txt").write_text(text)
    with pytest.raises(SourceError) as refusal:
        open_source(folder)
    assert says in str(refusal.value)


def test_the_list_that_the_user_names_goes_before_names(tmp_path):
    folder = cloud_folder(tmp_path / "log", ["10.5.npy", "11.5.npy"])
    (tmp_path / "clock.txt").write_text("3\n4\n")
    source = open_source(folder, SourceConfig(stamps_file="../clock.txt"))
    assert source.stamps_ns.tolist() == [3 * NS_PER_S, 4 * NS_PER_S]
    with pytest.raises(SourceError, match=r"clock.txt: no such file; source.stamps_file"):
        open_source(folder, SourceConfig(stamps_file="clock.txt"))


@pytest.mark.parametrize("digits", [3, 6, 9])
def test_fractions_without_leading_zeros_are_whole_numbers_and_those_without_zeros_at_their_ends_not(
    tmp_path, digits
):
    expected_ns = [1_700_000_000 * NS_PER_S + 7_000_000 + k * 100_000_000 for k in range(25)]
    names = [f"{ns // NS_PER_S}.{ns % NS_PER_S // 10 ** (9 - digits)}.npy" for ns in expected_ns]
    assert open_source(cloud_folder(tmp_path / "a", names)).stamps_ns.tolist() == expected_ns
    expected_ns = [1_700_000_000 * NS_PER_S + 105_000_000 + k * 5_000_000 for k in range(25)]
    names = [f"{ns / NS_PER_S:.3f}".rstrip("0") + ".npy" for ns in expected_ns]
    assert open_source(cloud_folder(tmp_path / "b", names)).stamps_ns.tolist() == expected_ns


@pytest.mark.parametrize(
    ("names", "stamps_ms", "note"),
    [
        (["scan_3", "scan_4", "scan_8"], [150, 200, 400], "20 scans a second assumed"),
        (["left", "right"], [0, 50], "20 scans a second assumed"),
        (["0", "100", "300"], [0, 5000, 15_000], "steps of 100"),
    ],
)
def test_the_rate_is_an_option_and_missing_numbers_keep_their_time(tmp_path, names, stamps_ms, note):
    folder = cloud_folder(tmp_path, [f"{name}.npy" for name in names])
    source = open_source(folder, SourceConfig(rate_hz=20.0))
    assert source.stamps_ns.tolist() == [ms * 1_000_000 for ms in stamps_ms]
    assert [note in one for one in source.notes] == [True]


@pytest.mark.parametrize(("viewpoint", "noted"), [("0 0 0 1.0 0 0 0", 0), ("4 0 0 1 0 0 0", 1)])
def test_the_pose_in_a_pcd_is_noted(tmp_path, viewpoint, noted):
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 40\nHEIGHT 1"
    for i in range(2):
        rows = "\n".join(" ".join(f"{value:.3f}" for value in point) for point in points_of(i))
        text = f"{header}\nVIEWPOINT {viewpoint}\nPOINTS 40\nDATA ascii\n{rows}\n"
        (tmp_path / f"{i}.pcd").write_text(text)
    assert sum("VIEWPOINT" in note for note in open_source(tmp_path).notes) == noted


def test_repeated_stamps_are_dropped_and_disorder_is_sorted(tmp_path):
    folder = cloud_folder(tmp_path, ["a.npy", "b.npy", "c.npy", "d.npy"])
    (folder / "times.txt").write_text("1\n3\n3\n2\n")
    source = open_source(folder)
    assert source.stamps_ns.tolist() == [1 * NS_PER_S, 2 * NS_PER_S, 3 * NS_PER_S]
    assert first_x(source) == [points_of(i)[0, 0] for i in (0, 3, 1)]
    assert source.notes == [
        "scans: out of time order in 1 places; sorted",
        "scans: 1 stamps appear twice; the first was kept",
    ]


def test_the_commonest_ending_is_the_log_and_a_pattern_chooses_another(tmp_path):
    folder = cloud_folder(tmp_path, ["os_1.npy", "os_2.npy", "os_3.npy", "velo_1.xyz", "velo_3.xyz"])
    source = open_source(folder)
    assert len(source) == 3
    assert "2 .xyz files left out; source.pattern chooses others" in source.notes
    source = open_source(folder, SourceConfig(pattern="velo_*"))
    assert source.stamps_ns.tolist() == [PERIOD_NS, 3 * PERIOD_NS]
    assert len(source.notes) == 1
    with pytest.raises(SourceError, match=r"no cloud matches source.pattern=livox_\*"):
        open_source(folder, SourceConfig(pattern="livox_*"))


@pytest.mark.parametrize("at", ["", ".."])
def test_tum_truth(tmp_path, at):
    folder = cloud_folder(tmp_path / "log/scans", ["10.0.npy", "11.0.npy", "12.0.npy"])
    truth = Trajectory(NS_PER_S * np.array([10, 11, 12]), POSES[:3])
    write_tum(folder / at / "groundtruth.txt", truth)
    source = open_source(tmp_path / "log")
    assert source.name == "log"
    np.testing.assert_array_equal(source.truth.stamps_ns, truth.stamps_ns)
    np.testing.assert_allclose(source.truth.T_world_body, truth.T_world_body, atol=1e-12)


def test_kitti_truth_has_a_line_a_scan_in_their_order(tmp_path):
    folder = cloud_folder(tmp_path, ["c.npy", "a.npy", "b.npy"])
    (folder / "times.txt").write_text("7\n8\n9\n")
    write_kitti(folder / "poses.txt", Trajectory(np.arange(3), POSES[:3]))
    truth = open_source(folder).truth
    assert truth.stamps_ns.tolist() == [7 * NS_PER_S, 8 * NS_PER_S, 9 * NS_PER_S]
    np.testing.assert_allclose(truth.T_world_body, POSES[:3], atol=1e-12)


def test_poses_that_pair_with_no_scan_are_no_truth(tmp_path):
    folder = cloud_folder(tmp_path, ["a.npy", "b.npy", "c.npy"])
    write_kitti(folder / "poses.txt", Trajectory(np.arange(5), POSES[:5]))
    source = open_source(folder)
    assert source.truth is None
    assert sum("poses.txt: 5 poses for 0 of 3 scans" in note for note in source.notes) == 1


def test_point_times_count_from_the_stamp_of_the_scan(tmp_path):
    for i in range(2):
        begin_s = 1000.0 + i
        write_scan(tmp_path / f"{begin_s}.npy", i, times=begin_s + SWEEP_S)
    for entry in open_source(tmp_path).entries():
        np.testing.assert_allclose(entry.load().times_s, SWEEP_S, atol=1e-6)


def test_the_scale_is_an_option(tmp_path):
    for i in range(2):
        np.save(tmp_path / f"{i}.npy", 1000.0 * points_of(i))
    with pytest.raises(FrameError, match="looks like millimetres"):
        next(open_source(tmp_path).entries()).load()
    scan = next(open_source(tmp_path, SourceConfig(cloud_scale=0.001)).entries()).scan()
    np.testing.assert_allclose(scan.points_body, points_of(0), rtol=1e-5)


def test_a_single_cloud_is_no_log_and_several_folders_are_named(tmp_path):
    write_scan(tmp_path / "one.npy", 0)
    with pytest.raises(SourceError, match=r"one\.npy: one cloud is no log; .* mapper register SOURCE TARGET"):
        open_source(tmp_path / "one.npy")
    with pytest.raises(SourceError, match=r"not a log .*; of clouds it has one, want two or more"):
        open_source(tmp_path)
    for name in ("ouster", "velodyne_left"):
        cloud_folder(tmp_path / "two" / name, ["0.npy", "1.npy"])
    with pytest.raises(SourceError, match="holds 2 folders of clouds; open one of ouster, velodyne_left"):
        open_source(tmp_path / "two")


def test_an_unrelated_folder_is_told_which_formats_there_are(tmp_path):
    (tmp_path / "notes.txt").write_text("milk\n")
    (tmp_path / "0.bin").mkdir()
    (tmp_path / "1.bin").mkdir()
    with pytest.raises(SourceError) as refusal:
        open_source(tmp_path)
    for words in ("TUM", ".mbag", "7-Scenes", "KITTI", "clouds", "docs/your-sensor.md"):
        assert words in str(refusal.value)
    assert len(str(refusal.value)) - len(str(tmp_path)) < 160


def test_clouds_beside_images_do_not_hide_them(tiny_tum_log):
    log = tiny_tum_log()
    cloud_folder(log, ["0.npy", "1.npy"])
    cloud_folder(log / "velodyne", ["0.bin", "1.bin"])
    assert open_source(log).kind == "tum"


@pytest.mark.parametrize("text", ["1\n9223372036854775808\n9\n", "9" * 5000 + "\n1\n2\n", "1 2\n"])
def test_stamps_beyond_64_bits_are_refused(tmp_path, text):
    folder = cloud_folder(tmp_path, ["a.npy", "b.npy", "c.npy"])
    (folder / "times.txt").write_text(text)
    with pytest.raises(SourceError, match=r"times\.txt"):
        open_source(folder)


def test_files_that_macos_leaves_beside_others_are_none(tmp_path):
    folder = cloud_folder(tmp_path, ["0.npy", "1.npy", "2.npy"])
    for path in list(folder.iterdir()):
        (folder / f"._{path.name}").write_bytes(b"\0\5\x16\7")
    assert len(open_source(folder)) == 3


@pytest.mark.parametrize(
    ("folders", "told"),
    [(("left", "right"), "left/"), (("walk/cam/rgb", "walk/cam/depth"), "walk/cam in it")],
)
def test_what_a_folder_of_images_lacks_is_told(tmp_path, folders, told):
    for k, name in enumerate(folders):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "1.png").write_bytes(f"{k}".encode())
    with pytest.raises(SourceError, match=f"not a log .*{told}"):
        open_source(tmp_path)
