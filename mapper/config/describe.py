"""Description of every setting: key, type, default, unit, choices and meaning, read from the models.

The meaning of a setting is the docstring below it in its class, or in the class that it inherits from. Python
drops these, so they are parsed from the sources, on first use.
"""

import ast
import inspect
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from mapper.config.loading import load_config
from mapper.core.frames import Sensor

_UNITS = {
    "_rad_per_rad": "rad/rad",
    "_rad_per_m": "rad/m",
    "_per_m": "1/m",
    "_px_m": "px·m",
    "_mps": "m/s",
    "_mm": "mm",
    "_px": "px",
    "_hz": "Hz",
    "_rad": "rad",
    "_deg": "°",
    "_ms": "ms",
    "_m": "m",
    "_s": "s",
    "_voxels": "voxels",
    "_keyframes": "keyframes",
    "_frames": "frames",
    "_scans": "scans",
    "_cells": "cells",
}
_NAMES = {bool: "true or false", int: "whole number", float: "number", str: "text", Path: "path"}
_BOUNDS = {Gt: (">", "gt"), Ge: ("≥", "ge"), Lt: ("<", "lt"), Le: ("≤", "le")}


@dataclass(frozen=True)
class Setting:
    """Description of one setting, or of the table that holds some.

    A key stands more than once where the kinds of a method give it different defaults or meanings; ``needs``
    distinguishes them.
    """

    key: str
    """Dotted name, as ``--set`` takes it."""
    type: str
    """Type of its values, as "number > 0" or "5 numbers or none"; "table" where settings stand below it."""
    default: Any
    """Default as JSON has it: of a table a dictionary, None for none."""
    unit: str
    """Unit of its value, as "m"; empty where it has none."""
    choices: tuple[str, ...]
    """All its values, where they are few; else empty."""
    doc: str
    """Meaning, in sentences."""
    needs: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Settings that must have one of some values for it to exist, as ``odometry.kind`` and its kinds."""

    @property
    def is_table(self) -> bool:
        """Whether it holds settings and is none itself, unless it may be none."""
        return self.type.startswith("table")

    @property
    def default_text(self) -> str:
        """Default as ``--set`` takes it; "none" and "table" are what no ``--set`` can say."""
        match self.default:
            case None:
                return "none"
            case dict():
                return "table"
            case str():
                return self.default
            case list():
                return ",".join(json.dumps(value) for value in self.default)
        return json.dumps(self.default)


def settings(sensor: Sensor = "rgbd") -> Iterator[Setting]:
    """Yield the description of every setting of ``mapper build``, tables before what they hold.

    Args:
        sensor: Sensor whose defaults are shown.
    """
    yield from settings_of(load_config(sensor=sensor))


def settings_of(config: BaseModel) -> Iterator[Setting]:
    """Yield the description of every setting of a model.

    Args:
        config: The defaults; of a method's other kinds these are their classes'.
    """
    yield from _fields(config, "")


def _fields(model: BaseModel, prefix: str) -> Iterator[Setting]:
    for name, field in type(model).model_fields.items():
        key = prefix + name
        value = getattr(model, name)
        doc = _meaning(type(model), name)
        annotation = _annotation(field)
        members = _models(annotation)
        if not members:
            kind, choices = _kind(annotation)
            if len(choices) == 1:  # the kind of a method that has no other
                continue
            default = model.model_dump(mode="json", include={name})[name]
            yield Setting(key, kind, default, _unit(name), choices, doc)
            continue
        default = value.model_dump(mode="json") if isinstance(value, BaseModel) else None
        table = "table or none" if NoneType in _alternatives(annotation) else "table"
        about = doc or _text(members[0].__doc__ or "") if len(members) == 1 else doc
        yield Setting(key, table, default, "", (), about)
        yield from _members(key, value, members)


def _members(key: str, value: object, members: list[type[BaseModel]]) -> Iterator[Setting]:
    """Yield what stands below a key: once what several kinds of it have in common."""
    # Without validation: a table that none replaces may refuse all of its members' defaults.
    models = [value if type(value) is member else member.model_construct() for member in members]
    if len(models) == 1:
        yield from _fields(models[0], f"{key}.")
        return
    models.sort(key=lambda model: model is not value)  # the default first
    kinds = [str(model.model_dump()["kind"]) for model in models]
    about = [f"{kind}: {_text(type(model).__doc__ or '')}" for kind, model in zip(kinds, models, strict=True)]
    default = kinds[0] if models[0] is value else None
    yield Setting(f"{key}.kind", "one of the choices", default, "", tuple(kinds), " ".join(about))
    found: dict[str, tuple[Setting, list[str]]] = {}
    for kind, model in zip(kinds, models, strict=True):
        for setting in _fields(model, f"{key}."):
            if setting.key != f"{key}.kind":
                found.setdefault(repr(setting), (setting, []))[1].append(kind)
    for setting, having in found.values():
        needs = () if len(having) == len(kinds) else ((f"{key}.kind", tuple(having)),)
        yield replace(setting, needs=needs + setting.needs)


def _annotation(field: FieldInfo) -> Any:
    """Return a field's annotation with the constraints that pydantic took from it."""
    return Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation


