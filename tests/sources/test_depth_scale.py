"""Depth in the wrong units is noticed, and the setting named, before and after a build."""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapper.api.logs import inspect as mapper_inspect
from mapper.config.loading import load_config
from mapper.core.errors import DataError
from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.core.timebase import NS_PER_S
from mapper.pipeline.build import build
from mapper.pipeline.track import noted_log_warnings
from mapper.run.folder import open_run
from mapper.runtime.progress import SILENT
from mapper.simulation import CameraSimulator
from mapper.simulation.config import SynthConfig, SynthWheelsConfig
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.config import CameraConfig, SourceConfig
from mapper.sources.depth_scale import depth_warnings, read_spread, why_no_depth
from tests.support.command_line import mapper
from tests.support.desk_frames import blank
from tests.support.logs import changed_frames, log_in_memory, memory_entry
from tests.support.tum_logs import copy_numbered

CAMERA = PinholeCamera(40, 30, 30.0, 30.0, 19.5, 14.5)


def warnings_of(log):
    return depth_warnings(log, read_spread(log))


def desk(log, factor):
    return open_source(log, SourceConfig(camera=CameraConfig(depth_factor=factor)))


@pytest.mark.parametrize("factor", [4300, 5000, 5700])
def test_depth_that_fits_the_truth_is_silent(desk_log, factor):
    assert warnings_of(desk(desk_log, factor)) == []


@pytest.mark.parametrize(
    ("factor", "wrong"),
    [
        (1000, "5 times too large"),
        (3500, "1.4 times too large"),
        (25000, "5 times too small"),
        (7000, "1.4 times too small"),
    ],
)
def test_a_wrong_factor_is_found_by_the_truth_and_the_right_one_is_named(desk_log, factor, wrong):
    assert warnings_of(desk(desk_log, factor)) == [
        f"depth: {wrong} for the true motion of the camera; "
        f"source.camera.depth_factor=5000 fits, not {factor}"
    ]


@pytest.mark.parametrize("units_per_m", [100.0, 1000.0])
def test_motion_in_other_units_is_named_where_depth_is_that_of_cameras(desk_log, units_per_m):
    log = open_source(desk_log)
    T = log.truth.T_world_body.copy()
    T[:, :3, 3] *= units_per_m
    (warning,) = warnings_of(replace(log, truth=replace(log.truth, T_world_body=T)))
    assert "depth_factor" not in warning
    assert float(re.search(r"([\d.e+-]+) times", warning)[1]) == pytest.approx(units_per_m, rel=0.1)


