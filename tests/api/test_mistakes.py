"""A user's mistake is a MapperError of one line."""

import shutil

import numpy as np
import pytest

import mapper
from mapper.core.trajectory import trajectory_from

POINTS = np.random.default_rng(0).uniform(-3.0, 3.0, (500, 3))
WRONG = {
    "no log": lambda folder: mapper.open_log(f"{folder}/nothing"),
    "no log to build": lambda folder: mapper.build(f"{folder}/nothing", out=folder / "run"),
    "a setting of no log": lambda folder: mapper.open_log(f"{folder}", settings={"source.lost": 1}),
    "no run": lambda folder: mapper.open_run(f"{folder}/nothing"),
    "a folder that is no run": lambda folder: mapper.open_run(str(folder)),
    "no octree": lambda folder: mapper.read_octree(f"{folder}/nothing"),
    "a folder as an octree": lambda folder: mapper.read_octree(str(folder)),
    "voxels of no size": lambda _: mapper.OctreeMap(0),
    "voxels of a word": lambda _: mapper.OctreeMap("fine"),
    "no configuration": lambda folder: mapper.load_config(f"{folder}/nothing.toml"),
    "an unknown setting": lambda _: mapper.load_config(settings={"octree.resolution": 1}),
    "a word for a number": lambda _: mapper.load_config(settings={"octree.resolution_m": "fine"}),
    "no cloud": lambda folder: mapper.register(f"{folder}/a.ply", f"{folder}/b.ply"),
    "a folder as a cloud": lambda folder: mapper.register(str(folder), str(folder)),
    "flat points": lambda _: mapper.register(np.zeros((9, 2)), np.zeros((9, 2)), method="icp"),
    "points that are not finite": lambda _: mapper.register(POINTS * np.nan, POINTS, method="icp"),
    "an unknown method": lambda _: mapper.register(POINTS, POINTS, method="magic"),
    "a guess of no motion": lambda _: mapper.register(POINTS, POINTS, method="icp", guess=np.zeros((4, 4))),
    "a guess without use": lambda _: mapper.register(POINTS, POINTS, guess=np.eye(4)),
    "nothing to evaluate": lambda folder: mapper.evaluate(f"{folder}/nothing"),
    "an array of poses": lambda _: mapper.evaluate(np.zeros((3, 8))),
    "no estimate": lambda _: mapper.evaluate(None),
    "a number as the truth": lambda _: mapper.evaluate(trajectory_from([(0, np.eye(4))]), 5),
    "no truth": lambda folder: mapper.evaluate(f"{folder}/a.tum", f"{folder}/b.tum"),
}


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_are_one_line(case, tmp_path):
    with pytest.raises(mapper.MapperError) as caught:
        WRONG[case](tmp_path)
    message = str(caught.value)
    assert message
    assert "\n" not in message


def test_a_run_that_is_there_is_not_replaced_unasked(desk_run, desk_log, tmp_path):
    there = shutil.copytree(desk_run.path, tmp_path / "run")
    with pytest.raises(mapper.MapperError, match="run: "):
        mapper.build(desk_log, out=there)
