"""Visual words: trained, weighed, compared, kept in files."""

import struct
import zlib

import numpy as np
import pytest

from mapper.core.errors import DataError, VocabularyError
from mapper.core.frames import Scan
from mapper.places.config import VocabularyConfig
from mapper.places.training import descriptors_of, grow, train
from mapper.places.vocabulary import ONE, Vocabulary, WordTree, load_vocabulary
from tests.support.descriptors import noisy, random_bits
from tests.support.logs import log_in_memory, memory_entry

SMALL = VocabularyConfig(branching=4, levels=3)


@pytest.fixture(scope="module")
def images():
    """Eight images that show 60 of the same 120 things each, never quite alike."""
    rng = np.random.default_rng(0)
    things = random_bits(rng, 120)
    return [noisy(things[rng.permutation(120)[:60]], 12, rng) for _ in range(8)]


@pytest.fixture(scope="module")
def vocabulary(images):
    return train(images, config=SMALL, trained_on="things", rng=np.random.default_rng(1))


def test_clusters_that_are_there_are_found():
    rng = np.random.default_rng(2)
    things = random_bits(rng, 5)
    copies = noisy(np.repeat(things, 40, axis=0), 15, rng)

    tree = grow(copies, config=VocabularyConfig(branching=5, levels=1), rng=rng)

    words = tree.words_of(copies).reshape(5, 40)
    assert (words == words[:, :1]).all()
    assert len(set(words[:, 0].tolist())) == 5
    # With 40 copies the majority undoes all noise.
    assert (tree.centres[1:][words[:, 0]] == things).all()


def test_a_word_is_the_nearest_child_all_the_way_down(images, vocabulary):
    tree, bits = vocabulary.tree, images[0]
    words = vocabulary.words_of(bits)
    first = 1 + np.cumsum(tree.children, dtype=int) - tree.children
    for row, word in zip(bits, words, strict=True):
        node = 0
        while tree.children[node]:
            siblings = np.arange(first[node], first[node] + tree.children[node])
            node = siblings[np.argmin(np.bitwise_count(tree.centres[siblings] ^ row).sum(axis=1))]
        assert node == tree.leaves[word]


def test_rare_words_weigh_more(images, vocabulary):
    having = sum(np.isin(np.arange(vocabulary.words), vocabulary.words_of(bits)) for bits in images)
    assert having.min() >= 1
    np.testing.assert_allclose(vocabulary.idf, np.log(len(images) / having))


def test_identical_descriptors_end_the_splitting_early():
    bits = np.repeat(random_bits(np.random.default_rng(3), 3), 10, axis=0)
    tree = grow(bits, config=SMALL, rng=np.random.default_rng(0))
    assert tree.children.tolist() == [3, 0, 0, 0]


def test_one_image_is_nothing_to_train_on(images):
    with pytest.raises(VocabularyError, match="nothing to train on: 1 images have features, want at least 2"):
        train([images[0], images[0][:0]], config=SMALL, trained_on="", rng=np.random.default_rng(0))


def test_a_log_without_images_is_refused():
    scans = [memory_entry(i, Scan(i, np.zeros((1, 3), np.float32))) for i in range(3)]
    with pytest.raises(VocabularyError, match="lidar: holds scans without images"):
        descriptors_of(log_in_memory(scans, name="lidar", sensor="lidar"), SMALL)


def test_nodes_are_ancestors_of_words(images, vocabulary):
    words = vocabulary.words_of(images[0])
    by_level = [vocabulary.ancestors_of(words, level=level) for level in range(5)]
    assert (by_level[0] == 0).all()
    assert (by_level[vocabulary.levels] == vocabulary.tree.leaves[words]).all()
    assert (by_level[4] == by_level[3]).all()
    # Descending from the root's children alone gives the nodes of level 1.
    distance = np.bitwise_count(images[0][:, None] ^ vocabulary.tree.centres[None, 1:5]).sum(axis=2)
    assert (by_level[1] == 1 + distance.argmin(axis=1)).all()


def test_a_vector_holds_tf_idf_that_sums_to_one(vocabulary):
    telling = np.flatnonzero(vocabulary.idf > 0)[:2].astype(np.int32)
    vector = vocabulary.vector(telling[[1, 0, 1, 1]])

    expected = vocabulary.idf[telling] * [1, 3]
    assert vector.ids.tolist() == telling.tolist()
    assert vector.weights.sum() == ONE
    np.testing.assert_allclose(vector.weights / ONE, expected / expected.sum(), atol=1 / ONE)


