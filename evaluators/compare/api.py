"""Methods compared on a log, as a library's caller asks for it."""

from collections.abc import Sequence
from pathlib import Path

from mapper.api.progress import AnyProgress, receiver_of
from mapper.config.loading import Settings, overridden
from mapper.evaluators.compare.comparison import Comparison
from mapper.evaluators.compare.config import CompareConfig
from mapper.evaluators.compare.files import compare_into
from mapper.runtime.regular_files import AnyPath
from mapper.sources import open_source


def compare(
    log: AnyPath,
    *,
    methods: Sequence[str] = (),
    out: AnyPath = "compare",
    overrides: Sequence[str] = (),
    settings: Settings | None = None,
    progress: AnyProgress = None,
    overwrite: bool = False,
) -> Comparison:
    """Run every method over the same frames, as ``mapper compare`` does.

    Args:
        log: Recorded log.
        methods: Methods to compare; none are all that fit the log.
        out: Folder to create; a comparison that was stopped is resumed.
        overrides: ``key.path=value`` as text, such as "pairs=10".
        settings: The same as values by dotted name.
        progress: As for ``mapper.build``.
        overwrite: Replace OUT.

    Raises:
        ConfigError: There is no such method or setting.
        RunError: OUT exists already.
        MapperError: The log cannot be opened.
    """
    given = CompareConfig(methods=tuple(methods))
    config = overridden(given, overrides, settings=settings)
    source = open_source(Path(log), config.source)
    return compare_into(Path(out), source, config, overwrite=overwrite, progress=receiver_of(progress))
