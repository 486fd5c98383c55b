"""Records of other widths than KITTI's are told, and KITTI's are read whatever their intensities."""

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.sources import open_source
from mapper.sources.cloud_files import read_cloud

N = 1680  # whole records of every width up to 8


def sweep(*, shuffled=False):
    """Sixteen rings of a sensor in a hall, in the order of firing: lower and upper ones take turns."""
    rng = np.random.default_rng(1)
    azimuth = np.repeat(np.linspace(0.0, 2.0 * np.pi, N // 16), 16)
    down = np.tile(np.deg2rad([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]), N // 16)
    range_m = 8.0 + 3.0 * np.sin(3.0 * azimuth)
    xyz = np.column_stack([np.cos(azimuth) * np.cos(down), np.sin(azimuth) * np.cos(down), np.sin(down)])
    xyz *= range_m[:, None]
    return rng.permutation(xyz) if shuffled else xyz


def written(path, *columns):
    np.column_stack(columns).astype("<f4").tofile(path)
    return path


RNG = np.random.default_rng(2)
INTENSITIES = {
    "share": RNG.uniform(0.0, 1.0, N),
    "byte": RNG.integers(0, 256, N),
    "16 bits": RNG.integers(0, 65536, N),
    "signed byte": RNG.integers(-128, 128, N),
    "dB": RNG.uniform(-40.0, 10.0, N),
    "unknown": np.full(N, -1.0),
    "unknown, -999": np.full(N, -999.0),
    "often unknown": np.where(RNG.random(N) < 0.3, -100.0, RNG.uniform(0.0, 255.0, N)),
    "no number": np.full(N, np.nan),
    "infinite": np.full(N, -np.inf),
    "seconds before the end": np.linspace(-0.1, 0.0, N),
    "microseconds before the end": np.linspace(-1e5, 0.0, N),
}


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("intensity", INTENSITIES.values(), ids=INTENSITIES.keys())
def test_kittis_records_are_read_whatever_their_intensities(tmp_path, intensity, shuffled):
    xyz = sweep(shuffled=shuffled)
    cloud = read_cloud(written(tmp_path / "a.bin", xyz, intensity))
    np.testing.assert_array_equal(cloud.points, xyz.astype(np.float32))


@pytest.mark.parametrize("rows", [np.zeros((600, 4)), np.full((600, 4), np.nan)])
def test_kittis_records_may_be_padded(tmp_path, rows):
    padded = np.vstack([rows, np.column_stack([sweep(), INTENSITIES["byte"]]), rows])
    assert len(read_cloud(written(tmp_path / "a.bin", padded)).points) == N


RING, TIME = np.tile(np.arange(16), N // 16), np.linspace(0.0, 0.1, N)
OTHERS = {
    3: [],
    5: [INTENSITIES["byte"], TIME],
    6: [INTENSITIES["byte"], TIME, RING],
    7: [INTENSITIES["share"], RING, TIME, INTENSITIES["byte"]],
    8: [np.ones(N), INTENSITIES["share"], np.zeros((N, 3))],
}


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize(("width", "columns"), OTHERS.items())
def test_other_records_are_told_and_the_remedy_works(tmp_path, width, columns, shuffled):
    xyz = sweep(shuffled=shuffled)
    path = written(tmp_path / "a.bin", xyz, *columns)
    assert path.stat().st_size % 16 == 0
    with pytest.raises(FrameError, match=rf"records of {width} float32, .*source.bin_columns={width} takes"):
        read_cloud(path)
    np.testing.assert_array_equal(read_cloud(path, bin_columns=width).points, xyz.astype(np.float32))


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("times", [[], [TIME - 0.05]])
def test_records_with_rings_are_read(tmp_path, times, shuffled):
    xyz = sweep(shuffled=shuffled)
    cloud = read_cloud(written(tmp_path / "a.bin", xyz, INTENSITIES["byte"], RING, *times))
    np.testing.assert_array_equal(cloud.points, xyz.astype(np.float32))
    np.testing.assert_array_equal(cloud.intensities, INTENSITIES["byte"])
    for found, expected in zip([] if cloud.times is None else [cloud.times], times, strict=True):
        np.testing.assert_array_equal(found, expected.astype(np.float32))


def test_a_cloud_of_a_log_is_read_as_the_first_is(tmp_path):
    for k in range(3):
        rows = slice(None) if k < 2 else slice(0, 20)  # too few to tell the width of
        columns = [values[rows] for values in (sweep(), INTENSITIES["byte"], RING, TIME)]
        written(tmp_path / f"{k}.bin", *columns)
    last = open_source(tmp_path).entry_at(2).load()
    np.testing.assert_array_equal(last.points_body, sweep()[:20].astype(np.float32))
    np.testing.assert_allclose(last.times_s, TIME[:20], atol=1e-7)


def test_what_shows_no_width_is_refused_if_its_intensities_are_like_coordinates(tmp_path):
    path = written(tmp_path / "a.bin", np.random.default_rng(1).uniform(-40.0, 40.0, (N, 3)))
    why = (
        "every fourth float32 is negative as coordinates are.*source.bin_columns=3 if records have 3, or 4 if"
    )
    with pytest.raises(FrameError, match=why):
        read_cloud(path)
    assert len(read_cloud(path, bin_columns=4).points) == N * 3 // 4


def test_a_cut_file_is_told_as_one(tmp_path):
    path = written(tmp_path / "a.bin", sweep(), INTENSITIES["byte"])
    path.write_bytes(path.read_bytes()[:-4])
    assert path.stat().st_size % 16
    with pytest.raises(FrameError, match=r"26876 bytes, want a multiple of 16, .*copy it again"):
        read_cloud(path)
    with pytest.raises(FrameError, match="want a multiple of 20, 5 float32"):
        read_cloud(path, bin_columns=5)


def test_scans_of_nuscenes_have_their_stamps(tmp_path):
    stamps_ns = [1532402927647951000 + i * 50_000_000 for i in range(3)]
    for stamp_ns in stamps_ns:
        written(tmp_path / f"n015__LIDAR_TOP__{stamp_ns // 1000}.pcd.bin", sweep(), INTENSITIES["byte"], RING)
    log = open_source(tmp_path)
    assert log.stamps_ns.tolist() == stamps_ns
    assert len(log.entry_at(0).load().points_body) == N


def test_records_that_begin_with_an_intensity_are_refused(tmp_path):
    xyz = sweep()
    path = written(tmp_path / "a.bin", INTENSITIES["share"], xyz)
    with pytest.raises(FrameError, match="no coordinate"):
        read_cloud(path)


@pytest.mark.parametrize("ending", [".npy", ".txt"])
def test_points_that_begin_with_their_time_are_refused(tmp_path, ending):
    table = np.column_stack([np.linspace(0.0, 0.1, N), sweep()])
    path = tmp_path / f"a{ending}"
    np.save(path, table) if ending == ".npy" else np.savetxt(path, table, fmt="%.4f")
    with pytest.raises(FrameError, match="no coordinate"):
        read_cloud(path)
    if ending == ".txt":
        path.write_text(f"t x y z\n{path.read_text()}")
        assert len(read_cloud(path).points) == N


def test_records_of_nclt_are_turned_upright(tmp_path):
    records = np.zeros(N, np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")]))
    points = np.random.default_rng(0).uniform(-60.0, 60.0, (N, 3))
    records["xyz"] = np.rint((points * [1.0, -1.0, -1.0] + 100.0) / 0.005)
    records["intensity"], records["laser"] = 50, np.arange(N) % 32
    records.tofile(tmp_path / "1326030975726043.bin")
    cloud = read_cloud(tmp_path / "1326030975726043.bin")
    np.testing.assert_allclose(cloud.points, points, atol=0.0026)
    assert set(cloud.intensities) == {50.0}
