"""The architecture is a test: folders depend one way, and heavy libraries have one home each."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.imports import imports_of
from tests.support.paths import ROOT

OURS = {"mapper", "evaluators", "cli"}
MAY_IMPORT = {"mapper": {"mapper"}, "evaluators": {"evaluators", "mapper"}, "cli": OURS}
LAYERS = (
    "core",
    "runtime",
    "sensing",
    "features",
    "graph",
    "registration",
    "octree",
    "navigation",
    "sources",
    "simulation",
    "places",
    "odometry",
    "loops",
    "mapping",
    "config",
    "run",
    "export",
    "line_laser",
    "merging",
    "pipeline",
    "api",
)
"""The folders of mapper/. Each may import those before it, so there is no circle."""

SUBFOLDERS = {"odometry": ("camera", "keyframes", "isvd", "scans")}
"""Folders in folders of mapper/ that are layers as well; the modules beside them combine them."""

NO_RUN = {"config", "run", "export", "pipeline"}
FORBIDDEN = {
    "sensing": NO_RUN,
    "features": NO_RUN,
    "places": NO_RUN,
    "registration": NO_RUN,
    "odometry": NO_RUN,
    "loops": NO_RUN,
    "octree": NO_RUN,
    "navigation": NO_RUN,
    "mapping": NO_RUN,
    "graph": NO_RUN | {"odometry", "loops"},
    "run": {"export", "merging", "pipeline"},
}
"""Imports that are wrong in any order of the layers: methods know no run, fusing needs no writer, solving
needs no tracking, a run needs no merging."""

ASKS_UPWARDS = {
    ("mapper/run/folder.py", "mapper.export.picture"),
    ("mapper/__init__.py", "mapper.evaluators.compare.files"),
    ("mapper/__init__.py", "mapper.evaluators.metrics.evaluate"),
}
"""Imports against the order, loaded when they are used: ``run.plot()`` and notebooks draw a run, and
``mapper.evaluate`` is named beside the library's other functions."""

ASKS_BY_NAME = {
    ("mapper/core/trajectory.py", "mapper.sources.trajectory_files"),
    ("mapper/run/folder.py", "mapper.api.runs"),
    ("mapper/run/folder.py", "mapper.evaluators.pictures.run_report"),
}
"""Modules that import a module of this project that imports them: loaded by name when they are used."""

HOMES = {
    "gtsam": ("mapper/graph/",),
    "mcap": ("mapper/export/mcap_log.py", "mapper/sources/ros/"),
    "simplejpeg": ("mapper/sources/image_files/jpeg.py",),
    "rosbags": ("mapper/sources/ros/",),
    "foxglove": ("mapper/export/", "mapper/sources/ros/decode_foxglove.py"),
    "google": ("mapper/sources/ros/decode_foxglove.py",),
    "laspy": ("mapper/sources/cloud_files/las.py",),
    "pypcd4": ("mapper/sources/cloud_files/pcd.py",),
    "typer": ("cli/",),
    "rich": ("cli/",),
    "open3d": ("mapper/export/mesh.py", "mapper/registration/ndt.py", "mapper/registration/rgbd.py"),
    "small_gicp": (),
    "kiss_icp": ("mapper/odometry/scans/kiss_icp_matcher.py",),
    "kiss_matcher": ("mapper/registration/kiss_matcher.py",),
    "pyoctomap": (),
    "evo": (),
    "rerun": ("mapper/export/rerun/",),
    "distributed": ("mapper/runtime/executor.py",),
    "OpenEXR": ("mapper/sources/image_files/exr.py",),
    "lzfse": ("mapper/sources/image_folders/record3d.py",),
    "pye57": ("mapper/sources/scan_folders/e57.py",),
    "velodyne_decoder": ("mapper/sources/velodyne_packets.py",),
    "dpkt": ("mapper/sources/captures.py",),
    "pyarrow": ("evaluators/study/table.py",),
}


def package_of(module: str) -> str:
    """Return which of ours a module is of: mapper.cli and mapper.evaluators count as themselves."""
    parts = module.split(".")
    return parts[1] if parts[0] == "mapper" and parts[1:2] in (["cli"], ["evaluators"]) else parts[0]


