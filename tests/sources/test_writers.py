import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.trajectory import trajectory_from
from mapper.sources import open_source
from mapper.sources.image_files.decoded import encode_depth
from mapper.sources.writers import left_out, write_log
from tests.support.logs import log_in_memory, memory_entry
from tests.support.tum_logs import FIRST_NS, PERIOD_NS, picture

CAMERA = PinholeCamera(64, 48, 60.0, 61.0, 31.5, 23.5, (0.1, -0.2, 0.001, 0.002, 0.05))


def frame_at(stamp_ns, seed):
    rgb, units = picture(seed)
    return RgbdFrame(stamp_ns, rgb, units.astype(np.float32) / np.float32(5000), CAMERA)


def files_under(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_tum_to_mbag_to_tum_keeps_every_byte_there_is_room_for(tiny_tum_log, tmp_path, ending):
    log = tiny_tum_log(4, ending=ending)
    (log / "accelerometer.txt").write_text("# t ax ay az\n1305031102.1 0.1 0.2 9.81\n")
    tum, mbag, again = (tmp_path / name for name in ("tum", "mbag", "again"))
    progress = []
    assert write_log(open_source(log), tum, kind="tum", on_progress=progress.append) == []
    assert progress == [1, 2, 3, 4]
    write_log(open_source(tum), mbag, kind="mbag")
    write_log(open_source(mbag), again, kind="tum")
    before, first, last = files_under(log), files_under(tum), files_under(again)
    images = [name for name in before if name.startswith(("rgb/", "depth/"))]
    assert len(images) == 8
    for name in images:
        assert before[name] == first[name] == last[name]
    for name in ("rgb.txt", "depth.txt", "accelerometer.txt", "calibration.toml"):
        assert first[name] == last[name]
    # Truth moves to the frames' stamps, which is all that mbag can say; positions keep every digit.
    truth, truth_again = open_source(tum).truth, open_source(again).truth
    assert truth_again.stamps_ns.tolist() == [FIRST_NS + i * PERIOD_NS for i in range(4)]
    np.testing.assert_array_equal(truth_again.positions_world, truth.positions_world)
    np.testing.assert_allclose(truth_again.T_world_body, truth.T_world_body, atol=1e-15)


def test_truth_is_written_only_where_it_is_near(tiny_tum_log, tmp_path):
    log = tiny_tum_log(3)
    truth = log / "groundtruth.txt"
    truth.write_text("\n".join(truth.read_text().splitlines()[:-1]))
    write_log(open_source(log), tmp_path / "out", kind="mbag")
    lines = (tmp_path / "out/out.mbag").read_text().splitlines()
    assert lines[-1].endswith("nan; nan; nan; nan; nan; nan; nan")
    assert len(open_source(tmp_path / "out").truth) == 2


def test_frames_without_files_are_encoded_losslessly(tmp_path):
    stamps = [FIRST_NS, FIRST_NS + PERIOD_NS + 1]
    source = log_in_memory([memory_entry(s, frame_at(s, i)) for i, s in enumerate(stamps)])
    write_log(source, tmp_path / "out", kind="tum")
    again = open_source(tmp_path / "out")
    assert again.name == "memory"
    for entry, made in zip(again.entries(), source.entries(), strict=True):
        frame = entry.load()
        assert frame.stamp_ns == made.stamp_ns
        assert frame.camera == CAMERA
        np.testing.assert_array_equal(frame.rgb, made.load().rgb)
        np.testing.assert_array_equal(frame.depth_m, made.load().depth_m)


def test_depth_beyond_16_bits_becomes_no_measurement(tmp_path):
    depth_m = np.full((48, 64), 13.2, np.float32)
    depth_m[0] = 1.0
    frame = RgbdFrame(FIRST_NS, picture(0)[0], depth_m, CAMERA)
    write_log(log_in_memory([memory_entry(FIRST_NS, frame)]), tmp_path / "out", kind="tum")
    again = next(iter(open_source(tmp_path / "out").entries())).load()
    assert (again.depth_m[0] == 1.0).all()
    assert (again.depth_m[1:] == 0.0).all()


def test_a_frame_that_cannot_be_read_is_skipped_and_returned(tmp_path):
    bad = memory_entry(FIRST_NS, FrameError("broken"))
    good = memory_entry(FIRST_NS + 1000, frame_at(FIRST_NS + 1000, 1))
    skipped = write_log(log_in_memory([bad, good]), tmp_path / "out", kind="mbag")
    assert [(s.stamp_ns, s.reason) for s in skipped] == [(FIRST_NS, "broken")]
    assert len(open_source(tmp_path / "out")) == 1


def test_scans_and_empty_logs_are_refused_before_anything_is_written(tmp_path):
    scan = memory_entry(5, Scan(5, np.zeros((1, 3), np.float32)))
    with pytest.raises(SourceError, match="a scan without images; TUM and mbag hold RGB-D frames"):
        write_log(log_in_memory([scan]), tmp_path / "out", kind="tum")
    with pytest.raises(SourceError, match="no frame can be written: it has no frames"):
        write_log(log_in_memory([]), tmp_path / "out", kind="tum")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["tum", "mbag", "mcap", "bag"])
