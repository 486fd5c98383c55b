"""Vocabulary of visual words, and images as bags of words (Sivic & Zisserman 2003; Nistér & Stewénius 2006).

A vocabulary's file has the layout of ``runtime.checked_file``: a JSON header; then columns: child counts
(uint8) and centres (4 × uint64) of the nodes, weights (float64) of the words.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeInt, ValidationError

from mapper.core.config import Config
from mapper.core.errors import DataError, VocabularyError
from mapper.features.hamming import ORB_BYTES, Bits
from mapper.places.kernels import descend
from mapper.runtime.checked_file import CheckedFormat

Ids = NDArray[np.int32]
"""(N,) int32: words or nodes."""
DESCRIPTOR = "orb"
"""Kind of the descriptors: of detectors "orb" and "uniform-orb"."""
ONE = 32_768
"""Sum of an image's weights."""
_FORMAT = CheckedFormat(b"\x89mapper-words\r\n", version=1, remedy="train it again", error=VocabularyError)
SHIPPED = Path(__file__).with_name("orb.words")
"""Trained on synthetic logs by ``scripts/train_vocabulary.py``."""


@dataclass(frozen=True, eq=False)
class WordTree:
    """k-ary tree: nodes level by level from the root, node 0; siblings are adjacent.

    Attributes:
        centres: (T, 4) uint64 centre of every node; the root's is not used.
        children: (T,) uint8 number of children of each node; those without are the words, in this order.
    """

    centres: Bits
    children: NDArray[np.uint8]

    def __post_init__(self) -> None:
        nodes = len(self.children)
        if self.centres.shape != (nodes, 4) or self.centres.dtype != np.uint64:
            raise DataError(
                f"word tree: {nodes} nodes with centres {self.centres.shape} of {self.centres.dtype}, "
                "want (nodes, 4) of uint64"
            )
        known = 1 + np.cumsum(self.children, dtype=np.int64)  # the root and nodes whose parent came before
        if nodes == 0 or known[-1] != nodes or (known[:-1] <= np.arange(1, nodes)).any():
            raise DataError(f"word tree: the child counts of {nodes} nodes do not make one tree")

    @cached_property
    def leaves(self) -> Ids:
        """(W,) node of every word."""
        return np.flatnonzero(self.children == 0).astype(np.int32)

    @cached_property
    def depth(self) -> NDArray[np.int32]:
        """(T,) number of steps from the root to each node."""
        depth = np.zeros(len(self.children), np.int32)
        for node in range(1, len(depth)):
            depth[node] = depth[self._parent[node]] + 1
        return depth

    @cached_property
    def _parent(self) -> Ids:
        nodes = np.arange(len(self.children), dtype=np.int32)
        return np.concatenate([nodes[:1], np.repeat(nodes, self.children)])

    @cached_property
    def _first_child(self) -> Ids:
        counts = self.children.astype(np.int32)
        return (1 + np.cumsum(counts, dtype=np.int32) - counts).astype(np.int32)

    @cached_property
    def _word(self) -> Ids:
        word = np.full(len(self.children), -1, np.int32)
        word[self.leaves] = np.arange(len(self.leaves), dtype=np.int32)
        return word

    def words_of(self, bits: Bits) -> Ids:
        """Return (N,) the word of each of (N, 4) descriptors.

        Raises:
            DataError: The descriptors are not of 256 bits in four words.
        """
        if bits.ndim != 2 or bits.shape[1] != 4 or bits.dtype != np.uint64:
            raise DataError(f"descriptors {bits.shape} of {bits.dtype}, want (N, 4) of uint64: 256 bits each")
        words: Ids = descend(bits, self.centres, self._first_child, self.children, self._word)
        return words

    def ancestors_of(self, words: Ids, *, level: int) -> Ids:
        """Return (N,) the ancestor of each word ``level`` steps below the root; a shallower word itself."""
        return self._ancestors(level)[words]

    def _ancestors(self, level: int) -> Ids:
        node = self.leaves
        while (deeper := self.depth[node] > level).any():
            node = np.where(deeper, self._parent[node], node)
        return node


class _Header(Config):
    descriptor: str
    descriptor_bytes: NonNegativeInt
    nodes: NonNegativeInt
    words: NonNegativeInt
    trained_on: str


