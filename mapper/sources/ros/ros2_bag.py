"""ROS 2 bags read as recordings: .db3 files (SQLite), and folders of files in sequence."""

import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.runtime.regular_files import MOST_BYTES
from mapper.sources.ros.recording import Place, Recorded, Recording, Topic, ros2_name

_MOST_EARLY_SHARE = 0.1
"""Share of a file's messages that may be older than the last of the files before it: latched ones repeat."""


class DatabaseRecording:
    """Recording in a .db3 file; the place of a message is its row. See :class:`Recording`."""

    kind = "rosbag2"

    def __init__(self, path: Path) -> None:
        """Read the list of topics.

        Raises:
            SourceError: The file is no SQLite database of rosbag2, or cannot be read.
        """
        self.path = path
        self.notes: list[str] = []
        try:
            with closing(self._connect()) as database:
                _check_tables(database)
                rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except (sqlite3.Error, UnicodeDecodeError, DataError) as error:  # SQLite's text may be damaged too
            reason = " ".join(str(error).split())  # it may quote the table's definition
            raise SourceError(f"{path}: not a .db3 file that rosbag2 wrote: {reason}") from None
        self._topics = {
            number: Topic(texts[0], ros2_name(texts[1]), texts[2])
            for number, *texts in rows
            if all(isinstance(text, str) for text in texts)
        }

    def messages(self) -> Iterator[Recorded]:
        """Yield every message that can be read, in the order of the file."""
        count = 0
        with closing(self._connect()) as database:
            try:
                for row, topic, log_ns, data in database.execute(
                    "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
                ):
                    count += 1
                    if topic in self._topics and isinstance(data, bytes) and isinstance(log_ns, int):
                        place = Place(0, row, len(data))
                        yield Recorded(self._topics[topic], log_ns, place, memoryview(data))
            except (sqlite3.Error, UnicodeDecodeError) as error:
                self.notes.append(
                    f"{self.path.name}: damaged after {count} messages ({error}); read as far as it goes"
                )

    def read(self, place: Place) -> memoryview:
        """Return a message's bytes; safe in any thread.

        Raises:
            FrameError: The file has changed or cannot be read any more.
        """
        try:
            with closing(self._connect()) as database:
                row = database.execute("SELECT data FROM messages WHERE id = ?", [place.offset]).fetchone()
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise FrameError(f"{self.path}: message {place.offset} cannot be read: {error}") from None
        if row is None or not isinstance(row[0], bytes):
            raise FrameError(f"{self.path}: message {place.offset} is not there any more")
        return memoryview(row[0])

    def _connect(self) -> sqlite3.Connection:
        # Immutable: SQLite makes neither a lock nor a journal beside the log. But where a recorder was
        # killed, its journal holds the last messages, and SQLite opens such a database with its journal only.
        has_journal = self.path.with_name(f"{self.path.name}-wal").exists()
        how = "mode=ro" if has_journal else "mode=ro&immutable=1"
        database = sqlite3.connect(f"{self.path.resolve().as_uri()}?{how}", uri=True)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BYTES)
        return database


class JoinedRecording:
    """Recording of one session that was split into files. See :class:`Recording`."""

    def __init__(self, path: Path, parts: Sequence[Recording], *, lost: Sequence[str]) -> None:
        """Join the files of a folder.

        Args:
            path: The folder.
            parts: Its files in the order in which they were recorded.
            lost: Why others cannot be read.
        """
        self.path = path
        self._parts = parts
        self._lost = list(lost)

    @property
    def kind(self) -> str:
        """Return the kind of ROS 2's folders, or of ROS 1's files."""
        return "rosbag" if self._parts[0].kind == "rosbag" else "rosbag2"

    @property
    def notes(self) -> Sequence[str]:
        """Return what was lost, a sentence each."""
        return [*self._lost, *(note for part in self._parts for note in part.notes)]

    def messages(self) -> Iterator[Recorded]:
        """Yield every message that can be read, file by file."""
        ends_ns: dict[str, int] = {}
        for number, part in enumerate(self._parts):
            last_ns = dict(ends_ns)
            count = early = 0
            for message in part.messages():
                name, log_ns = message.topic.name, message.log_ns
                count += 1
                early += log_ns < ends_ns.get(name, log_ns)
                last_ns[name] = max(log_ns, last_ns.get(name, log_ns))
                block = message.place.block * len(self._parts) + number
                yield message._replace(place=message.place._replace(block=block))
            if early > _MOST_EARLY_SHARE * count:
                self._lost.append(
                    f"{part.path.name}: {early} of {count} messages were recorded before the files before it "
                    "end, with topics of the same names; if it is a recording of its own, open it alone"
                )
            ends_ns = last_ns

    def read(self, place: Place) -> memoryview:
        """Return a message's bytes; safe in any thread.

        Raises:
            FrameError: As of the file that it lies in.
        """
        block, number = divmod(place.block, len(self._parts))
        return self._parts[number].read(place._replace(block=block))


def _check_tables(database: sqlite3.Connection) -> None:
    """Refuse views and columns that are computed: their rows are not in the file, and may never end.

    Raises:
        DataError: The topics or the messages are no table of stored values.
    """
    for name in ("topics", "messages"):
        kinds = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", [name]).fetchall()
        if [kind for kind, _ in kinds] != ["table"] or not f"{kinds[0][1]}".startswith("CREATE TABLE"):
            raise DataError(f"{name} is no table")
        hidden = [row[1] for row in database.execute(f"PRAGMA table_xinfo({name})") if row[6]]
        if hidden:
            raise DataError(f"column {hidden[0]} of {name} is computed")


def in_sequence(paths: Sequence[Path]) -> list[Path]:
    """Return files in the order of the numbers in their names: log_2.db3 before log_10.db3."""
    return sorted(paths, key=lambda path: [int(word) for word in re.findall(r"\d+", path.stem)])