@pytest.mark.parametrize("factor", [1, 20, 400_000, 5_000_000])
def test_depth_that_no_camera_measures_is_refused_before_tracking(desk_log, tmp_path, factor):
    config = load_config({"source.camera.depth_factor": factor})
    with pytest.raises(DataError, match=re.escape(f"depth_factor={factor:g}")):
        build(open_source(desk_log, config.source), config, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []
    assert f"depth_factor={factor:g}" in mapper_inspect(desk_log, settings=config.model_dump()).problem


def in_other_units(source, scale):
    """The same log, but for depth that is wrong by a factor."""

    wrong = changed_frames(source, lambda _, frame: replace(frame, depth_m=frame.depth_m * np.float32(scale)))
    return replace(wrong, truth=None)


def test_wheels_are_enough():
    config = SynthConfig(
        duration_s=6.0, frame_rate_hz=10.0, width_px=320, height_px=240, texture_px_per_m=64,
        posters_per_room=3, furniture_per_room=4, wheels=SynthWheelsConfig(),
    )  # fmt: skip
    log = CameraSimulator(config).log()
    assert warnings_of(in_other_units(log, 1.0)) == []
    (warning,) = warnings_of(in_other_units(log, 0.2))
    too_small = "depth: 5 times too small for the wheels' motion of the camera"
    assert warning == f"{too_small}; source.camera.depth_factor is wrong"


def plain(depths_m, *, image=None):
    """A log of images without texture, each of one depth."""
    image = np.zeros((30, 40), np.uint8) if image is None else image
    return log_in_memory([
        memory_entry(i * NS_PER_S, RgbdFrame(i * NS_PER_S, image, np.full((30, 40), m, np.float32), CAMERA))
        for i, m in enumerate(depths_m)
    ])  # fmt: skip


@pytest.mark.parametrize(
    ("depths_m", "warning"),
    [
        ([0.2, 2.0, 7.9], None),
        ([0.0, 2.0, 2.0], None),
        ([0.6, 0.6], None),
        ([7.0, 12.0, 13.0], "depth: a tenth of it is beyond 12 m, but cameras measure 0.1 to 8 m"),
        ([0.25, 0.25], "depth: nine tenths of it is within 0.25 m, but cameras measure 0.3 to 8 m"),
        ([0.002, 0.002], "depth: half of it is within 0.002 m, but cameras measure 0.1 to 8 m"),
        ([0.0, 0.0, 2.0], "depth: 100.0% of the pixels measured nothing: 0, or the limit of 16 bits"),
    ],
)
def test_depth_without_any_motion_is_held_against_what_cameras_deliver(depths_m, warning):
    found = warnings_of(plain(depths_m))
    assert len(found) == (warning is not None)
    assert warning is None or found[0].startswith(warning)


@pytest.mark.parametrize(("after", "is_change"), [(0.2, True), (5.0, True), (0.6, False)])
def test_a_change_of_units_in_the_middle_is_found(after, is_change):
    depths_m = [1.5 + 0.01 * i for i in range(40)]
    depths_m[23:] = [depth_m * after for depth_m in depths_m[23:]]
    found = warnings_of(plain(depths_m))
    assert len(found) == is_change
    assert not is_change or "from frame 23 on" in found[0]


def test_a_change_of_units_in_the_last_quarter_of_varied_depth_is_found():
    depths_m = np.linspace(1.9, 3.8, 40)
    depths_m[30:] *= 0.2
    assert "from frame 30 on" in warnings_of(plain(depths_m))[0]


def test_a_walk_from_near_to_far_is_no_change_of_units():
    assert warnings_of(plain(np.linspace(0.6, 5.0, 60))) == []


@pytest.mark.parametrize(
    ("factor", "fitting"), [(25_000, "5000 reads it 5 times farther"), (1000, "5000 reads it 5 times nearer")]
)
def test_units_that_fit_are_named(desk_log, factor, fitting):
    for is_assumed in (True, False):
        log = replace(desk(desk_log, factor), truth=None, are_units_assumed=is_assumed)
        assert warnings_of(log)[0].endswith(fitting)


@pytest.mark.parametrize("scale_m", [None, 2.0, 200.0])
def test_disparity_in_place_of_depth_is_told(desk_log, scale_m):
    """In metres that cameras measure it is a doubt; else it is refused, as other depth out of reach."""
    log = desk(desk_log, 5000)
    frames = read_spread(log)
    if scale_m is not None:
        frames = {
            index: replace(frame, depth_m=np.where(d := frame.depth_m, scale_m / np.maximum(d, 1e-3), d))
            for index, frame in frames.items()
        }
    told = [*depth_warnings(replace(log, truth=None), frames), why_no_depth(log, frames) or ""]
    assert any("disparity" in text for text in told) == (scale_m is not None)
    assert ("disparity" in told[-1]) == (scale_m == 200.0)


def test_motion_that_no_scale_fits_says_nothing_of_depth(desk_log):
    """The truth of another log, say: this is not a matter of units."""
    source = desk(desk_log, 5000)
    truth = source.truth
    random = np.random.default_rng(3).permutation(len(truth))
    T_world_body = truth.T_world_body[random]
    shuffled = Log(
        path=source.path, name="shuffled", kind="tum", sensor="rgbd", stamps_ns=source.stamps_ns,
        entry_at=source.entry_at, truth=type(truth)(truth.stamps_ns, T_world_body),
    )  # fmt: skip
    assert warnings_of(shuffled) == []


def test_frames_that_cannot_be_read_and_scans_are_left_alone():
    assert warnings_of(log_in_memory([memory_entry(0, OSError())], sensor="lidar")) == []


def test_black_images_show_no_scale(desk_log):
    """A covered lens; OpenCV refuses to match nothing."""
    source = desk(desk_log, 5000)

    covered = changed_frames(source, lambda i, frame: frame if i < len(source) // 2 else blank(frame))
    assert warnings_of(covered) == []


def millimetres_for_redwood(desk_log, folder):
    """The desk as a Redwood log, whose depth is taken to be in millimetres, but is in units of 0.2 mm."""
    calibration = copy_numbered(desk_log, folder) / "calibration.toml"
    lines = calibration.read_text().splitlines()
    calibration.write_text("\n".join(line for line in lines if "depth_factor" not in line))
    return folder


def test_inspect_and_build_tell_and_the_setting_alone_mends_it(desk_log, desk_run, tmp_path):
    log = millimetres_for_redwood(desk_log, tmp_path / "log")
    text = mapper("inspect", log).stdout
    assert "source.camera.depth_factor=1000 right?" in " ".join(
        line for line in text.splitlines() if line.startswith("warning")
    )
    facts = json.loads(mapper("inspect", log, "--json").stdout)
    assert len(facts["log"]["warnings"]) == 1

    coarse = ("--set", "octree.resolution_m=0.2", "--set", "odometry.max_depth_m=30")
    out = tmp_path / "run"
    result = mapper("build", log, "--out", out, "--last", 14, *coarse, "--set", "slice.max_height_m=9")
    assert "depth: a tenth of it is beyond" in result.stderr
    notes, known = (run.manifest.input.notes for run in (open_run(out), desk_run))
    assert any(note.startswith("depth: a tenth of it is beyond") for note in notes)
    is_high = [any("m above the floor; is source.camera" in note for note in all_) for all_ in (notes, known)]
    assert is_high == [True, False]

    mended = mapper("inspect", log, "--set", "source.camera.depth_factor=5000").stdout
    assert "warning" not in mended


@pytest.mark.parametrize("units_per_m", [1000.0, 5000.0])
def test_depth_with_its_bytes_swapped_is_refused_by_that_cause(desk_log, tmp_path, units_per_m):
    folder = shutil.copytree(desk_log, tmp_path / "log")
    for path in (folder / "depth").iterdir():
        path.chmod(0o644)
        cv2.imwrite(f"{path}", cv2.imread(f"{path}", cv2.IMREAD_UNCHANGED).byteswap())
    for log, is_refused in ((desk(folder, units_per_m), True), (desk(desk_log, units_per_m), False)):
        assert ("byteswap" in (why_no_depth(log, read_spread(log)) or "")) == is_refused


@pytest.mark.parametrize("far_m", [1.2, 4.0, 10.0])
def test_pixels_filled_with_the_farthest_depth_are_told(desk_log, far_m):
    log = open_source(desk_log)
    frames = read_spread(log)
    cut = {k: replace(one, depth_m=np.minimum(one.depth_m, np.float32(far_m))) for k, one in frames.items()}
    filled = {k: replace(one, depth_m=one.depth_m.copy()) for k, one in cut.items()}
    for one in filled.values():
        one.depth_m[:24] = far_m
    (warning,) = depth_warnings(log, filled)
    assert f"max_range_m={0.999 * far_m:.4g} " in warning
    assert len(depth_warnings(log, cut)) == (far_m < max(one.depth_m.max() for one in frames.values()))
    assert depth_warnings(log, dict.fromkeys(frames, frames[0])) == []


def test_all_checks_of_depth_read_the_same_eight_frames_once(desk_log):
    source, loaded = open_source(desk_log)[:20], []

    def entry_at(index):
        loaded.append(index)
        return source.entry_at(index)

    assert noted_log_warnings(replace(source, entry_at=entry_at, truth=None), SILENT) == []
    assert loaded == [0, *loaded[1:7], 19, 0, 0]  # the first is asked for its units