def imports_in(package: str) -> Iterator[tuple[str, int, str]]:
    for path in sorted((ROOT / package).rglob("*.py")):
        yield from ((str(path.relative_to(ROOT)), one.line, one.module) for one in imports_of(path))


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_layers_point_one_way(package):
    for path, line, module in imports_in(package):
        root = package_of(module)
        if (path, module) in ASKS_UPWARDS:
            continue
        assert root not in OURS or root in MAY_IMPORT[package], f"{path}:{line} imports {root}"


def test_few_modules_are_imported_by_name():
    found = set()
    for path in sorted((ROOT / "mapper").rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if "import_module(" in text else ():
            match node:
                case ast.Call(func=ast.Name(id="import_module"), args=[ast.Constant(value=str(name))]):
                    found.add((str(path.relative_to(ROOT)), name))
    assert found == ASKS_BY_NAME


def folder_imports() -> Iterator[tuple[str, str, str, str]]:
    """Yield (where, folder, imported folder, imported module) of every import between folders of mapper/."""
    for path, line, module in imports_in("mapper"):
        inner, parts = Path(path).parts[1:-1], module.split(".")
        if (path, module) in ASKS_UPWARDS:
            continue
        if parts[0] == "mapper" and len(parts) > 1 and inner and inner[0] != parts[1]:
            yield f"{path}:{line}", inner[0], parts[1], module


def test_every_folder_has_its_layer_and_no_module_is_loose():
    folders = {path.parent.name for path in (ROOT / "mapper").glob("*/__init__.py")}
    assert folders == {*LAYERS, "cli", "evaluators"}
    assert [path.name for path in (ROOT / "mapper").glob("*.py")] == ["__init__.py"]
    assert [path.name for path in (ROOT / "evaluators").glob("*.py")] == ["__init__.py"]


def test_folders_depend_one_way():
    for where, folder, imported, module in folder_imports():
        assert LAYERS.index(imported) < LAYERS.index(folder), f"{where}: {folder} imports {module}"
        assert imported not in FORBIDDEN.get(folder, ()), f"{where}: {folder} imports {module}"


@pytest.mark.parametrize("folder", SUBFOLDERS)
def test_subfolders_depend_one_way(folder):
    layers, prefix = SUBFOLDERS[folder], f"mapper.{folder.replace('/', '.')}."
    assert {path.parent.name for path in (ROOT / "mapper" / folder).glob("*/__init__.py")} == set(layers)
    for path, line, module in imports_in("mapper"):
        inner, imported = path.removeprefix(f"mapper/{folder}/"), module.removeprefix(prefix)
        if inner != path and "/" in inner and imported != module and "." in imported:
            own, other = inner.split("/")[0], imported.split(".")[0]
            assert layers.index(other) <= layers.index(own), f"{path}:{line}: {own} imports {module}"


def test_the_lowest_layers_import_only_errors_and_units():
    for where, folder, _, module in folder_imports():
        assert folder not in {"core", "runtime"} or module in {"mapper.core.errors", "mapper.core.units"}, (
            f"{where} imports {module}"
        )


def settings_modules() -> list[Path]:
    return [path for path in sorted((ROOT / "mapper").rglob("*config.py")) if path.parent.name != "config"]


@pytest.mark.parametrize("path", settings_modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_settings_import_only_settings(path):
    for one in imports_of(path):
        known = one.module.split(".")[0] in {*sys.stdlib_module_names, "pydantic"}
        assert known or one.module.endswith("config"), f"{path}:{one.line} imports {one.module}"


def test_settings_build_nothing():
    for path in settings_modules():
        for node in ast.walk(ast.parse(path.read_text())):
            assert not (isinstance(node, ast.FunctionDef) and node.name == "build"), f"{path}:{node.lineno}"


@pytest.mark.parametrize("library", HOMES)
def test_each_big_library_has_one_home(library):
    homes = HOMES[library]
    for package in OURS:
        for path, line, module in imports_in(package):
            root = package_of(module)
            assert root != library or path.startswith(homes), f"{path}:{line} imports {library}"


def test_no_file_outgrows_one_sitting():
    for package in (*OURS, "tests"):
        for path in (ROOT / package).rglob("*.py"):
            lines = len(path.read_text().splitlines())
            assert lines <= 420, f"{path} has {lines} lines; split it by what it says"
