from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import ray_table
from mapper.core.geometry import exp
from mapper.sources.calibration import Calibration, DepthCamera
from mapper.sources.image_files.image_sizes import recorded_camera
from mapper.sources.lens import Lens

SIZES = [  # of colour, of depth, and of frames
    ((640, 480), (640, 480), (640, 480)),
    ((1280, 960), (640, 480), (640, 480)),
    ((1296, 968), (640, 480), (640, 480)),
    ((1280, 720), (848, 480), (848, 480)),
    ((1920, 1440), (256, 192), (768, 576)),
    ((1440, 1920), (192, 256), (576, 768)),
    ((640, 480), (320, 240), (640, 480)),
    ((640, 480), (256, 192), (640, 480)),
    ((320, 240), (160, 120), (320, 240)),
    ((320, 240), (640, 480), (640, 480)),
]


def calibration_of(size_px, *, is_stated=False):
    width_px, height_px = size_px
    return Calibration(
        "test",
        *(0.8 * width_px, 0.82 * width_px, 0.53 * width_px, 0.46 * height_px),
        size_px=size_px if is_stated else None,
    )


def recorded(colour_px, depth_px):
    return recorded_camera(calibration_of(colour_px), colour_px=colour_px, depth_px=depth_px, where="log")


def size_of(camera):
    return camera.width_px, camera.height_px


@pytest.mark.parametrize(("colour_px", "depth_px", "frame_px"), SIZES)
@pytest.mark.parametrize("axis", [0, 1])
def test_resized_images_show_every_direction_at_its_pixel(colour_px, depth_px, frame_px, axis):
    sizes = recorded(colour_px, depth_px)
    assert size_of(sizes.camera) == frame_px
    of_colour = calibration_of(colour_px).camera(width_px=colour_px[0], height_px=colour_px[1])
    of_depth = of_colour.resized(*depth_px)
    # Pixels whose value is the direction that they look in; half a pixel beside is another direction.
    image = sizes.image(ray_table(of_colour)[:, :, axis], "colour")
    depth_m = sizes.depth_m(ray_table(of_depth)[:, :, axis], "depth")
    wanted = ray_table(sizes.camera)[:, :, axis]
    pixel = 1.0 / (sizes.camera.fx_px, sizes.camera.fy_px)[axis]
    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(image - wanted)[inner].max() < 0.1 * pixel
    assert abs((image - wanted)[inner].mean()) < 0.01 * pixel
    nearest = 1.0 / (of_depth.fx_px, of_depth.fy_px)[axis]
    assert np.abs(depth_m - wanted).max() < 0.51 * nearest
    assert abs((depth_m - wanted).mean()) < 0.08 * nearest  # where a pixel is as near to two, one is taken
    measured_m = np.random.default_rng(0).uniform(0.5, 5.0, depth_px[::-1]).astype(np.float32)
    assert np.isin(sizes.depth_m(measured_m, "depth"), measured_m).all()


def test_a_calibration_holds_for_colour_or_for_the_size_that_it_states():
    colour_px, depth_px = (1280, 960), (640, 480)
    sizes = {"colour_px": colour_px, "depth_px": depth_px, "where": "log"}
    camera = recorded_camera(calibration_of(colour_px), **sizes).camera
    assert size_of(camera) == depth_px
    wanted = (512.0, 0.82 * 640, (678.4 + 0.5) / 2 - 0.5, (441.6 + 0.5) / 2 - 0.5)
    np.testing.assert_allclose(camera.parameters[:4], wanted, rtol=1e-12)
    assert recorded_camera(calibration_of(colour_px, is_stated=True), **sizes).camera == camera
    of_depth = recorded_camera(calibration_of(depth_px, is_stated=True), **sizes).camera
    assert (of_depth.cx_px, of_depth.cy_px) == (0.53 * 640, 0.46 * 480)
    with pytest.raises(SourceError, match="holds for 320×240 px, but the images have 1280×960"):
        recorded_camera(calibration_of((320, 240), is_stated=True), **sizes)


def test_one_size_is_left_as_it_is():
    sizes = recorded((640, 480), (640, 480))
    image = np.zeros((480, 640), np.uint8)
    assert sizes.image(image, "colour") is image
    assert sizes.depth_m(image, "depth") is image
    assert sizes.camera == calibration_of((640, 480)).camera(width_px=640, height_px=480)
    assert sizes.notes() == []


@pytest.mark.parametrize("depth_px", [(640, 576), (512, 424), (640, 360), (480, 640)])
def test_another_aspect_ratio_is_another_view(depth_px):
    why = rf"log: colour has 640×480 px and depth {depth_px[0]}×{depth_px[1]}, .* another view; export depth"
    with pytest.raises(SourceError, match=why):
        recorded((640, 480), depth_px)


