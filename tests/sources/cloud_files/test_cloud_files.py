import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from mapper.core.errors import FrameError
from mapper.sources.cloud_files import ENDINGS, read_cloud
from mapper.sources.cloud_files.ply import read_ply
from mapper.sources.scan_folders.scans import read_scan

N = 60
RNG = np.random.default_rng(3)
POINTS = RNG.normal(0.0, 10.0, (N, 3)).astype(np.float32)
TIMES = 1_500_000 * np.arange(N, dtype=np.uint32)
COLORS = RNG.integers(0, 256, (N, 3), dtype=np.uint8)
RECORDS = np.zeros(
    N, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4"), *((c, "u1") for c in ("red", "green", "blue"))]
)
for column, values in zip(RECORDS.dtype.names, [*POINTS.T, TIMES, *COLORS.T], strict=True):
    RECORDS[column] = values
TRIANGLE = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "O")])
CAMERA = np.array([(1.0, 7)], dtype=[("focal", "f8"), ("id", "i2")])


def write_bin(path):
    np.column_stack([POINTS, np.ones(N)]).astype(np.float32).tofile(path)


def write_npy(path):
    np.save(path, POINTS)


def write_text(path):
    np.savetxt(path, np.column_stack([POINTS, np.ones(N)]), delimiter="," if path.suffix == ".csv" else " ")


def write_pcd(path, *, encoding=Encoding.BINARY_COMPRESSED):
    columns = [*POINTS.T, PointCloud.encode_rgb(COLORS), TIMES]
    types = (np.float32,) * 4 + (np.uint32,)
    PointCloud.from_points(columns, ("x", "y", "z", "rgb", "t"), types).save(path, encoding)


def write_ply(path, *, text=False, byte_order="<", before=False):
    elements = [PlyElement.describe(RECORDS, "vertex"), PlyElement.describe(TRIANGLE, "face")]
    elements[: int(before)] = [PlyElement.describe(CAMERA, "camera"), elements[0]][: 2 * int(before)]
    PlyData(elements, text=text, byte_order=byte_order, comments=["made by a test"]).write(path)


def write_las(path, *, offset=(0.0, 0.0, 0.0)):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [1e-4] * 3, offset
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (POINTS + np.array(offset)).T
    cloud.gps_time = 345_678.0 + TIMES / 1e9
    cloud.red, cloud.green, cloud.blue = 257 * COLORS.T.astype(np.uint16)
    cloud.write(path)


TEXTS = (".xyz", ".xyzi", ".xyzrgb", ".asc", ".pts", ".txt", ".csv")
WRITERS = {
    ".bin": write_bin,
    ".pcd": write_pcd,
    ".ply": write_ply,
    **dict.fromkeys(TEXTS, write_text),
    ".npy": write_npy,
    ".las": write_las,
    ".laz": write_las,
}


def refusal_of(path, **options):
    with pytest.raises(FrameError) as refusal:
        read_cloud(path, **options)
    message = str(refusal.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def cloud_or_refusal(path):
    try:
        return read_cloud(path)
    except FrameError as error:
        return str(error)


@pytest.mark.parametrize(
    ("write", "options", "first_s"),
    [
        *(
            (write_pcd, {"encoding": encoding}, 0.0)
            for encoding in (Encoding.BINARY, Encoding.BINARY_COMPRESSED)
        ),
        *(
            (write_ply, {"text": text, "byte_order": byte_order, "before": before}, 0.0)
            for text, byte_order in ((True, "="), (False, "<"), (False, ">"))
            for before in (False, True)
        ),
        (write_las, {}, 345_678.0),
    ],
)
def test_times_and_colours_are_kept(tmp_path, write, options, first_s):
    path = tmp_path / {write_pcd: "cloud.pcd", write_ply: "cloud.ply", write_las: "cloud.laz"}[write]
    write(path, **options)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-4 if write is write_las else 1e-5)
    np.testing.assert_allclose(cloud.times, first_s + TIMES * (1e-9 if first_s else 1))
    np.testing.assert_array_equal(cloud.colors, COLORS)
    assert cloud.times.dtype.isnative


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_format_gives_its_points(tmp_path, ending):
    path = tmp_path / f"cloud{ending.upper()}"
    WRITERS[ending](tmp_path / f"cloud{ending}")
    (tmp_path / f"cloud{ending}").rename(path)
    cloud = read_cloud(path)
    assert cloud.points.dtype == np.float32
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-4)


