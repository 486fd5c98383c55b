import json
import shutil

import pytest
from mcap.reader import make_reader

from mapper.config.loading import overridden
from mapper.export.exporters import export
from mapper.export.mcap_log import PLAN_TOPICS
from mapper.pipeline.fuse import fuse
from mapper.run.folder import open_run
from mapper.sources import open_source


@pytest.fixture(scope="module")
def run(desk_run, desk_log, tmp_path_factory):
    """A copy with larger voxels than the default, and with the frames' times in its log."""
    copy = open_run(shutil.copytree(desk_run.path, tmp_path_factory.mktemp("layout") / "desk"))
    config = overridden(copy.config, ["octree.resolution_m=0.1", "mcap.frame_times=true"])
    return fuse(open_source(desk_log), copy, config)


@pytest.fixture(scope="module")
def panels(run):
    """Panels of the layout by type, wherever they are in it."""
    found = {}

    def walk(content):
        if content["type"] == "panel":
            found.setdefault(content["panelType"], []).append(content["config"])
        for item in content.get("items", []):
            walk(item["content"])

    walk(json.loads(export(run, "foxglove-layout").read_text())["content"])
    return found


@pytest.fixture(scope="module")
def summary(run):
    with (run.path / "run.mcap").open("rb") as file:
        return make_reader(file).get_summary()


def test_every_topic_that_it_names_is_one_of_the_log_s_and_none_is_missing(panels, summary):
    logged = {channel.topic for channel in summary.channels.values()} | set(PLAN_TOPICS)
    [map_panel], [image], [loops] = panels["ThreeDee"], panels["Image"], panels["RawMessages"]
    told = set(map_panel["topics"]) | {
        image["imageMode"]["imageTopic"],
        loops["topicPath"],
        "/diagnostics",
        "/tf",
    }
    assert logged | {"/loops"} == told  # a log without candidates has no /loops


def test_every_curve_is_a_field_of_the_diagnostics(panels, summary):
    [schema] = [one for one in summary.schemas.values() if one.name == "mapper/msg/Diagnostics"]
    fields = {line.split()[1] for line in schema.data.decode().splitlines() if line}
    curves = [series["value"] for plot in panels["Plot"] for series in plot["paths"]]
    assert len(curves) == 5
    assert {curve.removeprefix("/diagnostics.") for curve in curves} <= fields
