"""Completion of the command line in bash, zsh and fish: verbs, options, runs, settings and their choices.

The shell's script calls ``mapper`` again with ``_MAPPER_COMPLETE`` set, which prints a candidate a line, and
after a tab what it means. Without candidates the shell completes files.
"""

import os
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mapper.core.errors import ConfigError

ASKED_BY = "_MAPPER_COMPLETE"
"""Environment variable that holds the shell's name."""
LINE = "_MAPPER_LINE"
"""Environment variable with the line up to the cursor, from bash, which itself splits words at ``=`` too."""

_BASH = f"""\
_mapper_completion() {{
    local IFS=$'\\n' candidate
    COMPREPLY=($({ASKED_BY}=bash {LINE}="${{COMP_LINE:0:COMP_POINT}}" "$1" 2>/dev/null))
    for candidate in "${{COMPREPLY[@]}}"; do
        [[ $candidate == *[=/.] ]] && compopt -o nospace
    done
    return 0
}}
complete -o default -F _mapper_completion mapper
"""

_ZSH = f"""\
#compdef mapper
_mapper() {{
    local -a lines whole begun
    local line value
    local before=("${{(@Q)words[2,CURRENT-1]}}")
    lines=("${{(@f)$({ASKED_BY}=zsh "${{words[1]}}" "${{before[@]}}" "${{(Q)PREFIX}}" 2>/dev/null)}}")
    for line in $lines; do
        value="${{line%%$'\\t'*}}"
        value="${{value//:/\\\\:}}"
        [[ $line == *$'\\t'* ]] && line="$value:${{line#*$'\\t'}}" || line="$value"
        [[ $value == *[=/.] ]] && begun+=("$line") || whole+=("$line")
    done
    if (( $#whole + $#begun == 0 )); then
        _files
        return
    fi
    (( $#whole )) && _describe -V value whole
    (( $#begun )) && _describe -V value begun -S ''
}}
if ! (( $+functions[compdef] )); then
    autoload -Uz compinit && compinit
fi
compdef _mapper mapper
"""

_FISH = f"""\
function _mapper_candidates
    set -l words (commandline -opc)
    set -l current (commandline -ct)
    set -l found (env {ASKED_BY}=fish $words[1] $words[2..-1] "$current" 2>/dev/null)
    if test (count $found) -gt 0
        printf '%s\\n' $found
    else
        __fish_complete_path "$current"
    end
end
complete --command mapper --no-files --keep-order --arguments '(_mapper_candidates)'
"""

SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}


def answer(command: Any) -> None:
    """Print the shell's completion candidates.

    Args:
        command: The program, as Typer runs it.
    """
    if os.environ[ASKED_BY] == "bash":
        words = words_of(os.environ.get(LINE, ""))
        cut = _kept_by_bash(words[-1])
        values = [value[cut:] for value, _ in candidates(command, words[1:])]
        print("\n".join(value if cut else re.sub(r"([^\w@%+=:,./~-])", r"\\\1", value) for value in values))
        return
    for value, meaning in candidates(command, sys.argv[1:] or [""]):
        print(f"{value}\t{' '.join(meaning.split())}" if meaning else value)