def test_words_that_all_images_have_weigh_nothing(vocabulary):
    mute = Vocabulary(vocabulary.tree, np.zeros(vocabulary.words), "")
    vector = mute.vector(np.array([3, 5, 5], np.int32))
    assert len(vector.ids) == 0


def test_the_same_vocabulary_gives_the_same_bytes(tmp_path, images, vocabulary):
    vocabulary.save(tmp_path / "a.words")
    loaded = load_vocabulary(tmp_path / "a.words")
    loaded.save(tmp_path / "b.words")

    assert (tmp_path / "a.words").read_bytes() == (tmp_path / "b.words").read_bytes()
    assert loaded.trained_on == "things"
    for bits in images:
        assert (loaded.words_of(bits) == vocabulary.words_of(bits)).all()


def test_descriptors_of_another_width_are_refused(vocabulary):
    with pytest.raises(DataError, match=r"descriptors \(7, 8\) of uint64, want \(N, 4\)"):
        vocabulary.words_of(np.zeros((7, 8), np.uint64))
    with pytest.raises(DataError, match="of float32, want"):
        vocabulary.words_of(np.zeros((7, 4), np.float32))


@pytest.mark.parametrize("children", [[], [0, 0], [2, 0], [1, 0, 0], [1, 0, 2, 0]], ids=str)
def test_child_counts_that_make_no_tree_are_refused(children):
    with pytest.raises(DataError, match="do not make one tree"):
        WordTree(np.zeros((len(children), 4), np.uint64), np.array(children, np.uint8))


@pytest.fixture
def saved(tmp_path, vocabulary):
    """The vocabulary's file, with a way to change its bytes."""
    path = tmp_path / "damaged.words"
    vocabulary.save(path)

    def change(edit):
        path.write_bytes(edit(path.read_bytes()))
        return path

    return change


HEAD = 15 + 12


def with_header(data, old, new):
    """Replace text in the header, and make length and checksum right again."""
    magic, (version, head_bytes, _) = data[:15], struct.unpack("<III", data[15:HEAD])
    head = data[HEAD : HEAD + head_bytes].replace(old, new)
    rest = head + data[HEAD + head_bytes :]
    return magic + struct.pack("<III", version, len(head), zlib.crc32(rest)) + rest


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda data: data[:-1], "checksum does not match; it is truncated or damaged"),
        (lambda data: data[:20], "ends inside its header; it is truncated"),
        (lambda data: data[:300] + b"!" + data[301:], "checksum does not match"),
        (lambda data: b"PK" + data, "is not a vocabulary; make one with mapper vocabulary train"),
        (lambda data: data[:0], "is not a vocabulary"),
        (lambda data: data[:15] + b"\x07" + data[16:], "is of version 7, only 1 can be read; train it again"),
        (lambda data: with_header(data, b'"orb"', b'"akaze"'), "has words of akaze descriptors of 32 bytes"),
        (lambda data: with_header(data, b'bytes":32', b'bytes":61'), "descriptors of 61 bytes"),
        (lambda data: with_header(data, b'"words"', b'"wards"'), "does not describe a vocabulary"),
        (lambda data: with_header(data, b'"words":', b'"words":1'), "body does not hold"),
        (lambda data: with_header(data, b'"words":', b'"words":-'), "does not describe a vocabulary"),
        (lambda data: with_header(data, b'"nodes":', b'"nodes":"x","was":'), "does not describe"),
    ],
)
def test_files_that_cannot_be_used_are_refused_in_one_line(saved, edit, message):
    path = saved(edit)
    with pytest.raises(VocabularyError) as caught:
        load_vocabulary(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_the_error_of_a_missing_vocabulary_names_the_command(tmp_path):
    with pytest.raises(VocabularyError, match="No such file or directory; make one with mapper vocabulary"):
        load_vocabulary(tmp_path / "none.words")


def test_the_shipped_vocabulary_is_whole():
    shipped = load_vocabulary()
    assert shipped.words > 2000
    assert "synthetic" in shipped.trained_on
    assert (shipped.tree.depth[shipped.tree.leaves] > 0).all()
