import numpy as np
import pytest

from mapper.core.errors import ConfigError, SourceError
from mapper.core.frames import Scan
from mapper.core.geometry import apply, rotation_exp, transform
from mapper.core.trajectory import trajectory_from
from mapper.evaluators.papers.hough import METHODS, HoughTrial, hough_jobs, hough_reproduction
from mapper.evaluators.papers.hough_pairs import (
    ALL_RINGS,
    FEW_RINGS,
    fewer_rings,
    find_pairs,
)
from mapper.runtime.resumable_jobs import JobResult
from mapper.sources.trajectory_files import read_kitti, write_kitti
from tests.support.paths import DATA
from tests.support.street_scans import on_street, street, view

RELLIS = DATA / "rellis_cross_sensor"
SCANS = 6


def write_bin(path, points):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([points, np.zeros(len(points))]).astype(np.float32).tofile(path)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return a folder with a LiDAR log of six scans, 2 m apart, and their true poses."""
    folder = tmp_path_factory.mktemp("logs")
    scene = street(3)
    poses = [on_street(scene, 20.0 + 2.0 * k, yaw_rad=0.1 * k) for k in range(SCANS)]
    for k, T in enumerate(poses):
        write_bin(folder / f"drive/velodyne/{k:06d}.bin", view(scene, T, seed=k).points_body)
    write_kitti(folder / "drive/poses.txt", trajectory_from(enumerate(poses)))
    return folder


def test_every_log_gives_scans_and_the_map_of_the_others(logs):
    pairs = find_pairs(logs)

    assert [pair.name for pair in pairs] == [f"drive scan {k}" for k in (1, 2, 3, 4)]
    assert {pair.sensor for pair in pairs} == {ALL_RINGS}  # too few points to be thinned further
    clouds = pairs[1].clouds()
    true = read_kitti(logs / "drive/poses.txt").T_world_body[2]
    assert np.allclose(clouds.T_target_source[:3, :3], true[:3, :3], atol=1e-6)  # as level as the world
    in_map = apply(clouds.T_target_source, clouds.source.points_body.astype(np.float64))
    nearest_m = [np.abs(clouds.target.points_body - point).max(axis=1).min() for point in in_map[::500]]
    assert np.median(nearest_m) < 0.3
    assert min(nearest_m) > 1e-4  # the scan itself is not in the map
    assert find_pairs(logs / "drive") == pairs
    assert len({pair.identity() for pair in pairs}) == len(pairs)


def test_a_trial_finds_the_scan_again_where_its_seed_alone_has_put_it(logs, tmp_path):
    picture = tmp_path / "pair.png"
    (record,) = HoughTrial(find_pairs(logs)[1], "hough-gicp", 0, picture)()

    assert record["right"]
    assert record["trusted"]
    assert record["error_m"] < 0.1
    assert record["mpd_final_m"] < 0.3 * record["mpd_input_m"]
    assert record["mpd_final_m"] < 1.2 * record["mpd_truth_m"]
    assert 0.0 < record["offset_m"] < 10.5
    assert record["seconds"] > 0.0
    assert picture.read_bytes().startswith(b"\x89PNG")
    again, other = (HoughTrial(find_pairs(logs)[1], "hough-ndt", seed, None)()[0] for seed in (0, 1))
    assert (again["offset_m"], again["yaw_deg"]) == (record["offset_m"], record["yaw_deg"])
    assert other["offset_m"] != record["offset_m"]


def test_cells_are_told_apart_by_pair_method_and_seed(logs, tmp_path):
    cells = list(hough_jobs(logs, seeds=2, pictures=tmp_path).values())

    assert len({cell.key for cell in cells}) == len(cells) == 4 * len(METHODS) * 2
    again = hough_jobs(logs, seeds=3, pictures=tmp_path / "elsewhere").values()
    assert {cell.key for cell in cells} < {cell.key for cell in again}
    assert [cell.run.picture is not None for cell in cells[:2]] == [True, False]


def test_every_fourth_of_64_rings_is_kept():
    elevations = np.radians(np.linspace(-25.0, 15.0, 64))
    azimuths = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    ring, azimuth = (grid.ravel() for grid in np.meshgrid(np.arange(64), azimuths, indexing="ij"))
    points = 20.0 * np.column_stack(
        [
            np.cos(elevations[ring]) * np.cos(azimuth),
            np.cos(elevations[ring]) * np.sin(azimuth),
            np.sin(elevations[ring]),
        ]
    )

    kept = fewer_rings(Scan(0, points.astype(np.float32))).points_body

    rings = np.unique(np.degrees(np.arcsin(kept[:, 2] / 20.0)).round(2))
    assert 15 <= len(rings) <= 17
    assert len(kept) == pytest.approx(1600, rel=0.07)


def write_pairs(folder, text):
    (folder / "pairs.toml").write_text(text)
    return folder


def test_given_pairs_are_read_with_their_pose(tmp_path):
    cloud = np.random.default_rng(0).uniform(-5.0, 5.0, (200, 3))
    T_map_scan = transform(rotation_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([100.0, 50.0, 2.0]))
    write_bin(tmp_path / "scan.bin", cloud)
    np.save(tmp_path / "map.npy", np.vstack([apply(T_map_scan, cloud), [[60.0, 20.0, 0.0]]]))
    folder = write_pairs(
        tmp_path,
        '[[pair]]\nname = "square"\nscan = "scan.bin"\nmap = "map.npy"\nsensor = "VLP"\n'
        "pose = [100, 50, 2, 0, 0, 90]\nwithin_m = 0.1\nwithin_deg = 0.5\n",
    )

    (pair,) = find_pairs(folder)

    clouds = pair.clouds()
    assert (pair.name, pair.sensor, pair.within) == ("square", "VLP", (0.1, 0.5))
    in_map = apply(clouds.T_target_source, clouds.source.points_body.astype(np.float64))
    assert np.allclose(in_map, clouds.target.points_body[:200], atol=1e-4)
    assert np.linalg.norm(clouds.T_target_source[:3, 3]) < 1e-9  # the map's origin is where the scan was


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('[[pair]]\nname = "a"\nscan = "no.bin"\nmap = "no.bin"', "no such file"),
        ('[[pair]]\nname = "a"\nscan = "a.bin"', "pair.0.map: want a value, which is missing"),
        ('[[pair]]\nname = "a"\nscan = "a.bin"\nmap = "a.bin"\npose = [1, 2]', "pair.0.pose"),
        ("pair = []", "pair: want 1 or more"),
        ("[[pair]", "not valid TOML"),
        ('[[pair]]\nname = "a"\nscan = "a.bin"\nmap = "a.bin"\n' * 2, "more than one is called 'a'"),
    ],
)
def test_bad_pairs_are_refused_in_a_line(tmp_path, text, complaint):
    write_bin(tmp_path / "a.bin", np.ones((20, 3)))

    with pytest.raises((ConfigError, SourceError)) as error:
        find_pairs(write_pairs(tmp_path, text))

    assert complaint in str(error.value)
    assert "pairs.toml" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_folder_without_pairs_is_refused(tmp_path):
    with pytest.raises(SourceError, match="no such folder"):
        find_pairs(tmp_path / "nowhere")
    write_bin(tmp_path / "drive/velodyne/000000.bin", np.ones((20, 3)))  # no truth
    with pytest.raises(SourceError, match=r"no pairs.toml, and neither it nor a folder in it"):
        find_pairs(tmp_path)


@pytest.mark.skipif(not RELLIS.is_dir(), reason=f"{RELLIS} is missing")
def test_two_sensors_tied_by_an_extrinsic_are_a_pair():
    (pair,) = find_pairs(RELLIS)

    assert (pair.name, pair.sensor) == ("rellis_cross_sensor 000104", "vel on os1")
    assert pair.within[0] > 0.3  # the extrinsic is coarse


def trial(**changes):
    distances = dict.fromkeys(
        (f"{m}_{s}_m" for m in ("mhd", "mpd") for s in ("input", "hough", "final")), 0.5
    )
    return {
        "pair": "a", "sensor": ALL_RINGS, "method": "hough-gicp", "seed": 0, "offset_m": 4.0, "yaw_deg": 9.0,
        **distances, "seconds": 1.0, "error_m": 0.1, "error_deg": 0.1, "mpd_truth_m": 0.01, "right": 1,
        "trusted": 1, "reason": "", **changes,
    }  # fmt: skip


def results_of(*trials):
    return [JobResult(f"k{i}", f"cell {i}", (each,), 1.0) for i, each in enumerate(trials)]


def cell_of(reproduction, table, row, column):
    (found,) = (
        cell
        for each in reproduction.tables
        if each.name == table
        for cell in each.cells
        if (cell.row, cell.column) == (row, column)
    )
    return found


def test_the_summary_counts_over_pairs_and_spreads_over_seeds(tmp_path):
    reproduction = hough_reproduction(
        results_of(
            trial(mpd_final_m=0.01),
            trial(pair="b", right=0, trusted=0, reason="doubtful"),
            trial(seed=1, mpd_final_m=0.02, seconds=3.0),
            trial(seed=1, pair="b", mpd_final_m=0.02),
        ),
        pictures=tmp_path,
    )

    wrong = cell_of(reproduction, "Table 1, summary", "all rings, hough-gicp", "wrong, %")
    far = cell_of(reproduction, "Table 1, summary", "all rings, hough-gicp", "final MPD ≥ 3 cm, %")
    seconds = cell_of(reproduction, "Table 1, summary", "all rings, hough-gicp", "median time, s")
    assert (wrong.ours, wrong.published) == ((50.0, 0.0), 12.5)
    assert (far.ours, far.published) == ((50.0, 0.0), 12.5)  # the paper: seven of its eight HDL scenes
    assert seconds.ours == (1.0, 2.0)
    assert seconds.published == pytest.approx(1.541)
    doubted = cell_of(reproduction, "Table 1, errors", "b, all rings, hough-gicp", "not trusted, %")
    assert doubted.ours == (50.0,)
    assert doubted.failures == ("seed 0: not trusted: doubtful",)
    assert reproduction.seeds == 2


def test_only_pictures_of_these_pairs_are_shown(tmp_path):
    (tmp_path / "a_all_rings_hough-gicp.png").touch()
    (tmp_path / "b_all_rings_hough-gicp.png").touch()  # of another session

    reproduction = hough_reproduction(results_of(trial(), trial(seed=1)), pictures=tmp_path)

    assert reproduction.pictures == (tmp_path / "a_all_rings_hough-gicp.png",)


def test_fewer_rings_stand_beside_the_vlp_and_other_sensors_beside_nothing(tmp_path):
    reproduction = hough_reproduction(
        results_of(trial(sensor=FEW_RINGS), trial(sensor="os1")), pictures=tmp_path
    )

    far = "final MPD ≥ 3 cm, %"
    assert cell_of(reproduction, "Table 1, summary", "16 rings, hough-gicp", far).published == 37.5
    assert cell_of(reproduction, "Table 1, summary", "os1, hough-gicp", far).published is None


def test_what_is_missing_is_told(tmp_path):
    missing = dict.fromkeys(
        ("mhd_hough_m", "mpd_hough_m", "mhd_final_m", "mpd_final_m", "error_m", "error_deg")
    )
    results = results_of(trial(**missing, right=0, trusted=0, reason="no objects"))
    broken = JobResult("k9", "c, 16 rings, hough-ndt, seed 0", (), 0.0, "c.bin: is empty")

    reproduction = hough_reproduction([*results, broken], pictures=tmp_path)

    final = cell_of(reproduction, "Table 1, hough-gicp", "a, all rings", "MPD final, m")
    assert (final.verdict, final.failures) == ("failed", ("seed 0: no objects",))
    assert cell_of(reproduction, "Table 1, summary", "all rings, hough-gicp", "wrong, %").ours == (100.0,)
    assert "failed: c, 16 rings, hough-ndt, seed 0: c.bin: is empty" in reproduction.notes
    printed = cell_of(reproduction, "Table 1", "Bajcsy VLP", "MPD final, m")
    assert (printed.published, printed.verdict) == (14.341, "not run")
