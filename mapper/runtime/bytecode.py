"""Bytecode of what is imported, kept where neither pip nor Python has kept it."""

import compileall
import py_compile
import sys
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import mapper


def keep_bytecode() -> None:
    """Write the bytecode of this package, and of all other imported modules that have none.

    pip compiles what it installs, except with ``--no-compile``, and Python what it imports, except with
    PYTHONDONTWRITEBYTECODE, which many containers set. Where neither did, every start would compile a
    thousand modules again. A folder that cannot be written is left as it is.
    """
    for path in (Path(mapper.__file__).parent, *_linked_packages()):
        compileall.compile_dir(path, quiet=2)
    for module in _imported():
        if (missing := _missing_bytecode(module)) is not None:
            source, bytecode = missing
            with suppress(OSError, py_compile.PyCompileError):
                py_compile.compile(source, bytecode, doraise=True, quiet=2)


def has_bytecode(module: ModuleType) -> bool:
    """Return whether a module's next import need not compile it."""
    return _missing_bytecode(module) is None


def _imported() -> list[ModuleType]:
    return list(sys.modules.values())


def _linked_packages() -> list[Path]:
    """Return this package's folders that are links, as in a source tree; ``compileall`` follows none."""
    return [path.resolve() for path in Path(mapper.__file__).parent.iterdir() if path.is_symlink()]


def _missing_bytecode(module: ModuleType) -> tuple[str, str] | None:
    """Return the files of a module's source and bytecode if it has the former only."""
    spec = getattr(module, "__spec__", None)
    if spec is None or spec.cached is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    return None if Path(spec.cached).exists() else (spec.origin, spec.cached)
