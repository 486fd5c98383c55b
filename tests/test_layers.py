"""The architecture is a test: packages depend one way, and heavy libraries have one home each."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OURS = {"mapper", "evaluators", "cli"}
MAY_IMPORT = {"mapper": {"mapper"}, "evaluators": {"evaluators", "mapper"}, "cli": OURS}
TRIES_THEM_ALL = "mapper/doctor/self_tests.py"
HOMES = {
    "gtsam": ("mapper/graph/",),
    "mcap": ("mapper/export/mcap_log.py", "mapper/sources/ros/"),
    "rosbags": ("mapper/sources/ros/",),
    "foxglove": ("mapper/export/", "mapper/sources/ros/decode_foxglove.py"),
    "google": ("mapper/sources/ros/decode_foxglove.py",),
    "mahotas": ("mapper/features/",),
    "laspy": ("mapper/sources/cloud_files/las.py",),
    "pypcd4": ("mapper/sources/cloud_files/pcd.py",),
    "typer": ("cli/",),
    "rich": ("cli/",),
    "open3d": ("mapper/export/mesh.py", "mapper/registration/ndt.py", "mapper/registration/rgbd.py"),
    "small_gicp": (),
    "kiss_icp": ("mapper/odometry/scan_to_map/kiss.py",),
    "kiss_matcher": ("mapper/registration/kiss_matcher.py",),
    "pyoctomap": (),
    "evo": (),
    "rerun": ("mapper/export/rerun/",),
    "distributed": ("mapper/runtime/executor.py",),
    "pyarrow": ("evaluators/parquet.py",),
    "simplejpeg": ("mapper/sources/jpeg.py",),
}


def imports_of(package: str) -> Iterator[tuple[str, int, str]]:
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}:{node.lineno}: import by full name"
                yield str(path.relative_to(ROOT)), node.lineno, (node.module or "").split(".")[0]
            elif isinstance(node, ast.Import):
                for name in node.names:
                    yield str(path.relative_to(ROOT)), node.lineno, name.name.split(".")[0]


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_layers_point_one_way(package):
    for path, line, root in imports_of(package):
        assert root not in OURS or root in MAY_IMPORT[package], f"{path}:{line} imports {root}"


@pytest.mark.parametrize("library", HOMES)
def test_each_big_library_has_one_home(library):
    homes = (*HOMES[library], TRIES_THEM_ALL)
    for package in OURS:
        for path, line, root in imports_of(package):
            assert root != library or path.startswith(homes), f"{path}:{line} imports {library}"


def test_no_file_outgrows_one_sitting():
    for package in (*OURS, "tests"):
        for path in (ROOT / package).rglob("*.py"):
            lines = len(path.read_text().splitlines())
            assert lines <= 420, f"{path} has {lines} lines; split it by what it says"
