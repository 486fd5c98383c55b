"""Text of a refused setting: what is wrong with it, and the nearest right name."""

from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from mapper.core.config import Config, kind_of, members_of

_Location = Sequence[int | str]


def refusal(model: type[Config], error: Mapping[str, Any]) -> str:
    """Return ``name: reason`` of one of pydantic's errors.

    Args:
        model: The class that refused.
        error: One of ``ValidationError.errors()``.
    """
    loc: _Location = error["loc"]
    reason = error["msg"]
    if error["type"] == "extra_forbidden":
        reason = f"unknown; {_hint(model, loc)}"
    elif error["type"] == "value_error":  # one of ours, which names the setting where several are concerned
        reason = str(error["ctx"]["error"])
        if not loc:
            return reason
    elif error["type"] == "missing" and isinstance(loc[-1], int):
        loc, reason = loc[:-1], f"{loc[-1]} values are too few"
    elif error["type"] == "tuple_type" and isinstance(error["input"], str):
        reason = "want a list, as in 1,2,3"
    elif isinstance(error["input"], (str, int, float)) and error["type"] != "missing":
        reason = f"{reason}, not {error['input']}"
    return f"{'.'.join(map(str, loc)) or 'configuration'}: {reason}"


def _hint(model: type[Config], loc: _Location) -> str:
    """Return what was perhaps meant by an unknown name, or else which names are known."""
    *parents, name = loc
    alternatives = _members_at(model, parents[:-1])
    if len(alternatives) > 1 and (kinds := [kind_of(m) for m in alternatives if name in m.model_fields]):
        return f"{'.'.join(map(str, parents[:-1]))}.kind={' or '.join(kinds)} has it"
    known = [field for member in _members_at(model, parents)[:1] for field in member.model_fields]
    if close := get_close_matches(str(name), known, n=1):
        return f"did you mean {close[0]}?"
    if elsewhere := [path for path in _paths(model) if path.split(".")[-1] == name]:
        return f"did you mean {' or '.join(elsewhere)}?"
    return f"known are {', '.join(known)}"


def _members_at(model: type[Config], loc: _Location) -> list[type[Config]]:
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


def _paths(model: type[Config]) -> Iterator[str]:
    """Yield the dotted name of every setting of the default kinds and below."""
    for name, field in model.model_fields.items():
        yield name
        default = field.get_default(call_default_factory=False)
        if isinstance(default, Config):
            yield from (f"{name}.{path}" for path in _paths(type(default)))
