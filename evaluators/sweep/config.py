"""Settings of `mapper sweep`: logs, methods and configurations."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, NonNegativeInt, model_validator

from mapper.core.config import Config, flattened


def _assignments(given: Any) -> Any:
    """Return a table of settings as ``key.path=value``; a list as it is."""
    if not isinstance(given, Mapping):
        return given
    flat = flattened(given)
    if lists := [name for name, value in flat.items() if isinstance(value, list)]:
        raise ValueError(f"{lists[0]} is a list; write it into a config file")
    return tuple(f"{name}={value}" for name, value in flat.items())


Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[^\s/].*$")]
Assignments = Annotated[tuple[str, ...], BeforeValidator(_assignments)]
"""``key.path=value`` as for ``--set``, or a table of the same."""


class ConfigurationConfig(Config):
    """Settings that are changed for every method alike."""

    name: Name
    set: Assignments = ()


class MethodConfig(ConfigurationConfig):
    """Method to map a log: a configuration file, and settings changed on top of it."""

    config: Path | None = None
    """TOML file, beside the sweep's own; None begins with the defaults for the log's sensor."""


class SweepConfig(Config):
    """Logs × methods × configurations, each a build of its own."""

    logs: Annotated[tuple[str, ...], Field(min_length=1)]
    """Paths or globs, beside the sweep's own file."""
    method: Annotated[tuple[MethodConfig, ...], Field(min_length=1)]
    configuration: Annotated[tuple[ConfigurationConfig, ...], Field(min_length=1)] = (
        ConfigurationConfig(name="default"),
    )
    """Configurations; they override the method's settings."""
    seeds: tuple[NonNegativeInt, ...] = ()
    """Each build is repeated with these in place of every seed of its configuration, if it has any."""
    keep: Literal["nothing", "trajectory", "run"] = "trajectory"
    """What is kept of each build besides its numbers: "trajectory" with manifest, configuration and summary
    picture, or the whole run folder."""

    @model_validator(mode="after")
    def _no_name_twice(self) -> Self:
        for kind, variants in (("method", self.method), ("configuration", self.configuration)):
            names = [variant.name for variant in variants]
            for name in names:
                if names.count(name) > 1:
                    raise ValueError(f"two of [[{kind}]] are called {name!r}; want different names")
        return self
