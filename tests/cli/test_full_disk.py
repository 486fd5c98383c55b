import re
import shutil

import pytest

from tests.support.command_line import mapper
from tests.support.files import digest_of
from tests.support.full_disk import largest_file

WRITERS = {
    "fuse": ["fuse", "RUN", "--quiet"],
    "export costmap": ["export", "RUN", "--as", "costmap"],
    "export kitti": ["export", "RUN", "--as", "kitti"],
    "export voxels": ["export", "RUN", "--as", "voxels", "--out", "OUT/v.ply"],
    "export voxel-mesh": ["export", "RUN", "--as", "voxel-mesh", "--out", "OUT/v.glb"],
    "export native": ["export", "RUN", "--as", "native", "--out", "OUT/m.octree"],
    "export grid": ["export", "RUN", "--as", "grid", "--out", "OUT/s.yaml"],
    "plan": ["plan", "RUN", "--from", "0", "0", "--to", "0.1", "0", "--radius", "0.01", "--unknown", "free"],
    "view": ["view", "RUN", "--rrd", "OUT/run.rrd"],
    "report": ["report", "RUN", "--out", "OUT/page.html"],
    "eval": ["eval", "RUN", "--plot", "OUT/plots"],
    "solve": ["solve", "RUN/graph.g2o", "--out", "OUT/solved", "--quiet"],
    "merge": ["merge", "RUN", "--out", "OUT/map"],
    "convert to tum": ["convert", "LOG", "--out", "OUT/log", "--as", "tum"],
    "convert to mcap": ["convert", "LOG", "--out", "OUT/log.mcap", "--as", "mcap"],
    "convert to bag": ["convert", "LOG", "--out", "OUT/log.bag", "--as", "bag"],
    "synth": ["synth", "OUT/log", "--seconds", "0.2", "--set", "texture_px_per_m=8", "--quiet"],
    "synth lidar": ["synth", "OUT/log", "--sensor", "lidar", "--scene", "street", "--seconds", "0.2"],
}


@pytest.mark.parametrize("verb", WRITERS)
def test_every_verb_tells_the_file_in_one_line_and_leaves_no_half(verb, desk_run, desk_log, tmp_path):
    if verb == "plan":  # its kernels are compiled into files that are larger than the limit
        mapper("plan", shutil.copytree(desk_run.path, tmp_path / "before"), *WRITERS[verb][2:])
    run, out = shutil.copytree(desk_run.path, tmp_path / "run"), tmp_path / "out"
    out.mkdir()
    before = digest_of(run)
    places = {"RUN": str(run), "LOG": str(desk_log), "OUT": str(out)}
    arguments = [re.sub("^(RUN|LOG|OUT)", lambda found: places[found[0]], word) for word in WRITERS[verb]]

    with largest_file(600):
        told = mapper(*arguments, status=1)

    lines = [line for line in told.stderr.splitlines() if line.startswith("mapper: ")]
    assert re.match(f"mapper: {tmp_path}.*: cannot be written: (File too large|\\d+ requested)", lines[-1])
    left = [path for path in out.rglob("*") if path.is_file() and ".partial" not in str(path)]
    assert all(path.stat().st_size < 600 for path in left), "only files that are whole"
    temporary = [path for path in tmp_path.rglob(".*") if path.name != ".mapper.part"]
    assert not temporary, "only the mark of a folder that is not whole"
    assert digest_of(run) == before


def test_a_full_disk_leaves_no_file_and_one_line(desk_log, tmp_path):
    with largest_file(3000):
        build = mapper("build", desk_log, "--out", tmp_path / "run", "--quiet", status=1)
    assert build.stderr.count("\n") == 1
    assert "File too large; raise the limit (ulimit -f)" in build.stderr
    assert not (tmp_path / "run").exists()
    assert [path.name for path in (tmp_path / "run.partial").glob(".*")] in ([], [".mapper.part"])
