"""The public API is a list in one file: a name that comes or goes changes the list, and so is seen."""

import json

import mapper
from mapper.core.trajectory import Trajectory
from tests.support.paths import ROOT

PUBLIC = json.loads((ROOT / "tests/architecture/public_api.json").read_text(encoding="utf-8"))
CLASSES = {"Run": mapper.Run, "OctreeMap": mapper.OctreeMap, "Trajectory": Trajectory}
MOST_NAMES = 60
"""Names of the package and of the run and the path that its functions return, which a user meets first."""


def members(kind):
    return sorted(name for name in dir(kind) if not name.startswith("_"))


def test_the_package_has_the_names_of_the_list():
    assert sorted(mapper.__all__) == PUBLIC["mapper"]
    assert all(getattr(mapper, name).__doc__ for name in mapper.__all__)


def test_its_classes_have_the_members_of_the_list():
    assert {name: members(kind) for name, kind in CLASSES.items()} == {name: PUBLIC[name] for name in CLASSES}


def test_a_user_meets_few_names():
    assert sum(len(PUBLIC[name]) for name in ("mapper", "Run", "Trajectory")) <= MOST_NAMES