def test_an_array_of_a_row_for_each_coordinate_is_read(tmp_path):
    np.save(tmp_path / "cloud.npy", POINTS.T)
    np.testing.assert_allclose(read_cloud(tmp_path / "cloud.npy").points, POINTS, atol=1e-5)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_cut_anywhere_is_refused_in_one_line_or_gives_whole_points(tmp_path, ending):
    path = tmp_path / f"cloud{ending}"
    WRITERS[ending](path)
    whole = path.read_bytes()
    for size in np.linspace(0, len(whole) - 1, 40).astype(int):
        path.write_bytes(whole[:size])
        result = cloud_or_refusal(path)
        if isinstance(result, str):
            assert result.startswith(f"{path}: ")
            assert "\n" not in result
        else:
            # A cut ply may lack faces only; formats without a count cannot tell, but for half a number.
            assert ending in (".ply", ".bin", *TEXTS)
            np.testing.assert_allclose(result.points[:-1], POINTS[: len(result.points) - 1], atol=1e-4)


@pytest.mark.parametrize("ending", ENDINGS)
def test_noise_is_refused_in_one_line(tmp_path, ending):
    path = tmp_path / f"cloud{ending}"
    for size in (0, 1, 15, 1000):
        path.write_bytes(np.random.default_rng(size).bytes(size))
        refusal_of(path)


@pytest.mark.parametrize("ending", [".pcd", ".ply", ".npy", ".las", ".laz"])
def test_damaged_bytes_never_raise_anything_else(tmp_path, ending):
    path = tmp_path / f"cloud{ending}"
    WRITERS[ending](path)
    whole = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    rng = np.random.default_rng(11)
    for _ in range(60):
        damaged = whole.copy()
        head = rng.integers(0, min(len(whole), 400), size=3)
        damaged[head] = rng.integers(0, 256, size=3)
        path.write_bytes(damaged.tobytes())
        result = cloud_or_refusal(path)
        assert not isinstance(result, str) or "\n" not in result


def test_what_is_no_cloud_says_so(tmp_path):
    assert refusal_of(tmp_path / "cloud.obj").startswith("not the ending of a cloud; want one of .bin .pcd")
    assert refusal_of(tmp_path / "cloud.bin") == "cannot be read: No such file or directory"
    (tmp_path / "folder.bin").mkdir()
    assert refusal_of(tmp_path / "folder.bin") == "cannot be read: Is a directory"


def test_a_bin_of_other_records_names_its_bytes(tmp_path):
    path = tmp_path / "cloud.bin"
    path.write_bytes(b"\0" * 100)
    assert refusal_of(path).startswith("100 bytes, want a multiple of 16, KITTI's float32 x y z intensity; ")


@pytest.mark.parametrize(("blank", "ending"), [(" ", "\n"), ("  ", "\r\n"), ("\t", "\n\n"), (" ", " \n")])
def test_ascii_pcd(tmp_path, blank, ending):
    """Open3D ends every line in a blank."""
    path = tmp_path / "cloud.pcd"
    write_pcd(path, encoding=Encoding.ASCII)
    header, data = path.read_text().split("DATA ascii\n")
    lines = [blank.join(line.split()) + ending for line in data.splitlines()]
    path.write_text(f"{header}DATA ascii\n" + "".join(lines))
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.times, TIMES)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("POINTS 60", "POINTS 99", "60 points, but the header says 99; was the file cut?"),
        ("POINTS 60", "POINTS 9", "60 points, but the header says 9; was the file cut?"),
        ("COUNT 1 1 1 1 1\n", "", "not a sound PCD file: its header is not whole (count"),
        ("TYPE F", "TYPE Q", "not a sound PCD file: "),
        ("SIZE 4", "SIZE 3", "not a sound PCD file: "),
        ("FIELDS x y z", "FIELDS a b c", "fields a b c rgb t; want x y z among them"),
    ],
)
def test_a_pcd_header_that_is_wrong_is_refused(tmp_path, old, new, says):
    path = tmp_path / "cloud.pcd"
    write_pcd(path, encoding=Encoding.ASCII)
    path.write_text(path.read_text().replace(old, new))
    assert refusal_of(path).startswith(says)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (True, "the dtype passed requires 7 columns but 4 were found at row 61"),
        (False, "60 vertices, but the header says 9999999999999; was the file cut?"),
    ],
)
def test_a_ply_header_that_counts_wrongly_is_refused(tmp_path, text, says):
    path = tmp_path / "cloud.ply"
    write_ply(path, text=text)
    path.write_bytes(path.read_bytes().replace(b"vertex 60", b"vertex 9999999999999"))
    assert refusal_of(path).startswith(f"not a sound PLY file: {says}")


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kinds=st.lists(st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]), min_size=1, max_size=6),
    count=st.integers(0, 5),
    text=st.booleans(),
    byte_order=st.sampled_from("<>"),
    seed=st.integers(0, 99),
)
def test_ply_vertices_are_what_plyfile_wrote(tmp_path, kinds, count, text, byte_order, seed):
    rng = np.random.default_rng(seed)
    vertices = np.zeros(count, [(f"property{i}", kind) for i, kind in enumerate(kinds)])
    for i, kind in enumerate(kinds):
        limits = np.iinfo(kind) if kind[0] in "iu" else np.finfo("f4")
        vertices[f"property{i}"] = rng.uniform(limits.min / 2, limits.max / 2, count).astype(kind)
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(TRIANGLE, "face")]
    PlyData(elements, text=text, byte_order=byte_order).write(tmp_path / "cloud.ply")
    columns = read_ply(tmp_path / "cloud.ply")
    assert list(columns) == list(vertices.dtype.names)
    for name, values in columns.items():
        assert values.dtype == vertices[name].dtype
        # plyfile writes 18 digits of a number, which is more than a float64 has.
        np.testing.assert_array_equal(values, vertices[name])