def test_a_log_that_was_interrupted_leaves_nothing_and_one_that_exists_is_not_overwritten(
    tiny_tum_log, tmp_path, kind
):
    def interrupt(done):
        if done == 2:
            raise KeyboardInterrupt

    source, out = (
        open_source(tiny_tum_log(3)),
        tmp_path / "new" / (f"out.{kind}" if kind in ("mcap", "bag") else "out"),
    )
    with pytest.raises(KeyboardInterrupt):
        write_log(source, out, kind=kind, on_progress=interrupt)
    assert list((tmp_path / "new").iterdir()) == []
    if out.suffix == "":
        out.mkdir()
    write_log(source, out, kind=kind)
    assert [path.name for path in (tmp_path / "new").iterdir()] == [out.name]
    with pytest.raises(SourceError, match=f"{out.name}: (exists already|already there)"):
        write_log(source, out, kind=kind)


def test_a_lidars_log_is_refused_before_its_scans_are_read(tmp_path):
    source = log_in_memory([memory_entry(5, FrameError("was read"))], sensor="lidar")
    with pytest.raises(SourceError, match=r"memory: scans without images; .* --as kitti"):
        write_log(source, tmp_path / "out", kind="tum")


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_recordings_leave_out_what_is_before_time_0_and_say_so(kind, tmp_path):
    truth = trajectory_from((stamp_ns, np.eye(4)) for stamp_ns in (-20_000_000, -10_000_000, 0, 40_000_000))
    frames = [memory_entry(stamp_ns, frame_at(stamp_ns, 0)) for stamp_ns in (-5_000_000, 30_000_000)]
    log = log_in_memory(frames, truth=truth)
    assert left_out(log, kind) == [f"{kind} has no place for 2 true poses before the time 0; left out"]
    (skipped,) = write_log(log, tmp_path / f"log.{kind}", kind=kind)
    assert skipped.reason == "stamp -0.005 s: no recording can be before the time 0"
    again = open_source(tmp_path / f"log.{kind}")
    assert [entry.stamp_ns for entry in again.entries()] == [30_000_000]
    assert again.truth.stamps_ns.tolist() == [0, 40_000_000]


@pytest.mark.parametrize("kind", ["tum", "mbag", "mcap", "bag"])
def test_images_of_two_sizes_stay_as_they_are_with_the_camera_of_colour(tiny_tum_log, tmp_path, kind):
    log = tiny_tum_log(2)
    for path in (log / "depth").iterdir():
        path.write_bytes(encode_depth(np.full((24, 32), 1.0 + float(path.stem) % 1.0, np.float32), 5000.0))
    source = open_source(log)
    out = tmp_path / (f"log.{kind}" if kind in ("mcap", "bag") else kind)
    assert write_log(source, out, kind=kind) == []
    again = open_source(out)
    assert (again[0].camera.width_px, again[0].camera.fx_px) == (64, 60.0)
    np.testing.assert_array_equal(again[1].depth_m, source[1].depth_m)
    assert "colour of 64×48 and depth of 32×24 px" in " ".join(again.notes)
    if kind == "tum":
        assert "width_px = 64\n" in (out / "calibration.toml").read_text()
