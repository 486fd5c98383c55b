"""Options that several verbs share, and combinations that a verb refuses, so that none is ignored."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapper.cli.completion import assignments_to, run_folders, setting_keys
from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.runtime.executor import Workers

Options = Mapping[str, object]
"""Values by option; None, False and an empty list stand for one that is not given."""


def refuse_several(options: Options) -> None:
    """Refuse more than one of some options that exclude each other."""
    if sum(map(_is_given, options.values())) > 1:
        *names, last = options
        raise ConfigError(f"{', '.join(names)} and {last}: choose one")


def refuse_with(other: str, options: Options, *, remedy: str = "leave it out") -> None:
    """Refuse options that have no effect because of another option or argument.

    Args:
        other: The other, as the message names it.
        options: The options.
        remedy: End of the message.
    """
    _refuse_first(options, f"has no meaning with {other}; {remedy}")


def refuse_without(other: str, options: Options) -> None:
    """Refuse options that have no effect because another is missing.

    Args:
        other: The missing one, as the message names it.
        options: The options.
    """
    _refuse_first(options, f"has no meaning without {other}")


def _refuse_first(options: Options, why: str) -> None:
    for name, value in options.items():
        if _is_given(value):
            raise ConfigError(f"{name}{_text(value)}: {why}")


def _is_given(value: object) -> bool:
    return value is not None and value is not False and value != []


def _text(value: object) -> str:
    """Return the value as it follows an option's name; a flag has none."""
    if value is True:
        return ""
    return f" {value[0] if isinstance(value, list) else value}"


ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "--preset",
        help="TOML file, a preset (lidar-indoor, lidar-outdoor, rgbd-indoor, wheels, zhao), or a run's "
        "config.json; omit for the defaults.",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY.PATH=VALUE",
        help="Change one setting; mapper config lists them all.",
        autocompletion=assignments_to,
    ),
]
RunFolder = Annotated[
    Path,
    typer.Argument(metavar="RUN", autocompletion=run_folders, help="Run folder of a finished build."),
]
RunFolders = Annotated[
    list[Path],
    typer.Argument(metavar="RUN...", autocompletion=run_folders, help="Run folders of finished builds."),
]
SettingKey = Annotated[
    str | None,
    typer.Argument(
        metavar="[KEY]",
        help="Setting, table of settings, or the end of a name.",
        autocompletion=setting_keys,
    ),
]
MovedLogs = Annotated[
    list[Path] | None,
    typer.Option(
        "--log",
        help="Path of the log, if it has moved since the build; for several logs, once each in order.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace OUT, once the new one is complete.")]
First = Annotated[int | None, typer.Option("--first", help="Index of the first frame to use.")]
Last = Annotated[int | None, typer.Option("--last", help="Index of the last frame to use.")]
Stride = Annotated[int | None, typer.Option("--stride", help="Use every n-th frame.")]
RequireTruth = Annotated[
    bool | None, typer.Option("--require-truth", help="Drop frames that have no ground truth.")
]


def selection(
    first: int | None, last: int | None, stride: int | None, require_truth: bool | None
) -> dict[str, Any]:
    """Return the settings that short options stand for; what was not given keeps the configured value."""
    return {
        "source.first_frame": first,
        "source.last_frame": last,
        "source.stride": stride,
        "source.require_truth": require_truth or None,
    }


def settings_of(short_options: Mapping[str, Any], overrides: Sequence[str] | None = None) -> dict[str, Any]:
    """Return settings by dotted name: those of short options that were given, and of ``--set``, which win."""
    from mapper.config.loading import parse_assignments

    given = {name: value for name, value in short_options.items() if value is not None}
    return given | parse_assignments(overrides or ())


def workers_for(processes: int | None, scheduler: str | None, *, default: int) -> "Workers":
    """Return where jobs run: on processes of this machine, or on a scheduler's workers.

    Raises:
        ConfigError: There are no processes, or both are given.
    """
    from mapper.runtime.executor import Workers

    if processes is None:
        return Workers(default, scheduler)
    if scheduler is not None:
        refuse_with("--scheduler", {"--processes": processes})
    if processes < 1:
        raise ConfigError(f"--processes {processes}: want at least 1")
    return Workers(processes)
