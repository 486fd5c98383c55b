import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import ray_table
from mapper.sources.calibration import Calibration
from mapper.sources.image_files.image_sizes import recorded_camera

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


@pytest.mark.parametrize(("colour_px", "depth_px", "frame_px"), SIZES)
def test_a_depth_image_gets_no_depth_that_it_does_not_have(colour_px, depth_px, frame_px):
    width_px, height_px = depth_px
    depth_m = np.random.default_rng(0).uniform(0.5, 5.0, (height_px, width_px)).astype(np.float32)
    resized = recorded(colour_px, depth_px).depth_m(depth_m, "depth")
    assert resized.shape == frame_px[::-1]
    assert np.isin(resized, depth_m).all()


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


def test_what_is_resized_is_noted():
    (note,) = recorded((1920, 1440), (256, 192)).notes()
    assert note == (
        "colour of 1920×1440 and depth of 256×192 px are taken to show the same view; "
        "colour and depth are resized to 768×576"
    )
    assert recorded((1296, 968), (640, 480)).notes()[0].endswith("; colour is resized to 640×480")
    assert recorded((640, 480), (320, 240)).notes()[0].endswith("; depth is resized to 640×480")


def test_an_image_unlike_the_first_is_refused():
    sizes = recorded((640, 480), (320, 240))
    with pytest.raises(FrameError, match="depth 7: 640×480 px, but the log has 320×240"):
        sizes.depth_m(np.zeros((480, 640), np.float32), "depth 7")
