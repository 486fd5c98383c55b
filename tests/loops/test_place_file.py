"""The file of a run's places: what is read is what was written, as exactly as it says."""

import numpy as np
import pytest

from mapper.core.errors import RunError
from mapper.features.frame_view import ImageView
from mapper.loops.place_file import read_places, write_places
from mapper.loops.scan_context_proposer import ScanPlace

INTRINSICS = np.array([525.0, 520.0, 320.0, 240.0])


def image(stamp_ns, count, rng):
    pixels = rng.uniform(0.0, 480.0, (count, 2))
    depth_m = rng.uniform(0.5, 5.0, count)
    depth_m[::7] = np.nan
    rays = (pixels - INTRINSICS[2:]) / INTRINSICS[:2]
    return ImageView(
        stamp_ns=stamp_ns,
        pixels=pixels,
        sigma_px=1.2 ** rng.integers(0, 8, count),
        descriptors=rng.integers(0, 256, (count, 32), np.uint8),
        points_camera=np.column_stack([rays * depth_m[:, None], depth_m]),
        intrinsics=INTRINSICS,
        T_body_camera=np.eye(4),
    )


def scan(stamp_ns, count, rng):
    return ScanPlace(stamp_ns, rng.normal(0.0, 20.0, (count, 3)).astype(np.float32), np.eye(4))


def test_images_come_back_with_every_bit_of_their_descriptors(tmp_path):
    rng = np.random.default_rng(0)
    places = {3: image(10, 40, rng), 7: image(20, 0, rng), 8: image(30, 5, rng)}
    write_places(tmp_path / "places.bin", places)
    found = read_places(tmp_path / "places.bin")
    assert list(found) == [3, 7, 8]
    for node, place in places.items():
        back = found[node]
        assert back.stamp_ns == place.stamp_ns
        np.testing.assert_array_equal(back.descriptors, place.descriptors)
        np.testing.assert_allclose(back.pixels, place.pixels, atol=1e-4)
        np.testing.assert_allclose(back.points_camera, place.points_camera, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(back.sigma_px, place.sigma_px, rtol=1e-6)
        assert back.is_orb


def test_scans_come_back_as_they_were(tmp_path):
    rng = np.random.default_rng(0)
    places = {0: scan(10, 30, rng), 4: scan(20, 9, rng)}
    write_places(tmp_path / "places.bin", places)
    for node, back in read_places(tmp_path / "places.bin").items():
        np.testing.assert_array_equal(back.points_body, places[node].points_body)
        np.testing.assert_array_equal(back.T_level_body, places[node].T_level_body)
        assert back.stamp_ns == places[node].stamp_ns


@pytest.mark.parametrize("damage", [lambda data: data[:-20], lambda data: b"x" + data, lambda _: b""])
def test_a_damaged_file_is_refused_by_name(tmp_path, damage):
    path = tmp_path / "places.bin"
    write_places(path, {0: scan(10, 30, np.random.default_rng(0))})
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RunError, match=r"places\.bin"):
        read_places(path)
