"""The versions that a result depends on: part of its key, and the same wherever a study's jobs run."""

import hashlib
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mapper
from mapper.core.errors import ConfigError
from mapper.run.manifest import library_versions
from mapper.runtime.resumable_jobs import Record


def versions() -> dict[str, str]:
    """Return the versions of all that can change a result."""
    return {"mapper": mapper.__version__, **library_versions()}


def digest(*decides: Any, digits: int) -> str:
    """Return the first hexadecimal digits of the SHA-256 of everything that a result depends on, as JSON."""
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:digits]


@dataclass(frozen=True, slots=True)
class SameVersions:
    """Work that a machine with other versions of the libraries refuses.

    Attributes:
        work: The work; can be pickled.
        planned: The versions where its key was made.
    """

    work: Callable[[], Sequence[Record]]
    planned: Mapping[str, str]

    def __call__(self) -> Sequence[Record]:
        """Return the work's records.

        Raises:
            ConfigError: This machine has another version of a library, so results would not compare.
        """
        for name, version in versions().items():
            planned = self.planned.get(name)
            if version != planned:
                raise ConfigError(
                    f"worker on {platform.node()}: {name} {version}, where the work was planned with "
                    f"{planned}; results would not compare, so install the same"
                )
        return self.work()
