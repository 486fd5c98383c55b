"""Base class of all settings, and the types of their fields."""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

Ratio = Annotated[float, Field(ge=0.0, le=1.0)]
"""A ratio from 0 to 1."""

_BRACKETS = re.compile(r"[\[\](){}]")
_SQUARE = str.maketrans("()", "[]")


AnyConfig = TypeVar("AnyConfig", bound="Config")


class Config(BaseModel):
    """Base of all settings: frozen, and unknown names are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, ser_json_inf_nan="constants")

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield what differs from the defaults alone, so that all settings fit a screen."""
        fields = type(self).model_fields
        for name, value in super().__repr_args__():
            if name not in fields or value != fields[name].get_default(call_default_factory=True):
                yield name, value

    @model_validator(mode="before")
    @classmethod
    def _split_lists(cls, given: Any) -> Any:
        """Split text where the setting is a list: "1,2", "[1, 2]" and "(1, 2)" mean the same.

        The elements of an override stay text, which the model parses.
        """
        if not isinstance(given, dict):
            return given
        return {
            name: _elements(value) if isinstance(value, str) and cls._is_list(name) else value
            for name, value in given.items()
        }

    @classmethod
    def _is_list(cls, name: str) -> bool:
        """Return whether a setting is a list whose text nothing else parses."""
        field = cls.model_fields.get(name)
        if field is None or any(isinstance(step, BeforeValidator) for step in field.metadata):
            return False
        kinds = (field.annotation, *get_args(field.annotation))
        return any(get_origin(kind) in (tuple, list) for kind in kinds)


def _elements(text: str) -> Any:
    """Return the elements of a list as text, of a list of lists as JSON has them; else the text as it is."""
    text = text.strip()
    inner = text[1:-1] if text[:1] + text[-1:] in ("[]", "()") else text
    if not _BRACKETS.search(inner):
        elements = [element.strip(" \t\"'") for element in inner.split(",")]
        return elements if elements[-1] else elements[:-1]
    try:
        return json.loads(text.translate(_SQUARE))
    except ValueError:
        return text


def members_of(annotation: Any) -> list[type[Config]]:
    """Return the classes of settings that a field may hold, whatever union its annotation is."""
    if isinstance(annotation, type) and issubclass(annotation, Config):
        return [annotation]
    return [member for inner in get_args(annotation) for member in members_of(inner)]


def kind_of(member: type[Config]) -> str:
    """Return the ``kind`` by which a member of a union is chosen; empty without one."""
    field = member.model_fields.get("kind")
    return "" if field is None else str(field.default)


def flattened(tree: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return nested settings by dotted name."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        key = f"{before}{name}"
        flat |= flattened(value, f"{key}.") if isinstance(value, Mapping) else {key: value}
    return flat


def with_changes(config: AnyConfig, change: Callable[[str, Any], Any]) -> AnyConfig:
    """Return settings with each value, at any depth, as a function makes it of its name and what it is."""
    new = {
        name: with_changes(value, change) if isinstance(value, Config) else change(name, value)
        for name, value in config
    }
    return config.model_copy(update={name: new[name] for name, value in config if new[name] is not value})


def scale_length(length: Any, factor: float) -> Any:
    """Return a length, or each of a tuple of lengths, multiplied."""
    return tuple(factor * one for one in length) if isinstance(length, tuple) else factor * length


def drop_unknown(model: type[Config], tree: Any) -> list[str]:
    """Delete the names that a model does not have from what an older version wrote; return them, dotted.

    Args:
        model: Class of the settings.
        tree: Parsed JSON; changed in place. What else is wrong with it is left to the model.
    """
    try:
        model.model_validate(tree)
    except ValidationError as error:
        return [_delete(tree, one["loc"]) for one in error.errors() if one["type"] == "extra_forbidden"]
    return []


def _delete(tree: Any, loc: Sequence[Any]) -> str:
    """Delete a setting and return its dotted name.

    A location also names, after a union, the kind of its member, by which a setting may be called as well.
    """
    node: Any = tree
    parent: Any = tree
    names: list[Any] = []
    is_kind_seen = False
    for part in loc:
        if isinstance(node, dict) and part == node.get("kind") and not is_kind_seen:
            is_kind_seen = True
        elif isinstance(node, list) or part in node:
            names.append(part)
            parent, node, is_kind_seen = node, node[part], False
    del parent[names[-1]]
    return ".".join(str(name) for name in names)


_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(settings: Mapping[str, Any]) -> str:
    """Return settings as TOML, which has no word for none: such a setting is a comment."""
    return "\n".join(_toml_section(settings, ())).strip()


def _toml_section(table: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[str]:
    """Yield the lines of a table, plain values first, since they may not follow the tables in it."""
    values = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    if path and (values or not table):
        yield f"\n[{'.'.join(map(_toml_key, path))}]"
    for key, value in values.items():
        yield f"# {_toml_key(key)} = none" if value is None else f"{_toml_key(key)} = {_toml_value(value)}"
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _toml_section(value, (*path, key))


def _toml_key(key: str) -> str:
    return key if _BARE.fullmatch(key) else json.dumps(key, ensure_ascii=False)


def _toml_value(value: Any) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # inf, -inf and nan are TOML's words, too
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_toml_key(key)} = {_toml_value(one)}' for key, one in value.items())}}}"
    return json.dumps(value, ensure_ascii=False)
