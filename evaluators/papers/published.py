"""The figures that the three papers print, transcribed in ``published.json``."""

import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any, Literal

Figures = Mapping[str, Mapping[str, float | None]]
"""Row, column, figure."""


@cache
def published() -> dict[str, Any]:
    """Return the papers' tables by name; every table carries its ``source``."""
    text = files("mapper.evaluators.papers").joinpath("published.json").read_text("utf-8")
    tables: dict[str, Any] = json.loads(text)
    return tables


def figures(name: str, *, rows: Literal["as printed", "the columns"] = "as printed") -> Figures:
    """Return a table's figures by row and column, or turned on its side."""
    table = published()[name]
    printed = {
        str(row): dict(zip(table["columns"], values, strict=True)) for row, values in table["rows"].items()
    }
    if rows == "as printed":
        return printed
    return {column: {row: printed[row][column] for row in printed} for column in table["columns"]}
