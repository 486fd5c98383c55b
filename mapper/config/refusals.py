"""Refusals of settings: what is wrong with a name or a value, and what was perhaps meant, in one line."""

import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from mapper.core.config import Config, kind_of, members_of
from mapper.core.errors import ConfigError

_WANTED = {
    **dict.fromkeys(("float_parsing", "float_type"), "a number"),
    **dict.fromkeys(("int_parsing", "int_type", "int_from_float"), "a whole number"),
    **dict.fromkeys(("bool_parsing", "bool_type"), "true or false"),
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "a table of settings"),
    **dict.fromkeys(("tuple_type", "list_type"), "a list, as in 1,2,3"),
    "finite_number": "a finite number",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
    "literal_error": "{expected}",
    "missing": "a value, which is missing",
    "multiple_of": "a multiple of {multiple_of}",
    "too_long": "at most {max_length} values",
    "too_short": "{min_length} or more",
    "string_type": "text",
    "union_tag_not_found": "a kind",
}
"""What a setting must be, by the type of pydantic's error."""
_OTHER_UNITS = 100.0
"""Lengths from this multiple of their default on are centimetres or millimetres."""
_SIZES = re.compile(
    r"(resolution|voxel|radius|height|step|keyframe_distance|pair_distance|footprint|tolerance)_m$"
)
"""Lengths that nobody sets so far from their default; ranges and limits may be, for "no limit"."""


def refuse_other_units(config: Config, default: Config, path: str = "") -> None:
    """Refuse lengths that are meant in another unit: in metres they are absurd beside the default.

    Raises:
        ConfigError: Names the setting, both values, and the default.
    """
    for name, value in config:
        if isinstance(value, Config):
            usual = getattr(default, name, None)
            same = usual if isinstance(usual, type(value)) else type(value).model_construct()
            refuse_other_units(value, same, f"{path}{name}.")
        elif isinstance(value, float) and _SIZES.search(name):
            usual = getattr(default, name, None)
            if isinstance(usual, float) and value >= _OTHER_UNITS * usual > 0.0:
                raise ConfigError(
                    f"{path}{name} is {value:g} m, where {usual:g} m is usual; it is in metres: 0.05 is 5 cm"
                )


def refusal(model: type[Config], error: Mapping[str, Any]) -> str:
    """Return ``name: reason`` of one of pydantic's errors.

    Args:
        model: The class that refused.
        error: One of ``ValidationError.errors()``.
    """
    loc: Sequence[int | str] = error["loc"]
    reason = _sentence(error)
    if error["type"] == "extra_forbidden":
        reason = f"unknown; {_hint(model, loc)}"
    elif error["type"] == "value_error":  # one of ours, which names the setting where several are concerned
        reason = str(error["ctx"]["error"])
        if not loc:
            return reason
    elif error["type"] == "missing" and isinstance(loc[-1], int):
        loc, reason = loc[:-1], f"{loc[-1]} values are too few"
    elif isinstance(error["input"], (str, int, float)) and error["type"] != "missing":
        reason = f"{reason}, not {error['input']}"
    return f"{'.'.join(map(str, loc)) or 'configuration'}: {reason}"


def _sentence(error: Mapping[str, Any]) -> str:
    """Return what one of pydantic's errors wants; its own message if that is of none of our settings."""
    kind, given = error["type"], error.get("ctx", {})
    if kind in _WANTED:
        return f"want {_WANTED[kind].format(**given)}"
    if kind == "union_tag_invalid":
        tags = given["expected_tags"].replace("'", "").split(", ")
        near = get_close_matches(given["tag"], tags, n=1, cutoff=0.7)
        known = f"did you mean {near[0]}?" if near else f"want one of {', '.join(tags)}"
        return f"no kind {given['tag']!r}; {known}"
    message: str = error["msg"]
    return message


def _hint(model: type[Config], loc: Sequence[int | str]) -> str:
    """Return what was perhaps meant by an unknown name, or else which names are known."""
    *parents, name = loc
    alternatives = _members_at(model, parents[:-1])
    if len(alternatives) > 1 and (kinds := [kind_of(m) for m in alternatives if name in m.model_fields]):
        return f"{'.'.join(map(str, parents[:-1]))}.kind={' or '.join(kinds)} has it"
    known = [field for member in _members_at(model, parents)[:1] for field in member.model_fields]
    if close := get_close_matches(str(name), known, n=1):
        return f"did you mean {close[0]}?"
    if elsewhere := [path for path in _setting_names(model) if path.split(".")[-1] == name]:
        return f"did you mean {' or '.join(elsewhere)}?"
    return f"known are {', '.join(known)}"


def _members_at(model: type[Config], loc: Sequence[int | str]) -> list[type[Config]]:
    """Return the classes of the settings that a location leads to: several where it ends before a kind."""
    members = [model]
    for part in loc:
        if isinstance(part, int):  # an element of a list
            continue
        if len(members) > 1:
            members = [member for member in members if kind_of(member) == part]
        elif members and part in members[0].model_fields:
            members = members_of(members[0].model_fields[part].annotation)
    return members


def _setting_names(model: type[Config]) -> Iterator[str]:
    for name, field in model.model_fields.items():
        yield name
        default = field.get_default(call_default_factory=False)
        if isinstance(default, Config):
            yield from (f"{name}.{path}" for path in _setting_names(type(default)))
