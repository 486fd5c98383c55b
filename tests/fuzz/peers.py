"""Peers: other programs' readers of the same formats, to compare what they refuse with what ours does."""

from collections.abc import Callable, Mapping
from pathlib import Path

from mapper.sources.ros.typestore import typestore


class RefusedError(Exception):
    """A peer that reports no error has read nothing."""


def _octomap(path: str) -> str:
    import pyoctomap

    tree = pyoctomap.ColorOcTree(0.1).read(path) if path.endswith(".ot") else pyoctomap.OcTree(0.1)
    if tree is None or (path.endswith(".bt") and not tree.readBinary(path)):
        raise RefusedError
    return ""


def _mcap(path: str) -> str:
    from mcap.reader import make_reader

    with Path(path).open("rb") as file:
        for _ in make_reader(file, validate_crcs=True).iter_messages():
            pass
    return ""


def _rosbags(path: str) -> str:
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(path)], default_typestore=typestore("cdr")) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    return ""


def _each(ending: str, read: Callable[[Path], object]) -> Callable[[str], str]:
    def read_all(folder: str) -> str:
        for path in sorted(Path(folder).glob(f"*{ending}")):
            read(path)
        return ""

    return read_all


def _plyfile(path: Path) -> None:
    from plyfile import PlyData

    PlyData.read(path)


def _laspy(path: Path) -> None:
    import laspy

    laspy.read(path)


PEERS: Mapping[str, Callable[[str], str]] = {
    "OctoMap": _octomap,
    "mcap": _mcap,
    "rosbags": _rosbags,
    "plyfile": _each(".ply", _plyfile),
    "laspy": _each(".la?", _laspy),
}
"""Readers, which raise whatever they like."""

PEER_OF: Mapping[str, str] = {
    "map.ot": "OctoMap",
    "map.bt": "OctoMap",
    "mcap": "mcap",
    "mcap, plain": "mcap",
    "mcap, zstd": "mcap",
    "mcap, unchunked": "mcap",
    "bag": "rosbags",
    "bag, bz2": "rosbags",
    "rosbag2": "rosbags",
    "clouds, ply": "plyfile",
    "clouds, las": "laspy",
    "clouds, laz": "laspy",
}
"""The peer of a format of the corpus."""
