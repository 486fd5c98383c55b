"""Frames that were tracked long ago, seen again: what a finished run does not keep of them."""

from collections.abc import Collection
from typing import Any

from mapper.config import BuildConfig
from mapper.odometry.base import Odometry, Seen
from mapper.parallel import ordered_map
from mapper.progress import SILENT, Progress
from mapper.sources.base import Entry, FrameSource


def views_again(
    source: FrameSource, stamps_ns: Collection[int], config: BuildConfig, *, progress: Progress = SILENT
) -> dict[int, Seen]:
    """Return what the odometry of a configuration sees in some frames of a log, by stamp.

    Raises:
        FrameError: A frame cannot be read.
    """
    odometry: Odometry[Any] = config.odometry.build()

    def view(entry: Entry) -> tuple[int, Seen]:
        return entry.stamp_ns, odometry.view(odometry.observe(entry.load(colour=False)))

    entries = [entry for entry in source.entries() if entry.stamp_ns in stamps_ns]
    views = {}
    with progress.stage("recall") as report:
        for stamp_ns, seen in ordered_map(view, entries, workers=config.workers):
            views[stamp_ns] = seen
            report(len(views), len(entries))
    return views
