import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.rotations import rotation_from_euler
from mapper.sources import open_source
from tests.support.tum_logs import CALIBRATION, write_picture

ROWS = [
    (0, 0.0, 0.1, 0.2, 0.0, 0.0, 0.5),
    (1, 0.1, 0.1, 0.2, 0.1, -0.2, 1.0),
    (2, 0.2, 0.1, 0.2, 0.0, 0.3, 3.0),
]


def make(
    folder,
    rows=ROWS,
    *,
    header="",
    colour="rgb/rgb_{}.png",
    depth="depth/depth_{}.png",
    name="groundtruth.txt",
):
    for i in range(3):
        write_picture(folder / colour.format(i), folder / depth.format(i), i)
    text = header + "".join(" ".join(map(str, row)) + "\n" for row in rows)
    (folder / name).write_text(text)
    (folder / "calibration.toml").write_text(CALIBRATION)
    return folder


@pytest.mark.parametrize(
    "layout",
    [
        {},
        {"colour": "rgb_0000{}.png", "depth": "depth_0000{}.png"},
        {"colour": "rgb/{}.png", "depth": "depth/{}.png", "name": "trajectory1_gt.txt"},
    ],
)
def test_reads_numbered_images_and_euler_truth(tmp_path, layout):
    source = open_source(make(tmp_path, **layout))
    assert (source.kind, len(source)) == ("poznan", 3)
    assert [entry.stamp_ns for entry in source.entries()] == [0, 100_000_000, 200_000_000]
    assert source.truth.stamps_ns.tolist() == [0, 100_000_000, 200_000_000]
    for row, T in zip(ROWS, source.truth.T_world_body, strict=True):
        np.testing.assert_array_equal(T[:3, 3], row[1:4])
        np.testing.assert_allclose(T[:3, :3], rotation_from_euler(*row[4:]), atol=1e-15)
    assert any("angles taken as radians" in note for note in source.notes)


@pytest.mark.parametrize(
    ("header", "yaw", "want_rad"),
    [
        ("", 90.0, np.pi / 2),
        ("# angles [deg]\n", 3.0, np.deg2rad(3.0)),
        ("# roll pitch yaw in radians\n", 7.0, 7.0),
        ("", 6.0, 6.0),
    ],
)
def test_degrees_or_radians_by_the_documented_rule(tmp_path, header, yaw, want_rad):
    source = open_source(make(tmp_path, [(0, 0, 0, 0, 0, 0, yaw)], header=header))
    want = rotation_from_euler(0.0, 0.0, want_rad)
    np.testing.assert_allclose(source.truth.T_world_body[0, :3, :3], want, atol=1e-12)


@pytest.mark.parametrize(
    "row", [(1, "nan", 0, 0, 0, 0, 0), (1, 0, 0, 0, "inf", 0, 0), (1, 0, "-1e308", 0, 0, 0, 0)]
)
def test_truth_of_some_images_only_and_not_finite(tmp_path, row):
    rows = [ROWS[0], row]
    source = open_source(make(tmp_path, rows))
    assert source.truth.stamps_ns.tolist() == [0]
    assert len(source) == 3
    assert "groundtruth.txt: 1 of 2 poses are not finite rigid motions; dropped" in source.notes


@pytest.mark.parametrize(
    ("row", "why"),
    [
        *(((number, *ROWS[1][1:]), "'.*is no number of a frame$") for number in ("²", 5000 * "1", "-1", "x")),
        ((1, 2, 3), "'1 2 3', want: number x y z roll pitch yaw"),
    ],
)
def test_a_bad_line_is_named(tmp_path, row, why):
    with pytest.raises(SourceError, match=rf"groundtruth\.txt:2: {why}") as caught:
        open_source(make(tmp_path, [ROWS[0], row]))
    assert len(str(caught.value)) < 1000


def test_the_camera_must_be_told(tmp_path):
    folder = make(tmp_path)
    (folder / "calibration.toml").unlink()
    with pytest.raises(SourceError, match=r"intrinsics unknown; put a calibration\.toml"):
        open_source(folder)