def test_ply_vertices_behind_lists_are_refused(tmp_path):
    path = tmp_path / "cloud.ply"
    PlyData([PlyElement.describe(TRIANGLE, "face"), PlyElement.describe(RECORDS, "vertex")]).write(path)
    assert "element face has lists" in refusal_of(path)


@pytest.mark.parametrize("array", [POINTS.astype(np.float64), POINTS.reshape(6, 10, 3), RECORDS], ids=repr)
def test_npy_of_any_shape(tmp_path, array):
    path = tmp_path / "cloud.npy"
    np.save(path, array)
    np.testing.assert_array_equal(read_cloud(path).points, POINTS)


@pytest.mark.parametrize(
    ("array", "why"),
    [
        *(
            (array, "want numbers, (N, 3) or wider")
            for array in (np.zeros(30), np.zeros((30, 2)), np.full((30, 3), "x"))
        ),
        (np.array([None]), "objects of Python"),
        (np.full((N, 3), np.nan), "0 of 60 points measured anything; want 10 or more"),
        (np.zeros((N, 3)), "0 of 60 points measured anything"),
        (np.eye(3)[:1], "1 of 1 points measured anything"),
        (np.eye(3)[:0], "0 of 0 points measured anything"),
    ],
    ids=repr,
)
def test_npy_of_something_else_or_of_too_few_points(tmp_path, array, why):
    np.save(tmp_path / "cloud.npy", array)
    assert why in refusal_of(tmp_path / "cloud.npy")


@pytest.mark.parametrize(
    "lines",
    [
        pytest.param("{x:.9g} {y:.9g}  {z:.9g}", id="blanks"),
        pytest.param("{x:.9g}\t{y:.9g}\t{z:.9g}\t7\t8\t9\r", id="tabs, CRLF and more columns"),
        pytest.param("60\n{x:.9g} {y:.9g} {z:.9g}", id="a count"),
        pytest.param("\ufeffx;y;z\n{x:.9g};{y:.9g};{z:.9g}", id="semicolons, a header and a byte order mark"),
        pytest.param("# made by a test\n{x:.9g},{y:.9g},{z:.9g},1", id="a comment of as many words"),
        pytest.param("//X Y Z\n{x:.9g} {y:.9g} {z:.9g}", id="CloudCompare"),
        pytest.param('"t","Z","Y","X"\n0.1,{z:.9g},{y:.9g},{x:.9g}', id="columns by name"),
        pytest.param("{x:.9g};{y:.9g};{z:.9g}#", id="decimal commas"),
        pytest.param("x;y;z\n{x:.9g};{y:.9g};{z:.9g}#", id="decimal commas below a header"),
    ],
)
def test_text_with_and_without_header(tmp_path, lines):
    path = tmp_path / "cloud.csv"
    *header, line = lines.removesuffix("#").split("\n")
    rows = [line.format(x=x, y=y, z=z) for x, y, z in POINTS]
    text = "\n".join([*header, *rows, ""])
    path.write_text(text.replace(".", ",") if lines.endswith("#") else text)
    np.testing.assert_array_equal(read_cloud(path).points, POINTS)


def test_text_that_is_no_cloud(tmp_path):
    path = tmp_path / "cloud.txt"
    path.write_text("azimuth,elevation,range\n" + "1,2,3\n" * 20)
    assert refusal_of(path) == "fields azimuth elevation range; want x y z among them"
    path.write_text("1 2 3\n" * 20 + "4 5\n")
    assert "number of columns changed from 3 to 2 at row 21" in refusal_of(path)
    path.write_text("once upon a time\n" * 20)
    assert refusal_of(path) == "none of the first 1000 lines is three or more numbers: x y z"


