"""A run's ``edits.toml``: read, and changed with all that a user wrote into it left as it is; edits files."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import NonNegativeInt, model_validator

from mapper.config.loading import parse_config
from mapper.core.config import Config
from mapper.core.errors import ConfigError
from mapper.core.geometry import Transform, transform
from mapper.core.rotations import rotation_from_quaternion
from mapper.mapping.config import EditKind, Edits, Region
from mapper.run import files
from mapper.runtime.atomic import write_text
from mapper.runtime.regular_files import read_text

_HEADER = re.compile(r"^[ \t]*\[\[", re.MULTILINE)


class LoopEdit(Config):
    """Loop that a user rejects."""

    nodes: tuple[NonNegativeInt, NonNegativeInt]


class AcceptedLoop(LoopEdit):
    """Loop that a user accepts, and how the two frames were aligned by hand, if they were."""

    translation_m: tuple[float, float, float] | None = None
    """Position of the second node's frame in the first one's."""
    rotation_xyzw: tuple[float, float, float, float] | None = None
    """Its orientation there."""

    by_eye: bool = False
    """The alignment itself is the measurement: the first one's scan need not show the second one's place."""

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.by_eye and self.translation_m is None:
            raise ValueError("by_eye: want translation_m and rotation_xyzw with it")
        if (self.translation_m is None) != (self.rotation_xyzw is None):
            raise ValueError("translation_m and rotation_xyzw: want both, or neither")
        return self

    @property
    def aligned(self) -> Transform | None:
        """(4, 4) pose of the second node's frame in the first one's, as aligned by hand.

        Raises:
            DataError: The orientation is none.
        """
        if self.translation_m is None or self.rotation_xyzw is None:
            return None
        rotation = rotation_from_quaternion(np.array(self.rotation_xyzw))
        return transform(rotation, np.array(self.translation_m))


class EditsFile(Edits):
    """Edits file, which the page saves and ``mapper edit --from`` takes: loops, and regions to be added."""

    accept: tuple[AcceptedLoop, ...] = ()
    """Pairs of nodes at one place, whether they are a candidate or not."""
    reject: tuple[LoopEdit, ...] = ()
    """Accepted loops that are wrong."""
    drop: tuple[NonNegativeInt, ...] = ()
    """Keyframes, by their nodes, whose frames no map has, and which no loops tie."""

    @property
    def regions(self) -> Iterator[tuple[EditKind, Region]]:
        """The regions with their kinds."""
        kinds: tuple[EditKind, ...] = ("erase", "keep", "keepout")
        return ((kind, region) for kind in kinds for region in getattr(self, kind))


def edits_text(folder: Path) -> str:
    """Return the text of a run's ``edits.toml``; empty where there is none.

    Raises:
        ConfigError: It cannot be read.
    """
    path = folder / files.EDITS
    return read_text(path, error=ConfigError) if path.exists() else ""


def parse_edits(text: str, folder: Path) -> Edits:
    """Return the edits of a text.

    Args:
        text: Content of the file, TOML.
        folder: The run, for messages.

    Raises:
        ConfigError: The text is no TOML, or says something that is no edit.
    """
    return parse_config(text, folder / files.EDITS, Edits)


def write_edits(folder: Path, text: str) -> None:
    """Write a run's ``edits.toml``; without any text there is none."""
    path = folder / files.EDITS
    if text.strip():
        write_text(path, text)
    else:
        path.unlink(missing_ok=True)


def with_region(text: str, folder: Path, kind: EditKind, region: Region) -> str:
    """Return the text with one more region at its end.

    Raises:
        ConfigError: As :func:`parse_edits`, or the file lists regions in a way that cannot be continued.
    """
    before = parse_edits(text, folder)
    table = "\n".join([f"[[{kind}]]", *region.lines, ""])
    longer = f"{text.rstrip()}\n\n{table}".lstrip()
    wanted = before.model_copy(update={kind: (*getattr(before, kind), region)})
    return _checked(longer, folder, wanted)


def without_last(text: str, folder: Path) -> str:
    """Return the text without the region that it ends with.

    Raises:
        ConfigError: As :func:`with_region`, or there is no region.
    """
    before = parse_edits(text, folder)
    if not before:
        raise ConfigError(f"{folder}: has no edits to undo")
    starts = [header.start() for header in _HEADER.finditer(text)]
    table = text[max(starts, default=len(text)) :]
    last = parse_edits(table, folder)
    kind = next((name for name, regions in last if regions), "erase")
    wanted = before.model_copy(update={kind: getattr(before, kind)[:-1]})
    return _checked(text[: len(text) - len(table)].rstrip() + "\n", folder, wanted)


def _checked(text: str, folder: Path, wanted: Edits) -> str:
    try:
        if parse_edits(text, folder) == wanted:
            return text
    except ConfigError:
        pass
    raise ConfigError(
        f"{folder / files.EDITS}: its regions are not listed as [[erase]], [[keep]] and [[keepout]] tables; "
        "edit it by hand, then mapper fuse"
    )
