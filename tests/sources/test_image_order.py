"""Stamps of other images: told by how alike consecutive images are."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.core.timebase import NS_PER_S
from mapper.sources.image_order import time_warnings
from tests.support.logs import log_in_memory, memory_entry

WALL = cv2.resize(
    np.random.default_rng(4).integers(0, 255, (4, 40)).astype(np.uint8),
    (1280, 96),
    interpolation=cv2.INTER_CUBIC,
)
CAMERA = PinholeCamera(width_px=128, height_px=96, fx_px=100.0, fy_px=100.0, cx_px=64.0, cy_px=48.0)


def passing(order, *, period_ns=10**8, step_px=8):
    """Return a log of images that pass a wall, the k-th from place order[k] on."""
    random = np.random.default_rng(5)
    entries = []
    for k, place in enumerate(order):
        seen = WALL[:, step_px * place : step_px * place + 128]
        image = np.clip(seen + random.normal(0.0, 3.0, seen.shape), 0, 255).astype(np.uint8)
        entries.append(
            memory_entry(
                k * period_ns, RgbdFrame(k * period_ns, image, np.ones(image.shape, np.float32), CAMERA)
            )
        )
    return log_in_memory(entries)


def test_shuffled_images_are_told_and_those_in_order_are_not():
    shuffled = np.random.default_rng(6).permutation(140)

    assert len(time_warnings(passing(shuffled))) == 1
    half_shuffled = np.concatenate([np.arange(70), 70 + np.argsort(shuffled[:70])])
    assert "second half" in time_warnings(passing(half_shuffled))[0]
    assert time_warnings(passing(np.arange(140))) == []


@pytest.mark.parametrize("places", [np.zeros(60, int), np.tile(np.arange(0, 130, 3), 6)])
def test_a_camera_that_stands_and_one_that_goes_round_with_few_images_are_in_order(places):
    assert time_warnings(passing(places)) == []


def test_frames_that_come_every_few_microseconds_are_told():
    assert len(time_warnings(passing(np.arange(60), period_ns=28_000))) == 1


@pytest.mark.parametrize(("period_s", "first_s", "told"), [(67, 0, 1), (10, 0, 0), (60, 1_700_000_000, 0)])
def test_a_clock_of_long_intervals_is_told_unless_it_has_a_date(period_s, first_s, told):
    log = passing(np.arange(60), period_ns=period_s * NS_PER_S)
    later = replace(log, stamps_ns=log.stamps_ns + first_s * NS_PER_S)
    assert len(time_warnings(later)) == told


@pytest.mark.parametrize(("unit", "told"), [(1, 0), (1000, 1)])
def test_scans_one_by_one_are_told_from_milliseconds_by_uneven_intervals(unit, told):
    """A person takes 45 to 90 s from scan to scan; a camera's clock shakes by 5 %, and loses frames."""
    random = np.random.default_rng(7)
    by_hand_s, by_clock_s = random.uniform(45.0, 90.0, 59), random.normal(0.1, 0.005, 59)
    by_clock_s[::5] *= 2.0
    apart_s = unit * (by_hand_s if unit == 1 else by_clock_s)
    stamps_ns = np.concatenate([[0], np.rint(apart_s.cumsum() * NS_PER_S)]).astype(np.int64)
    assert len(time_warnings(replace(passing(np.arange(60)), stamps_ns=stamps_ns))) == told
