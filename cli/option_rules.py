"""Combinations of options that a verb refuses, so that none is ignored."""

from collections.abc import Mapping

from mapper.core.errors import ConfigError

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