def test_missing_returns_are_dropped_with_their_times_and_colours(tmp_path):
    records = RECORDS.copy()
    records["x"][3], records["y"][4], records["z"][5] = np.nan, np.inf, -np.inf
    for name in "xyz":
        records[name][10:20] = 0.0
    records["x"][20] = records["y"][20] = 0.0  # straight above
    kept = np.setdiff1d(np.arange(N), [3, 4, 5, *range(10, 20)])
    np.save(tmp_path / "cloud.npy", records)
    cloud = read_cloud(tmp_path / "cloud.npy")
    np.testing.assert_array_equal(cloud.points[:, 2], records["z"][kept])
    np.testing.assert_array_equal(cloud.times, TIMES[kept])
    np.testing.assert_array_equal(cloud.colors, COLORS[kept])


def test_millimetres_are_refused_until_their_scale_is_told(tmp_path):
    path = tmp_path / "cloud.npy"
    np.save(path, np.round(1000.0 * POINTS).astype(np.int32))
    message = refusal_of(path)
    assert "looks like millimetres; --set source.cloud_scale=0.001, or 1 if these are metres" in message
    np.testing.assert_allclose(read_cloud(path, scale=0.001).points, POINTS, atol=1e-3)
    assert len(read_cloud(path, scale=1.0).points) == N


@pytest.mark.parametrize("scale", [None, 1.0])
def test_points_on_the_globe_are_refused(tmp_path, scale):
    path = tmp_path / "cloud.las"
    write_las(path, offset=(432_100.0, 4_567_800.0, 120.0))
    message = refusal_of(path, scale=scale)
    assert "away from the origin; want them around the sensor" in message


@pytest.mark.parametrize(
    ("colours", "kind"),
    [
        (COLORS, "u1"),
        (257 * COLORS.astype(np.uint16), "u2"),
        (COLORS.astype(np.uint16), "u2"),
        (COLORS / 255.0, "f8"),
    ],
    ids=["8 bits", "16 bits", "8 in 16 bits", "0 to 1"],
)
def test_colours_of_every_depth(tmp_path, colours, kind):
    records = np.zeros(N, [*((c, "f4") for c in "xyz"), *((c, kind) for c in ("red", "green", "blue"))])
    for name, values in zip(records.dtype.names, [*POINTS.T, *colours.T], strict=True):
        records[name] = values
    np.save(tmp_path / "cloud.npy", records)
    np.testing.assert_allclose(read_cloud(tmp_path / "cloud.npy").colors.astype(int), COLORS, atol=1)


def test_a_single_cloud_is_a_scan_at_time_zero(tmp_path):
    write_ply(tmp_path / "cloud.ply")
    scan = read_scan(tmp_path / "cloud.ply")
    assert scan.stamp_ns == 0
    np.testing.assert_array_equal(scan.points_body, POINTS)
    np.testing.assert_allclose(scan.times_s, TIMES / 1e9, rtol=1e-6)


@pytest.mark.parametrize("ending", [".bin", ".pcd", ".las", ".ply"])
def test_intensities_are_read(tmp_path, ending):
    intensities = RNG.integers(1, 200, N).astype(np.float32)
    path = tmp_path / f"cloud{ending}"
    if ending == ".bin":
        np.column_stack([POINTS, intensities]).astype(np.float32).tofile(path)
    elif ending == ".pcd":
        names, kinds = ("x", "y", "z", "reflectivity"), (np.float32,) * 3 + (np.uint16,)
        PointCloud.from_points([*POINTS.T, intensities.astype(np.uint16)], names, kinds).save(path)
    elif ending == ".ply":
        fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("scalar_Intensity", "f4")]
        rows = np.array([(*point, value) for point, value in zip(POINTS, intensities, strict=True)], fields)
        PlyData([PlyElement.describe(rows, "vertex")]).write(path)
    else:
        written = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
        written.header.scales = [1e-4] * 3
        written.x, written.y, written.z = POINTS.T
        written.intensity = intensities.astype(np.uint16)
        written.write(path)
    np.testing.assert_array_equal(read_cloud(path).intensities, intensities)


def test_intensities_that_say_nothing_are_none(tmp_path):
    path = tmp_path / "cloud.bin"
    np.column_stack([POINTS, np.zeros(N)]).astype(np.float32).tofile(path)
    assert read_cloud(path).intensities is None
    values = np.ones(N, np.float32)
    values[3] = np.nan
    np.column_stack([POINTS, values]).astype(np.float32).tofile(path)
    assert read_cloud(path).intensities.tolist() == [1.0] * 3 + [0.0] + [1.0] * (N - 4)