def _alternatives(annotation: Any) -> list[Any]:
    """Return the members of a union, each with its own constraints; of anything else itself."""
    if get_origin(annotation) is Annotated:
        inner, *extra = get_args(annotation)
        parts = _alternatives(inner)
        return [Annotated[part, *extra] if part is not NoneType else part for part in parts]
    if get_origin(annotation) in (Union, UnionType):
        return [part for inner in get_args(annotation) for part in _alternatives(inner)]
    return [annotation]


def _models(annotation: Any) -> list[type[BaseModel]]:
    parts = _alternatives(annotation)
    plain = [get_args(part)[0] if get_origin(part) is Annotated else part for part in parts]
    return [part for part in plain if isinstance(part, type) and issubclass(part, BaseModel)]


def _kind(annotation: Any) -> tuple[str, tuple[str, ...]]:
    """Return what values a field takes, in words, and all of them where they are few."""
    alternatives = _alternatives(annotation)
    named = [_named(part) for part in alternatives if part is not NoneType]
    choices = tuple(choice for _, some in named for choice in some)
    words = list(dict.fromkeys(word for word, _ in named))
    if NoneType in alternatives:
        words.append("none")
    return " or ".join(words), choices


def _named(annotation: Any) -> tuple[str, tuple[str, ...]]:
    inner, *constraints = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
    if get_origin(inner) is Literal:
        return "one of the choices", tuple(map(str, get_args(inner)))
    if inner is bool:
        return _NAMES[bool], ("true", "false")
    if get_origin(inner) is tuple:
        element, *others = get_args(inner)
        word, _ = _kind(element)
        plural = word.replace("number", "numbers", 1)
        return (f"list of {plural}" if others == [...] else f"{1 + len(others)} {plural}"), ()
    return " ".join([_NAMES[inner], " and ".join(_bounds(constraints))]).strip(), ()


def _bounds(constraints: list[Any]) -> Iterator[str]:
    for constraint in constraints:
        if isinstance(constraint, FieldInfo):
            yield from _bounds(constraint.metadata)
        elif type(constraint) in _BOUNDS:
            sign, name = _BOUNDS[type(constraint)]
            yield f"{sign} {getattr(constraint, name):g}"


def _unit(name: str) -> str:
    return next((unit for suffix, unit in _UNITS.items() if f"_{name}".endswith(suffix)), "")


def _meaning(model: type[BaseModel], name: str) -> str:
    """Return the docstring of a field, where it has none that of the class it is inherited from."""
    for base in model.__mro__:
        if issubclass(base, BaseModel) and name in (docs := _attribute_docs(base)):
            return docs[name]
    return ""


@cache
def _attribute_docs(model: type[BaseModel]) -> Mapping[str, str]:
    body = _class_bodies(inspect.getsourcefile(model) or "").get(model.__qualname__, [])
    docs = {}
    for statement, following in pairwise(body):
        match statement, following:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                docs[name] = _text(text)
    return docs


@cache
def _class_bodies(path: str) -> Mapping[str, list[ast.stmt]]:
    module = ast.parse(Path(path).read_text(encoding="utf-8"))
    return {node.name: node.body for node in module.body if isinstance(node, ast.ClassDef)}


def _text(docstring: str) -> str:
    """Return a docstring as one paragraph, its code in single backticks."""
    return " ".join(docstring.split()).replace("``", "`")
