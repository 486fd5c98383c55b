"""Depth that does not lie on the images that it belongs to."""

import re
from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapper.core.frames import DepthImage, RgbdFrame
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.depth_outlines import outline_warnings, why_flipped
from mapper.sources.depth_scale import read_spread
from tests.support.logs import changed_frames
from tests.support.paths import DATA


def moved(log: Log, x_px: int, y_px: int, *, contrast: float = 1.0) -> Log:
    """Frames whose depth is moved by some pixels, and whose image has another contrast."""

    def change(_index: int, frame: RgbdFrame) -> RgbdFrame:
        T = np.array([[1.0, 0.0, x_px], [0.0, 1.0, y_px]])
        depth_m = cv2.warpAffine(frame.depth_m, T, frame.depth_m.shape[::-1], flags=cv2.INTER_NEAREST)
        image = (128 + contrast * (frame.image.astype(np.float32) - 128)).astype(np.uint8)
        return replace(frame, depth_m=depth_m, image=image)

    return changed_frames(log, change)


def warnings_of(log: Log) -> list[str]:
    return outline_warnings(read_spread(log).values())


def found_px(log: Log) -> tuple[float, ...]:
    """Return by how much depth has to be moved, by the warning."""
    (warning,) = warnings_of(log)
    return tuple(float(number) for number in re.findall(r"-?\d+", warning)[:2])


@pytest.mark.parametrize("contrast", [1.0, 0.2])
@pytest.mark.parametrize(("x_px", "y_px"), [(24, 0), (-40, 5), (3, -20)])
def test_the_shift_is_found(desk_log, x_px, y_px, contrast):
    log = moved(open_source(desk_log), x_px, y_px, contrast=contrast)
    assert found_px(log) == pytest.approx((-x_px, -y_px), abs=1.0)


@pytest.mark.parametrize("x_px", [-3, 0, 3])
def test_registered_depth_is_not_doubted(desk_log, x_px):
    log = moved(open_source(desk_log), x_px, 0)
    assert warnings_of(log) == []
    assert why_flipped(read_spread(log).values()) is None


def with_depths(log: Log, depths_m: Iterable[DepthImage]) -> list[RgbdFrame]:
    return [replace(frame, depth_m=d) for frame, d in zip(read_spread(log).values(), depths_m, strict=True)]


@pytest.mark.parametrize(("axes", "kind"), [(1, "mirrored"), (0, "upside down"), ((0, 1), "180°")])
def test_mirrored_depth_is_refused(desk_log, axes, kind):
    log = open_source(desk_log)
    flipped = with_depths(log, [np.flip(frame.depth_m, axes) for frame in read_spread(log).values()])
    assert kind in (why_flipped(flipped) or "")


def test_noise_is_no_outline(desk_log):
    """Steps from pixel to pixel that no image shows: depth of stereo pairs far off."""
    log, random = open_source(desk_log), np.random.default_rng(8)
    noise = random.normal(1.0, 0.1, (8, 240, 320)).astype(np.float32)
    noisy = [frame.depth_m * one for frame, one in zip(read_spread(log).values(), noise, strict=True)]
    assert outline_warnings(with_depths(log, noisy)) == []


def test_images_without_contrast_and_few_frames_tell_nothing(desk_log):
    log = open_source(desk_log)
    for contrast in (0.0, 0.02):
        assert warnings_of(moved(log, 24, 0, contrast=contrast)) == []
    assert warnings_of(moved(log, 24, 0)[:3]) == []


@pytest.mark.skipif(not DATA.is_dir(), reason="no real logs here")
@pytest.mark.parametrize("name", ["tum_fr1_xyz", "tum_fr3_teddy", "tum_fr3_cabinet_1_5hz"])
def test_real_depth_is_registered_and_found_where_it_is_not(name):
    log = open_source(DATA / name)
    assert warnings_of(log) == []
    assert why_flipped(read_spread(log).values()) is None
    assert found_px(moved(log, 32, 0)) == pytest.approx((-32.0, 0.0), abs=5.0)


@pytest.mark.skipif(not DATA.is_dir(), reason="no real logs here")
def test_depth_of_another_time_or_camera_is_told():
    log, other = (open_source(DATA / name) for name in ("tum_fr1_xyz", "tum_fr3_teddy"))
    second_later = [log[index + 30 if index < len(log) - 30 else 0].depth_m for index in read_spread(log)]
    of_other = [frame.depth_m for frame in read_spread(other).values()]
    for depths_m in (second_later, of_other):
        (warning,) = outline_warnings(with_depths(log, depths_m))
        assert "source.depth_offset_s" in warning
