"""Profiler: items of stages, and samples of threads as a file of speedscope."""

import json
import threading

import pytest

from mapper.runtime.profiler import Profiler
from mapper.runtime.progress import SILENT


def be_busy_until(has_happened):
    while not has_happened():
        sum(range(1000))


def test_samples_name_the_functions_of_each_thread_in_a_file_of_speedscope(tmp_path):
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
    tree = json.loads((tmp_path / "profile.json").read_text())
    assert tree["$schema"] == "https://www.speedscope.app/file-format-schema.json"
    names = [frame["name"] for frame in tree["shared"]["frames"]]
    profiles = {profile["name"]: profile for profile in tree["profiles"]}
    assert any(names[i] == "be_busy_until" for stack in profiles["worker"]["samples"] for i in stack)
    assert not {"waiting", "profiler"} & profiles.keys()
    for profile in profiles.values():
        assert (profile["type"], profile["unit"], profile["startValue"]) == ("sampled", "seconds", 0.0)
        assert profile["endValue"] == pytest.approx(sum(profile["weights"]))
        assert len(profile["samples"]) == len(profile["weights"])


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