def candidates(command: Any, words: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield what the last word may become, and what each means.

    Args:
        command: The program, as Typer runs it.
        words: After the program's name; the last is being written.
    """
    from typer._completion_classes import BashComplete  # only it can parse a command line

    *before, word = words
    for item in BashComplete(command, {}, "mapper", ASKED_BY).get_completions(before, word):
        yield str(item.value), item.help or ""


def words_of(line: str) -> list[str]:
    """Return the words of an unfinished command line; the last is empty after a space."""
    for end in ("", '"', "'"):  # a quotation that is still open
        try:
            words = shlex.split(line + end)
        except ValueError:
            continue
        is_begun = bool(line) and (end != "" or not line[-1].isspace())
        return words if is_begun and words else [*words, ""]
    return [*line.split(" ")]


def _kept_by_bash(word: str) -> int:
    """Return how much of a word stands before what bash replaces: it splits at ``=`` and ``:``."""
    return 1 + max(word.rfind("="), word.rfind(":"))


def run_folders(incomplete: str) -> list[tuple[str, str]]:
    """Return the run folders whose paths begin so, below folders here too; or else the folders."""
    base, _, begin = incomplete.rpartition("/")
    base = f"{base}/" if incomplete.startswith("/") or base else ""
    runs, others = [], []
    for folder in _folders(Path(base or "."), begin):
        path = f"{base}{folder.name}"
        if _is_run(folder):
            runs.append((path, ""))
            continue
        below = [] if base else [child for child in _folders(folder, "") if _is_run(child)]
        runs += [(f"{path}/{child.name}", "") for child in below]
        others.append((f"{path}/", ""))
    return runs or others


def _folders(place: Path, begin: str) -> list[Path]:
    try:
        return sorted(
            child
            for child in place.expanduser().iterdir()
            if child.name.startswith(begin) and not child.name.startswith(".") and child.is_dir()
        )
    except OSError:
        return []


def _is_run(folder: Path) -> bool:
    return (folder / "manifest.json").is_file() and not folder.name.endswith(".partial")


def assignments_to(incomplete: str) -> list[tuple[str, str]]:
    """Return the settings that begin so, table by table, and after ``=`` the choices of one."""
    key, equals, _ = incomplete.partition("=")
    if equals:
        return [
            (f"{key}={choice}", "") for name, _, choices in _settings() for choice in choices if name == key
        ]
    return [
        (name if name.endswith(".") else f"{name}=", meaning) for name, meaning in setting_keys(incomplete)
    ]


def setting_keys(incomplete: str) -> list[tuple[str, str]]:
    """Return the settings that begin so; of a table whose name is not yet whole, only that."""
    depth = incomplete.count(".")
    found: dict[str, str] = {}
    for name, meaning, _ in _settings():
        parts = name.split(".")
        if name.startswith(incomplete):
            is_table = len(parts) > depth + 1
            found.setdefault(
                ".".join(parts[: depth + 1]) + ("." if is_table else ""), "" if is_table else meaning
            )
    return list(found.items())


def export_kinds() -> list[tuple[str, str]]:
    """Return what ``mapper export`` writes."""
    from mapper.export.exporters import EXPORTERS

    return [(kind, exporter.summary) for kind, exporter in EXPORTERS.items()]


def _settings() -> Iterator[tuple[str, str, Sequence[str]]]:
    """Yield name, meaning and choices of every setting."""
    from mapper.config.describe import settings

    for each in settings():
        if not each.is_table:
            yield each.key, each.doc.partition(". ")[0], each.choices


def detected_shell() -> str:
    """Return the name of the shell that called, or else that of ``$SHELL``.

    Raises:
        ConfigError: It is none of ours.
    """
    import shellingham  # type: ignore[import-untyped]

    try:
        name = str(shellingham.detect_shell()[0])
    except shellingham.ShellDetectionFailure:
        name = Path(os.environ.get("SHELL", "")).name
    if name not in SCRIPTS:
        raise ConfigError(
            f"shell {name or '(none)'}: no completion for it; choose one with --shell bash, zsh or fish"
        )
    return name


def install(shell: str) -> Path:
    """Write the shell's script, make new shells read it, and return its path."""
    from mapper.runtime.atomic import write_text

    home = Path.home()
    if shell == "fish":
        configuration = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
        path = configuration / "fish" / "completions" / "mapper.fish"
    else:
        data = Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share")
        path = data / "mapper" / f"completion.{shell}"
    write_text(path, SCRIPTS[shell])
    if shell != "fish":  # which looks there by itself
        start = Path(os.environ.get("ZDOTDIR") or home) / ".zshrc" if shell == "zsh" else home / ".bashrc"
        line = f"source {shlex.quote(str(path))}"
        text = start.read_text(encoding="utf-8") if start.exists() else ""
        if line not in text.splitlines():
            with start.open("a", encoding="utf-8") as file:
                file.write(f"{'' if text.endswith(chr(10)) or not text else chr(10)}{line}\n")
    return path
