"""Records as Parquet, for programs that read tables of many rows."""

from collections.abc import Sequence
from pathlib import Path

from mapper.evaluators.tables.table import Record
from mapper.runtime.atomic import atomic_file
from mapper.runtime.extras import extra


def write_parquet(path: Path, records: Sequence[Record]) -> None:
    """Write records, whole or not at all: text, whole numbers and numbers as columns of their type.

    A column without any value is one of numbers.

    Args:
        path: File to write.
        records: One or more, all with the first one's names.
    """
    with extra("study", path.name):
        import pyarrow as pa  # takes a second
        from pyarrow import parquet

    columns = {}
    for name in records[0]:
        values = [record[name] for record in records]
        kinds = {type(value) for value in values if value is not None}
        if kinds <= {str} and kinds:
            kind = pa.string()
        elif kinds <= {int} and kinds:
            kind = pa.int64()
        else:
            kind = pa.float64()
        columns[name] = pa.array(values, kind)
    with atomic_file(path) as part:
        parquet.write_table(pa.table(columns), part)