@pytest.mark.parametrize(
    ("sizes_px", "resized"),
    [
        (((1920, 1440), (256, 192)), "colour and depth are resized to 768×576"),
        (((1296, 968), (640, 480)), "colour is resized to 640×480"),
        (((640, 480), (320, 240)), "depth is resized to 640×480"),
    ],
)
def test_what_is_resized_is_noted_and_an_image_unlike_the_first_refused(sizes_px, resized):
    sizes = recorded(*sizes_px)
    of_colour, of_depth = (f"{width}×{height}" for width, height in sizes_px)
    both = f"colour of {of_colour} and depth of {of_depth} px are taken to show the same view"
    assert sizes.notes() == [f"{both}; {resized}"]
    with pytest.raises(FrameError, match=f"depth 7: 64×48 px, but the log has {of_depth}"):
        sizes.depth_m(np.zeros((48, 64), np.float32), "depth 7")


def test_depth_of_a_lens_keeps_its_values_and_colour_is_interpolated():
    lens = Lens("rational_polynomial", (0.52, -2.6, 0.0006, -0.0002, 1.5, 0.4, -2.42, 1.43))
    calibration = Calibration("test", 131.0, 130.0, 79.5, 59.5, lens=lens)
    sizes = recorded_camera(calibration, colour_px=(160, 120), depth_px=(160, 120), where="log")
    halves = (np.arange(160) < 80)[None].repeat(120, axis=0)
    depth_m = sizes.depth_m(np.where(halves, np.float32(1.0), np.float32(3.0)), "depth")
    image = sizes.image(np.where(halves, np.uint8(10), np.uint8(200)), "colour")
    assert set(np.unique(depth_m)) <= {0.0, 1.0, 3.0}
    assert ((image > 10) & (image < 200)).any()
    assert not sizes.shows_recorded_views
    assert recorded((640, 480), (320, 240)).shows_recorded_views


@pytest.mark.parametrize(
    ("colour_px", "frame_px"),
    [
        ((640, 480), (640, 480)),
        ((1280, 720), (640, 360)),
        ((1920, 1080), (640, 360)),
        ((2048, 1536), (1024, 768)),
        ((3840, 2160), (640, 360)),
        ((320, 240), (320, 240)),
        ((720, 1280), (360, 640)),
    ],
)
def test_frames_of_two_cameras_are_colour_s_at_a_whole_fraction_of_its_size(colour_px, frame_px):
    T = exp(np.array([0.004, -0.007, 0.005]), np.array([0.015, 0.0, 0.0]))
    calibration = calibration_of(colour_px)
    own = Calibration("depth", 425.0, 425.0, 423.7, 238.9)
    both = replace(calibration, depth=DepthCamera(own, T, "test"))
    sizes = recorded_camera(both, colour_px=colour_px, depth_px=(848, 480), where="log")
    assert size_of(sizes.camera) == frame_px
    assert sizes.camera == calibration.camera(width_px=colour_px[0], height_px=colour_px[1]).resized(
        *frame_px
    )
    depth_m = sizes.depth_m(np.full((480, 848), 2.0, np.float32), "depth")
    assert depth_m.shape == frame_px[::-1]
    assert np.median(depth_m[depth_m > 0.0]) == pytest.approx(2.0, abs=0.02)
    assert sizes.image(np.zeros(colour_px[::-1], np.uint8), "colour").shape == frame_px[::-1]
    assert sizes.notes() == []


def test_a_depth_camera_may_have_another_lens():
    lens = Lens("rational_polynomial", (0.52, -2.6, 0.0006, -0.0002, 1.5, 0.4, -2.42, 1.43))
    own = Calibration("depth", 252.0, 252.0, 160.2, 119.1, lens=lens)
    calibration = Calibration("colour", 250.0, 250.0, 159.5, 119.5, depth=DepthCamera(own, np.eye(4), "test"))
    sizes = recorded_camera(calibration, colour_px=(320, 240), depth_px=(320, 240), where="log")
    camera = calibration.camera(width_px=320, height_px=240)
    # Depth images of the directions that their pixels look in, registered: those of colour's pixels.
    rays = lens.rays(own.camera(width_px=320, height_px=240))
    for axis in (0, 1):
        shifted = sizes.depth_m(rays[..., axis] + np.float32(2.0), "depth")[20:-20, 20:-20]
        assert np.abs(shifted - 2.0 - ray_table(camera)[20:-20, 20:-20, axis]).max() < 0.6 / 250.0
