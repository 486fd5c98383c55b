"""Data of an archive: written once, read again as it was, and in memory only while it was used last."""

import numpy as np
import pytest

from mapper.features.frame_view import ImageView
from mapper.loops.scan_context_proposer import ScanPlace
from mapper.runtime.archive import Archive, size_of
from mapper.runtime.archived import Archived, ArchivedMapping, archived, reference_of
from mapper.runtime.journal import Journal


def points(number):
    rng = np.random.default_rng(number)
    return ScanPlace(number, rng.normal(size=(100, 3)).astype(np.float32), np.eye(4))


def written(archive, journal, *data):
    """Archive data, write the journal, and release it from memory; return the references."""
    references = [archived(part) for part in data]
    for reference in references:
        archive.place_of(reference)
    journal.write(journal.take())
    archive.release(archive.take())
    return references


@pytest.fixture
def journal(tmp_path):
    return Journal(tmp_path / "journal")


def test_data_has_one_reference():
    data = points(1)
    assert reference_of(data) is None
    assert archived(data) is archived(data) is reference_of(data)
    assert archived(data).data is data
    assert archived("text, which cannot be archived").data == "text, which cannot be archived"


def test_data_that_was_not_used_for_long_comes_from_the_disk(journal):
    data = [points(number) for number in range(4)]
    archive = Archive(journal, recent_bytes=2 * size_of(data[0]))
    references = written(archive, journal, *data)
    assert [references[k].data is data[k] for k in (3, 2, 1, 0)] == [True, True, False, False]
    for reference, part in zip(references, data, strict=True):
        np.testing.assert_array_equal(reference.data.points_body, part.points_body)
        assert archived(reference.data) is reference
    assert references[3].data is references[3].data
    assert references[0].data is references[0].data  # it was used last, and so is in memory again


def test_nothing_is_released_before_it_is_on_the_disk(journal):
    archive = Archive(journal, recent_bytes=0)
    data = points(1)
    reference = archived(data)
    archive.place_of(reference)
    assert reference.data is data
    journal.write(journal.take())
    assert reference.data is data
    archive.release(archive.take())
    assert len(archive.take()) == 0


def test_data_is_written_once_though_other_data_refers_to_it(journal):
    archive = Archive(journal, recent_bytes=0)
    known = points(1)
    (of_points,) = written(archive, journal, known)
    before = journal.end
    (reference,) = written(archive, journal, (known, "and more"))
    assert journal.end - before < 300 < known.points_body.nbytes
    assert archive.place_of(of_points) == 0
    archive.read(of_points)  # drives the other out of memory
    assert archived(reference.data[0]) is of_points


def test_another_process_finds_the_data(journal):
    (reference,) = written(Archive(journal), journal, points(1))
    again = Journal(journal.path, journal.end)
    found = Archive(again).at(reference.place)
    np.testing.assert_array_equal(found.data.points_body, points(1).points_body)


def test_a_file_that_is_deleted_meanwhile_is_still_read(journal):
    archive = Archive(journal, recent_bytes=0)
    first, _ = written(archive, journal, points(1), points(2))
    journal.path.unlink()
    assert first.data.stamp_ns == 1


def test_a_mapping_reads_a_value_when_it_is_asked_for():
    asked = []

    class Reader:
        def read(self, reference):
            asked.append(reference.place)
            return f"data at {reference.place}"

    mapping = ArchivedMapping({5: Archived(None, reader=Reader(), place=50), 3: Archived("in memory")})
    assert list(mapping) == [5, 3]
    assert len(mapping) == 2
    assert 5 in mapping
    assert 4 not in mapping
    assert asked == []
    assert mapping[5] == "data at 50"
    assert mapping[3] == "in memory"
    assert asked == [50]


def test_the_size_counts_every_array_once():
    data = points(1)
    assert size_of(data) == data.points_body.nbytes + data.T_level_body.nbytes
    one = np.zeros((5, 3))
    assert size_of(ImageView(0, *[one] * 6)) == one.nbytes
    assert size_of(3) == 0
