import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.core.frames import Cloud
from mapper.mapping import cloud
from mapper.mapping.cloud import CloudBuilder, thinned_to_view


def random_cloud(n, *, seed=0, extent_m=2.0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-extent_m, extent_m, (n, 3)).astype(np.float32)
    return points, rng.integers(0, 256, (n, 3), dtype=np.uint8)


def averaged_by_dictionary(points, colors, voxel_m):
    voxels = {}
    for point, color in zip(points.astype(np.float64), colors, strict=True):
        voxels.setdefault(tuple(np.floor(point * (1.0 / voxel_m))), []).append([*point, *color])
    means = np.array([np.mean(members, axis=0) for members in voxels.values()])
    return means[:, :3], np.rint(means[:, 3:])


def test_each_voxel_holds_the_mean_of_its_points():
    points, colors = random_cloud(9000)
    builder = CloudBuilder(0.5)
    builder.add(Cloud(points, colors))

    got = builder.cloud()

    want_points, want_colors = averaged_by_dictionary(points, colors, 0.5)
    assert len(builder) == len(want_points) == 512
    np.testing.assert_allclose(got.points, want_points, atol=1e-6)
    np.testing.assert_array_equal(got.colors, want_colors)
    assert got.points.dtype == np.float32
    assert got.colors.dtype == np.uint8


def test_intensities_are_averaged_where_all_clouds_have_them():
    points, colors = random_cloud(150_000, extent_m=5.0)
    intensities = np.abs(points).sum(axis=1)
    builder = CloudBuilder(0.5)
    for part in np.array_split(np.arange(len(points)), 3):
        builder.add(Cloud(points[part], colors[part], intensities[part]))
    got = builder.cloud()
    cells = np.floor(points.astype(np.float64) * 2.0).astype(int)
    first = (cells == cells[0]).all(axis=1)
    assert got.intensities is not None
    assert got.intensities[0] == pytest.approx(intensities[first].mean(), rel=1e-4)
    assert len(got.intensities) == len(got) == 20**3
    builder.add(Cloud(points[:10], colors[:10]))
    assert builder.cloud().intensities is None


def test_batches_and_repeats_change_nothing():
    points, colors = random_cloud(5000)
    whole, parts = CloudBuilder(0.1), CloudBuilder(0.1)
    whole.add(Cloud(points, colors))
    for first in range(0, 5000, 777):
        parts.add(Cloud(points[first : first + 777], colors[first : first + 777]))

    got, want = parts.cloud(), whole.cloud()
    assert got.points.tobytes() == want.points.tobytes()
    assert got.colors.tobytes() == want.colors.tobytes()


def test_the_table_grows_past_its_first_size():
    points, colors = random_cloud(150_000, extent_m=5.0)
    builder = CloudBuilder(0.02)
    builder.add(Cloud(points, colors))

    cells = np.floor(points.astype(np.float64) * (1.0 / 0.02)).astype(np.int64)
    assert len(builder) == len(np.unique(cells, axis=0)) > 140_000


def test_memory_follows_the_scene_not_the_log():
    points, colors = random_cloud(100_000, extent_m=1.0)
    builder = CloudBuilder(0.1)
    for _ in range(8):
        builder.add(Cloud(points, colors))

    assert len(builder) == 20**3
    assert sum(a.nbytes for a in vars(builder).values() if isinstance(a, np.ndarray)) < 20e6


def test_an_empty_cloud_is_empty():
    builder = CloudBuilder(0.1)
    builder.add(Cloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)))

    got = builder.cloud()
    assert got.points.shape == got.colors.shape == (0, 3)
    assert got.intensities is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e7])
def test_refuses_what_has_no_voxel(bad):
    points, colors = random_cloud(10)
    points[3, 1] = bad
    with pytest.raises(DataError, match="enlarge the voxel"):
        CloudBuilder(0.1).add(Cloud(points, colors))


def test_refuses_unequal_shapes_and_senseless_voxels():
    points, colors = random_cloud(10)
    with pytest.raises(DataError, match=r"colors \(9, 3\)"):
        CloudBuilder(0.1).add(Cloud(points, colors[:9]))
    with pytest.raises(DataError, match=r"0\.0 m; want"):
        CloudBuilder(0.0)


def test_many_points_in_a_voxel_and_far_from_the_origin_keep_their_mean():
    center_m = np.array([-5000.0, 3000.0, 10.0])
    points, colors = random_cloud(300_000, extent_m=0.009)
    builder = CloudBuilder(0.02)
    for _ in range(4):
        builder.add(Cloud((points + center_m + 0.01).astype(np.float32), colors))

    got = builder.cloud()
    assert len(builder) == 1
    np.testing.assert_allclose(got.points[0], center_m + 0.01, atol=5e-4)  # single precision there
    np.testing.assert_array_equal(got.colors[0], np.rint(colors.mean(axis=0)))


def test_a_cloud_is_thinned_only_beyond_what_can_be_viewed(monkeypatch):
    points, colors = random_cloud(1000)
    monkeypatch.setattr(cloud, "MOST_TO_VIEW", 1000)
    assert thinned_to_view(points, colors)[0].tobytes() == points.tobytes()
    monkeypatch.setattr(cloud, "MOST_TO_VIEW", 300)
    few, their_colors = thinned_to_view(points, colors)
    assert len(few) == len(their_colors) == 250
    assert (few == points[::4]).all()
    assert len(thinned_to_view(points[:0], colors[:0])[0]) == 0
