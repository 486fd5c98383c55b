import json

import cv2
import numpy as np
import pytest

from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.sources.config import SourceConfig
from mapper.sources.image_quality import ImageChecks
from mapper.sources.imu_files import accelerations_of
from mapper.sources.inspection import inspect_log
from tests.support.command_line import invoke

CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)


@pytest.fixture(scope="module")
def scene():
    """Wall of rectangles, whose edges are one pixel wide, larger than an image."""
    rng = np.random.default_rng(0)
    wall = np.full((600, 4000), 120, np.uint8)
    for _ in range(4000):
        (x, y), (w, h) = rng.integers((4000, 600)), rng.integers(8, 60, 2)
        cv2.rectangle(wall, (int(x), int(y)), (int(x + w), int(y + h)), int(rng.integers(30, 220)), -1)
    return wall


def quality(scene, *, step_px=8, frames=40, change=lambda image: image):
    checks = ImageChecks(frames)
    for k in range(frames):
        image = np.ascontiguousarray(change(scene[:480, k * step_px : k * step_px + 640]))
        checks.add(k, RgbdFrame(k, image, np.ones((480, 640), np.float32), CAMERA))
    assert checks.missing == []
    return checks.quality()


def moved(length_px):
    """Motion blur along the rows."""
    return lambda image: cv2.blur(image, (length_px, 1))


def test_sharp_bright_images_side_by_side_get_no_advice(scene):
    found = quality(scene)
    assert found.looked_at == 40
    assert found.edges_px == pytest.approx(1.0)
    assert (found.blurred, found.saturated, found.advice) == (0, 0.0, ())
    assert found.brightest > 150.0
    assert found.overlap == pytest.approx(1.0 - 8 / 640, abs=0.002)


@pytest.mark.parametrize(("length_px", "blurred"), [(5, 0), (19, 40)])
def test_motion_blur_is_as_wide_as_it_is(scene, length_px, blurred):
    found = quality(scene, change=moved(length_px))
    assert found.edges_px == pytest.approx(length_px, rel=0.35)
    assert found.blurred == blurred
    assert len(found.advice) == (blurred > 0)


def test_a_few_blurred_images_are_counted_without_advice(scene):
    images = iter([moved(19)] * 5 + [moved(1)] * 35)
    found = quality(scene, change=lambda image: next(images)(image))
    assert (found.blurred, found.advice) == (5, ())


@pytest.mark.parametrize(("gain", "word"), [(0.16, "dark"), (0.5, None), (1.15, None), (4.0, "saturated")])
def test_exposure(scene, gain, word):
    found = quality(scene, change=lambda image: cv2.convertScaleAbs(image, alpha=gain))
    assert [word in sentence for sentence in found.advice] == ([] if word is None else [True])
    assert (found.saturated > 0.4) == (word == "saturated")


@pytest.mark.parametrize(("step_px", "is_enough"), [(120, True), (260, False), (700, False)])
def test_overlap_is_that_of_the_shift(scene, step_px, is_enough):
    found = quality(scene, step_px=step_px, frames=5)
    share = max(0.0, 1.0 - step_px / 640)
    assert found.overlap == pytest.approx(share, abs=0.02)
    assert len(found.advice) == (not is_enough)


def test_images_without_texture_have_neither_edges_nor_overlap(scene):
    found = quality(np.full_like(scene, 128))
    assert (found.edges_px, found.blurred, found.overlap, found.advice) == (None, 0, None, ())


def test_the_least_overlap_names_its_frame(scene):
    checks = ImageChecks(6)
    for k, column in enumerate((0, 8, 16, 216, 224, 232)):
        image = np.ascontiguousarray(scene[:480, column : column + 640])
        checks.add(k, RgbdFrame(k, image, np.ones((480, 640), np.float32), CAMERA))
    found = checks.quality()
    assert found.least_overlap_frame == 2
    assert found.least_overlap == pytest.approx(1.0 - 200 / 640, abs=0.02)


@pytest.mark.parametrize("frames", [0, 1])
def test_one_image_has_no_neighbour(scene, frames):
    found = quality(scene, frames=frames)
    assert found is None if frames == 0 else found.overlap is None


def test_a_log_of_large_images_tells_its_quality_in_text_and_json(tmp_path, scene):
    for folder in ("rgb", "depth"):
        (tmp_path / folder).mkdir()
    for k in range(12):
        cv2.imwrite(str(tmp_path / f"rgb/{k}.png"), moved(21)(scene[:480, 10 * k : 10 * k + 640]))
        cv2.imwrite(str(tmp_path / f"depth/{k}.png"), np.full((480, 640), 1500 + k, np.uint16))
    (tmp_path / "calibration.toml").write_text("fx = 500\nfy = 500\ncx = 320\ncy = 240\n")
    assert inspect_log(tmp_path, SourceConfig()).log.images.blurred == 12
    assert "12 of 12 blurred" in invoke("inspect", tmp_path).stdout
    images = json.loads(invoke("inspect", tmp_path, "--json").stdout)["log"]["images"]
    assert images["overlap"] == pytest.approx(1.0 - 10 / 640, abs=0.01)
    assert len(images["advice"]) == 1


def test_accelerations_at_the_end_of_the_range_are_named():
    rng = np.random.default_rng(0)
    stamps_ns = np.arange(500) * 5_000_000
    felt = rng.normal((0.0, 0.0, 9.81), 4.0, (500, 3))
    assert accelerations_of("imu", stamps_ns, felt)[1] == []
    (note,) = accelerations_of("imu", stamps_ns, np.clip(felt, -16.0, 16.0))[1]
    assert f"imu: {int((felt > 16.0).any(axis=1).sum())} of 500 " in note
    at_rest = np.tile((0.0, 0.0, 9.81), (500, 1))
    assert accelerations_of("imu", stamps_ns, at_rest)[1] == []