@dataclass(frozen=True, slots=True, eq=False)
class WordVector:
    """Bag of words of an image: the weight of each word, normalised to the sum 1.

    Attributes:
        ids: (M,) int32 ascending words.
        weights: (M,) uint16 positive, in units of 1 / ``ONE``, so that sums are exact in any order. M is 0
            for an image without features.
    """

    ids: Ids
    weights: NDArray[np.uint16]

    def __post_init__(self) -> None:
        if self.ids.ndim != 1 or self.ids.shape != self.weights.shape:
            raise DataError(
                f"word vector: ids {self.ids.shape}, weights {self.weights.shape}, want (M,) both"
            )
        if (self.ids[1:] <= self.ids[:-1]).any():
            raise DataError("word vector: its ids do not ascend; make it with Vocabulary.vector")


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """Words of 256-bit binary descriptors with their weights.

    Attributes:
        tree: Search tree of the words.
        idf: (W,) float64 inverse document frequency ln(N / N_w) of each word.
        trained_on: One line that describes the training images.
    """

    tree: WordTree
    idf: NDArray[np.float64]
    trained_on: str

    def __post_init__(self) -> None:
        words = len(self.tree.leaves)
        if self.idf.shape != (words,):
            raise DataError(f"vocabulary: {self.idf.shape} weights for {words} words")
        if not (np.isfinite(self.idf) & (self.idf >= 0.0)).all():
            raise DataError("vocabulary: a word's weight is negative or not finite")

    @property
    def words(self) -> int:
        """Number of words."""
        return len(self.idf)

    @property
    def levels(self) -> int:
        """Number of steps from the root to the deepest word."""
        return int(self.tree.depth.max())

    def words_of(self, bits: Bits) -> Ids:
        """Return (N,) the word of each of (N, 4) descriptors."""
        return self.tree.words_of(bits)

    def ancestors_of(self, words: Ids, *, level: int) -> Ids:
        """Return (N,) the ancestor of each word ``level`` steps below the root."""
        return self.tree.ancestors_of(words, level=level)

    def vector(self, words: Ids) -> WordVector:
        """Return the tf·idf weights of (N,) words, normalised to the sum 1."""
        ids, counts = np.unique(words, return_counts=True)
        reached = np.cumsum(counts * self.idf[ids])
        total = reached[-1] if len(reached) and reached[-1] > 0.0 else 1.0
        # Rounding the running sum keeps the total exact.
        weights = np.diff(np.rint(ONE * (reached / total)), prepend=0.0).astype(np.uint16)
        positive = weights > 0
        return WordVector(ids[positive].astype(np.int32), weights[positive])

    def save(self, path: Path) -> None:
        """Write a file, atomically; the same vocabulary gives the same bytes."""
        header = _Header(
            descriptor=DESCRIPTOR,
            descriptor_bytes=ORB_BYTES,
            nodes=len(self.tree.children),
            words=self.words,
            trained_on=self.trained_on,
        )
        head = header.model_dump_json().encode()
        columns = self.tree.children, self.tree.centres.astype("<u8"), self.idf.astype("<f8")
        _FORMAT.write(path, head, b"".join(column.tobytes() for column in columns))


def load_vocabulary(path: Path | None = None) -> Vocabulary:
    """Return the vocabulary of a file; None is the one that comes with the toolkit.

    Raises:
        VocabularyError: The file is missing, no vocabulary, damaged, of another version, or of descriptors
            other than ORB's.
    """
    path = path or SHIPPED
    try:
        data = path.read_bytes()
    except OSError as error:
        raise VocabularyError(
            f"{path}: no vocabulary can be read: {error.strerror}; make one with mapper vocabulary train"
        ) from None
    if not data.startswith(_FORMAT.magic):
        raise VocabularyError(f"{path}: is not a vocabulary; make one with mapper vocabulary train")
    return _parsed(path, *_FORMAT.split(path, data))


def _parsed(path: Path, head: bytes, body: memoryview) -> Vocabulary:
    try:
        header = _Header.model_validate_json(head)
    except ValidationError:
        raise VocabularyError(f"{path}: its header does not describe a vocabulary; it is damaged") from None
    if (header.descriptor, header.descriptor_bytes) != (DESCRIPTOR, ORB_BYTES):
        raise VocabularyError(
            f"{path}: has words of {header.descriptor} descriptors of {header.descriptor_bytes} bytes; "
            f"only {DESCRIPTOR}'s of {ORB_BYTES} can be used"
        )
    nodes, words = header.nodes, header.words
    if len(body) != nodes * (1 + ORB_BYTES) + 8 * words:
        raise VocabularyError(
            f"{path}: its body does not hold {nodes} nodes and {words} words; it is damaged"
        )
    children = np.frombuffer(body, np.uint8, nodes).copy()
    centres = np.frombuffer(body, "<u8", 4 * nodes, nodes).reshape(nodes, 4).astype(np.uint64)
    idf = np.frombuffer(body, "<f8", words, nodes * (1 + ORB_BYTES)).astype(np.float64)
    try:
        return Vocabulary(WordTree(centres, children), idf, header.trained_on)
    except DataError as error:
        raise VocabularyError(f"{path}: {error}; it is damaged") from None
