"""CSV files of a run: rows below the names of their columns, written whole."""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from mapper.core.errors import DataError, RunError
from mapper.runtime.atomic import write_text
from mapper.runtime.regular_files import read_text

Read = TypeVar("Read")


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Write rows below the names of their columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text(path, text.getvalue())


def read_csv(
    path: Path, columns: Sequence[str], read: Callable[[Iterable[Mapping[str, str]]], Read], *, of: str
) -> Read:
    """Return what a function makes of the rows, each a text by its column's name.

    Raises:
        RunError: The file cannot be read.
        DataError: It lists something else: a KeyError, ValueError, TypeError or DataError was raised.
    """
    text = read_text(path, error=RunError)
    try:
        return read(csv.DictReader(io.StringIO(text)))
    except (KeyError, ValueError, TypeError, csv.Error, DataError) as error:
        raise DataError(f"{path}: not a list of {of} with columns {', '.join(columns)}: {error}") from None
