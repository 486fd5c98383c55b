"""Azure Kinect's recordings."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import exp
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig
from tests.support.azure_kinect import DATE_S, NFOV, Capture, calibration_json, write_azure_kinect

COLOUR = PinholeCamera(320, 180, 150.0, 151.0, 158.0, 91.0, distortion=(0.05, -0.02, 0.001, -0.002, 0.01))
T_COLOR_DEPTH = exp(np.array([0.1, 0.0, 0.0]), np.array([-0.032, -0.002, 0.004]))

CALIBRATION = calibration_json(COLOUR, NFOV, T_COLOR_DEPTH)


def captures(count=4):
    rows, columns = np.mgrid[:180, :320]
    rgb = np.stack([columns // 2, rows, 200 - rows], axis=2).astype(np.uint8)
    wall = np.full((576, 640), 2000, np.uint16)
    return [Capture(1_000_000 + 33_333 * i, rgb, wall) for i in range(count)]


def samples(count=50):
    return [(1_000_000 + 600 * i, (0.0, 0.0, 9.8), (0.1 * (i % 5), 0.0, 0.2)) for i in range(count)]


def recording(tmp_path, **changes):
    settings = {"colour": COLOUR, "T_color_depth": T_COLOR_DEPTH, **changes}
    return write_azure_kinect(tmp_path / "room.mkv", settings.pop("captures", captures()), **settings)


@pytest.mark.parametrize("codec", [b"MJPG", b"NV12", b"YUY2"])
def test_frames_are_those_that_were_recorded(tmp_path, codec):
    log = open_source(recording(tmp_path, codec=codec))
    assert (log.kind, log.sensor, log.name, len(log)) == ("azure-kinect", "rgbd", "room", 4)
    assert np.array_equal(log.stamps_ns, [DATE_S * 10**9 + 1000 * one.stamp_us for one in captures()])
    frame = log.entry_at(0).load()
    camera = frame.camera
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == pytest.approx((150, 151, 158, 91))
    inner = np.s_[40:140, 80:240]
    assert (
        np.abs(frame.rgb[inner].astype(int) - captures()[0].rgb[inner]).mean() < 6.0
    )  # its lens is taken out
    grey = log.entry_at(0).load(colour=False).image
    assert np.abs(grey.astype(int) - frame.gray)[inner].mean() < 2.0


def test_depth_is_registered_by_the_calibration_of_both_cameras(tmp_path):
    depth_m = open_source(recording(tmp_path)).entry_at(0).load().depth_m
    rows, columns = np.mgrid[60:120, 100:220]
    R, t = T_COLOR_DEPTH[:3, :3], T_COLOR_DEPTH[:3, 3]
    normal, offset_m = R[:, 2], 2.0 + R[:, 2] @ t  # the depth camera sees a wall at z = 2
    x, y = (columns - COLOUR.cx_px) / COLOUR.fx_px, (rows - COLOUR.cy_px) / COLOUR.fy_px
    expected_m = offset_m / (normal[0] * x + normal[1] * y + normal[2])
    assert depth_m[60:120, 100:220] == pytest.approx(expected_m, abs=0.003)


def test_a_user_s_place_of_the_depth_camera_goes_before_the_file_s(tmp_path):
    path, place = recording(tmp_path), (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0)
    config = SourceConfig(camera=CameraConfig(depth_in_color=place))
    depth_m = open_source(path, config).entry_at(0).load().depth_m
    assert depth_m[60:120, 100:220] == pytest.approx(np.full((60, 120), 2.25), abs=1e-3)


def test_samples_of_the_imu_are_read_with_their_own_times_but_for_those_that_are_not_finite(tmp_path):
    log = open_source(recording(tmp_path, samples=samples()))
    at_ns = DATE_S * 10**9 + np.array([1000 * one[0] for one in samples()])
    assert np.array_equal(log.gyroscope.stamps_ns, at_ns + 2000)
    assert np.array_equal(log.accelerations.stamps_ns, at_ns)
    assert log.gyroscope.rates_radps == pytest.approx(np.array([one[2] for one in samples()]), abs=1e-6)
    assert log.accelerations.acceleration_mps2[0] == pytest.approx([0.0, 0.0, 9.8], abs=1e-5)
    damaged = [(at, (np.nan, 0.0, 9.8), radps) for at, _, radps in samples()]
    part = open_source(recording(tmp_path, samples=[*samples(3), *damaged[3:]]))
    assert len(part.accelerations.stamps_ns) == 3
    assert open_source(recording(tmp_path, samples=damaged)).accelerations is None


def test_of_a_recording_that_was_cut_off_the_whole_frames_are_read(tmp_path):
    path = recording(tmp_path)
    path.write_bytes(path.read_bytes()[:-1000])
    log = open_source(path)
    assert len(log) == 3
    assert any("cut off" in note for note in log.notes)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"captures": []}, "COLOR"),
        ({"codec": b"H264"}, "H264"),
        ({"calibration": b"{}"}, "CalibrationInformation"),
        ({"depth": PinholeCamera(600, 576, 504.0, 504.0, 300.0, 300.0)}, "600×576"),
        ({"calibration": CALIBRATION.replace(b"BrownConrady", b"Theta")}, "Theta"),
        ({"calibration": CALIBRATION.replace(b"-0.032", b"Infinity")}, "finite"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(tmp_path, changes, named):
    with pytest.raises(SourceError, match=named):
        open_source(recording(tmp_path, **changes))
