"""Damage: what disks, networks, dying recorders and hostile people do to files."""

import os
import re
import stat
import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

Rng = np.random.Generator

_INTEGERS = (
    *(0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 999_999_999, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40),
    *((1 << 63) - 1,),
)
_TEXTS = (
    *(b"0", b"-1", b"1e400", b"-1e308", b"1e-320", b"nan", b"inf", b"999999999", b"0x10", b"1" * 5000),
    *(b"", b"x", b"\0", b"\xff\xfe", "½".encode(), b"[" * 5000),
    *(b"/dev/zero", b"/etc/passwd", b"../../../../etc/passwd"),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"\S+")
_SPARSE_BYTES = 6 << 30


def _truncate(data: bytes, rng: Rng) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _end_lost(data: bytes, rng: Rng) -> bytes:
    return data[: max(len(data) - int(rng.integers(1, 200)), 0)]


def _flip_bits(data: bytes, rng: Rng) -> bytes:
    damaged = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 2, 8, 64]))):
        damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def _overwrite(data: bytes, rng: Rng) -> bytes:
    at, length = int(rng.integers(len(data))), int(rng.choice([1, 4, 16, 512, 4096]))
    length = min(length, len(data) - at)
    fill = (bytes(length), b"\xff" * length, rng.bytes(length))[rng.integers(3)]
    return data[:at] + fill + data[at + length :]


def _repeat_block(data: bytes, rng: Rng) -> bytes:
    begin, end = np.sort(rng.integers(0, len(data) + 1, 2)).tolist()
    return data[:end] + data[begin:]


def _lose_block(data: bytes, rng: Rng) -> bytes:
    begin, end = np.sort(rng.integers(0, len(data) + 1, 2)).tolist()
    return data[:begin] + data[end:]


def _swap_blocks(data: bytes, rng: Rng) -> bytes:
    a, b, c = np.sort(rng.integers(0, len(data) + 1, 3)).tolist()
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def _hostile_integer(data: bytes, rng: Rng) -> bytes:
    """Overwrite bytes that may be a length with a number; most often near the start or the end."""
    damaged = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 4]))):
        layout = ("<H", "<I", "<Q", ">H", ">I")[rng.integers(5)]
        size = struct.calcsize(layout)
        if len(damaged) < size:
            break
        last = len(damaged) - size
        at = int(
            (rng.integers(last + 1), min(rng.integers(400), last), max(last - rng.integers(400), 0))[
                rng.integers(3)
            ]
        )
        struct.pack_into(layout, damaged, at, _INTEGERS[rng.integers(len(_INTEGERS))] & ((1 << 8 * size) - 1))
    return bytes(damaged)


def _replaced(pattern: re.Pattern[bytes]) -> Callable[[bytes, Rng], bytes]:
    def replace(data: bytes, rng: Rng) -> bytes:
        found = list(pattern.finditer(data[:100_000]))
        if not found:
            return data
        match = found[rng.integers(len(found))]
        return data[: match.start()] + _TEXTS[rng.integers(len(_TEXTS))] + data[match.end() :]

    return replace


def _shuffle_lines(data: bytes, rng: Rng) -> bytes:
    lines = data.split(b"\n")
    rng.shuffle(lines)
    return b"\n".join(lines)


def _append(data: bytes, rng: Rng) -> bytes:
    return data + rng.bytes(int(rng.integers(1, 3000)))


BYTES: Mapping[str, Callable[[bytes, Rng], bytes]] = {
    "truncated": _truncate,
    "end lost": _end_lost,
    "bits flipped": _flip_bits,
    "overwritten": _overwrite,
    "block repeated": _repeat_block,
    "block lost": _lose_block,
    "blocks swapped": _swap_blocks,
    "hostile integer": _hostile_integer,
    "hostile number": _replaced(_NUMBER),
    "hostile word": _replaced(_WORD),
    "lines shuffled": _shuffle_lines,
    "garbage appended": _append,
    "random": lambda data, rng: rng.bytes(len(data)),
    "zeros": lambda data, _: bytes(len(data)),
    "empty": lambda _data, _rng: b"",
}
"""Damage to a file's bytes, of which there is one at least."""


def _is_whole(path: Path) -> bool:
    """Return whether no damage to the file as a whole came before; what is written must not follow a link."""
    status = path.lstat()
    return stat.S_ISREG(status.st_mode) and status.st_size < _SPARSE_BYTES


def _other_file(path: Path, rng: Rng) -> None:
    others = sorted(other for other in path.parent.rglob("*") if _is_whole(other))
    path.write_bytes(others[rng.integers(len(others))].read_bytes())


def _pipe(path: Path, _rng: Rng) -> None:
    path.unlink()
    os.mkfifo(path)


def _link(path: Path, rng: Rng) -> None:
    path.unlink()
    path.symlink_to(("/dev/zero", "/proc/version", path.name, "nowhere")[rng.integers(4)])


def _folder(path: Path, _rng: Rng) -> None:
    path.unlink()
    path.mkdir()


def _hole(path: Path, _rng: Rng) -> None:
    with path.open("r+b") as file:
        file.truncate(_SPARSE_BYTES)


FILES: Mapping[str, Callable[[Path, Rng], None]] = {
    "lost": lambda path, _: path.unlink(),
    "another file": _other_file,
    "a pipe": _pipe,
    "a link": _link,
    "a folder": _folder,
    "followed by a hole": _hole,
}
"""Damage to a file as a whole."""

KINDS = (*BYTES, *FILES)


def damage(folder: Path, kind: str, rng: Rng) -> str:
    """Damage one file of a folder and return its name; text files of a log as often as its many images."""
    files = sorted(path for path in folder.rglob("*") if _is_whole(path))
    if not files:
        return "nothing"
    by_ending: dict[str, list[Path]] = {}
    for path in files:
        by_ending.setdefault(path.suffix, []).append(path)
    same = by_ending[sorted(by_ending)[rng.integers(len(by_ending))]]
    path = same[rng.integers(len(same))]
    if kind in FILES:
        FILES[kind](path, rng)
    else:
        data = path.read_bytes()
        path.write_bytes(BYTES[kind](data, rng) if data else data)
    return str(path.relative_to(folder))
