"""What a module imports, inside functions too."""

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple

STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)


class Import(NamedTuple):
    """An import of a module, or of names from it, by their full names; perhaps for type checkers alone."""

    line: int
    module: str
    names: list[str]
    for_types: bool


@cache
def imports_of(path: Path) -> list[Import]:
    found: list[Import] = []
    todo: list[tuple[ast.AST, bool]] = [(ast.parse(path.read_text(encoding="utf-8")), False)]
    while todo:
        node, for_types = todo.pop()
        match node:
            case ast.ImportFrom(lineno=line, module=module, names=names, level=level):
                assert level == 0, f"{path}:{line}: import by full name"
                found.append(Import(line, str(module), [f"{module}.{one.name}" for one in names], for_types))
            case ast.Import(lineno=line, names=names):
                found += [Import(line, one.name, [one.name], for_types) for one in names]
            case ast.If(test=ast.Name("TYPE_CHECKING")):
                for_types = True
        todo += [(one, for_types) for one in ast.iter_child_nodes(node) if isinstance(one, STATEMENTS)]
    return found
