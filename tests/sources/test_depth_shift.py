"""Depth that does not lie on the images that it belongs to."""

import re
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from mapper.core.frames import RgbdFrame
from mapper.sources import open_source
from mapper.sources.base import Log, WrappedEntry
from mapper.sources.depth_scale import read_spread
from mapper.sources.depth_shift import shift_warnings
from tests.support.paths import DATA


@dataclass(frozen=True, slots=True)
class Moved(WrappedEntry):
    """A frame whose depth is moved by some pixels, and whose image has another contrast."""

    shift_px: tuple[int, int]
    contrast: float = 1.0

    def load(self, *, colour: bool = True) -> RgbdFrame:
        frame = self.entry.load(colour=colour)
        assert isinstance(frame, RgbdFrame)
        T = np.array([[1.0, 0.0, self.shift_px[0]], [0.0, 1.0, self.shift_px[1]]])
        depth_m = cv2.warpAffine(frame.depth_m, T, frame.depth_m.shape[::-1], flags=cv2.INTER_NEAREST)
        image = (128 + self.contrast * (frame.image.astype(np.float32) - 128)).astype(np.uint8)
        return replace(frame, depth_m=depth_m, image=image)


def moved(log: Log, x_px: int, y_px: int, *, contrast: float = 1.0) -> Log:
    return replace(log, entry_at=lambda index: Moved(log.entry_at(index), (x_px, y_px), contrast))


def warnings_of(log: Log) -> list[str]:
    return shift_warnings(read_spread(log).values())


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
    assert warnings_of(moved(open_source(desk_log), x_px, 0)) == []


def test_images_without_contrast_and_few_frames_tell_nothing(desk_log):
    log = open_source(desk_log)
    assert warnings_of(moved(log, 24, 0, contrast=0.0)) == []
    assert warnings_of(moved(log, 24, 0)[:3]) == []


@pytest.mark.skipif(not DATA.is_dir(), reason="no real logs here")
@pytest.mark.parametrize("name", ["tum_fr1_xyz", "tum_fr3_teddy", "tum_fr3_cabinet_1_5hz"])
def test_real_depth_is_registered_and_found_where_it_is_not(name):
    log = open_source(DATA / name)
    assert warnings_of(log) == []
    assert found_px(moved(log, 32, 0)) == pytest.approx((-32.0, 0.0), abs=5.0)
