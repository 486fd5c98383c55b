"""Settings on the command line: as TOML, and each explained."""

import json
import math
import tomllib

import pytest

from mapper.config.describe import settings
from mapper.config.loading import load_config
from mapper.core.config import toml_text
from tests.support.command_line import mapper


@pytest.mark.parametrize("sensor", ["rgbd", "lidar"])
def test_a_configuration_survives_toml(sensor, tmp_path):
    path = tmp_path / "all.toml"
    path.write_text(mapper("config", "--sensor", sensor).stdout)
    assert load_config(path, sensor=sensor) == load_config(sensor=sensor)
    assert "# max_range_m = none" in path.read_text()


def test_toml_holds_every_kind_of_value():
    tree = {
        "text": 'a "b" \\ ü\n',
        "number": 1e-9,
        "far": math.inf,
        "none": None,
        "table": {"empty": {}, "pairs": [[1, 2.5], []], "odd key": True, "rows": [{"a": 1}, {"b": "x"}]},
        "last": False,
    }
    known = {**tree, "none": None}
    assert {"none": None, **tomllib.loads(toml_text(tree))} == known


def test_a_setting_is_explained_with_its_neighbours():
    text = mapper("config", "octree.resolution_m", "--set", "octree.resolution_m=0.2").stdout
    rows = {line.split()[0]: line.split(maxsplit=1)[1] for line in text.splitlines() if line[:1] != " "}
    assert rows["setting"] == "octree.resolution_m"
    assert rows["takes"].startswith("number > 0")
    assert rows["default"] == "0.05 m"
    assert rows["here"] == "0.2 m"
    assert "hit_probability" in rows["beside"]
    assert len(rows["meaning"]) > 10


def test_choices_and_kinds_are_told():
    assert "local-map | isvd" in mapper("config", "odometry.kind").stdout
    assert "only with  odometry.kind isvd" in mapper("config", "odometry.previous_frames").stdout
    assert "\nhere " not in mapper("config", "odometry.detector.threshold").stdout, "of SURF, not chosen"


def test_a_table_and_the_end_of_a_name_list_what_they_hold():
    table = mapper("config", "octree").stdout
    assert "\noctree.hit_probability " in table
    assert len(table.splitlines()) >= len([s for s in settings() if s.key.startswith("octree.")]) - 5
    ends = {s["key"] for s in json.loads(mapper("config", "kind", "--json").stdout)["settings"]}
    assert {"odometry.kind", "loops.kind"} <= ends


def test_docs_explain_every_setting():
    told = json.loads(mapper("config", "--docs", "--json").stdout)["settings"]
    assert {s["key"] for s in told} == {s.key for s in settings() if not s.is_table}
    assert mapper("config", "--docs").stdout.count("\nmeaning  ") > 0.9 * len(told)


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("octree.resolution", "did you mean octree.resolution_m"),
        ("resolutoin_m", "octree.resolution_m"),
        ("zzz", "the tables are source, odometry"),
    ],
)
def test_an_unknown_setting_names_the_nearest(key, hint):
    line = mapper("config", key, status=1).stderr
    assert line.startswith(f"mapper: {key}: no such setting; ")
    assert hint in line
