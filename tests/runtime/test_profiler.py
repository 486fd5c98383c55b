"""Profiler: items of stages, and samples of threads as a file of speedscope."""

import json
import threading

import pytest

from mapper.runtime.profiler import Profiler
from mapper.runtime.progress import SILENT


def be_busy_until(has_happened):
    while not has_happened():
        sum(range(1000))


def profiles_of(path):
    tree = json.loads(path.read_text())
    names = [frame["name"] for frame in tree["shared"]["frames"]]
    return {
        profile["name"]: {
            "/".join(names[i] for i in stack): w
            for stack, w in zip(profile["samples"], profile["weights"], strict=True)
        }
        for profile in tree["profiles"]
    }


def test_samples_name_the_functions_of_each_thread(tmp_path):
    profiler = Profiler(SILENT)
    with profiler:
        workers = [
            threading.Thread(
                target=be_busy_until, args=(lambda: len(profiler._samples["worker"]) > 0,), name="worker"
            ),
            threading.Thread(target=threading.Event().wait, args=(0.05,), name="waiting"),
        ]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    profiler.write(tmp_path / "profile.json", name="log")
    profiles = profiles_of(tmp_path / "profile.json")
    assert any("be_busy_until" in stack for stack in profiles["worker"])
    assert "waiting" not in profiles
    assert "profiler" not in profiles


def test_profile_is_valid_for_speedscope(tmp_path):
    profiler = Profiler(SILENT)
    with profiler:
        be_busy_until(lambda: len(profiler._samples) > 0)
    profiler.write(tmp_path / "profile.json", name="log")
    tree = json.loads((tmp_path / "profile.json").read_text())
    assert tree["$schema"] == "https://www.speedscope.app/file-format-schema.json"
    for profile in tree["profiles"]:
        assert (profile["type"], profile["unit"], profile["startValue"]) == ("sampled", "seconds", 0.0)
        assert profile["endValue"] == pytest.approx(sum(profile["weights"]))
        assert len(profile["samples"]) == len(profile["weights"])
        assert max(max(stack) for stack in profile["samples"]) < len(tree["shared"]["frames"])


def test_stages_count_their_items_and_pass_them_on():
    reported = []

    class Progress:
        note = reported.append

        def stage(self, name):
            return SILENT.stage(name)

    profiler = Profiler(Progress())
    profiler.note("hello")
    for count in (3, 1):
        with profiler.stage(f"of {count}") as report:
            for done in range(count):
                report(done + 1, count)
    with profiler.stage("empty"):
        pass
    stages = profiler.stages()
    assert {name: stage["items"] for name, stage in stages.items()} == {"of 3": 3, "of 1": 1}
    assert all(0.0 <= stage["median_ms"] <= stage["p95_ms"] for stage in stages.values())
    assert reported == ["hello"]
