"""Finding a paper's sequences by whatever name people give them, and the papers' figures."""

import pytest

from mapper.core.errors import ConfigError, SourceError
from mapper.evaluators.papers.paper import figures, find_sequences, published

NAMES = ["fr1/xyz", "fr1/desk", "fr1/desk2", "fr3/long_office", "fr2/pioneer_slam", "Poznań/trajectory1"]


@pytest.mark.parametrize(
    ("called", "name"),
    [
        ("rgbd_dataset_freiburg1_xyz", "fr1/xyz"),
        ("freiburg1_xyz", "fr1/xyz"),
        ("fr1_xyz", "fr1/xyz"),
        ("tum_fr1_xyz", "fr1/xyz"),
        ("FR1-XYZ", "fr1/xyz"),
        ("fr1_desk2", "fr1/desk2"),
        ("rgbd_dataset_freiburg3_long_office_household", "fr3/long_office"),
        ("freiburg2_pioneer_slam", "fr2/pioneer_slam"),
        ("trajectory1", "Poznań/trajectory1"),
    ],
)
def test_a_sequence_is_known_by_each_of_its_names(tmp_path, called, name):
    (tmp_path / "more" / called).mkdir(parents=True)

    assert find_sequences(tmp_path, NAMES, {}).logs == {name: tmp_path / "more" / called}
    assert find_sequences(tmp_path / "more" / called, NAMES, {}).logs == {name: tmp_path / "more" / called}


@pytest.mark.parametrize(
    "called",
    [
        "rgbd_dataset_freiburg3_long_office_household_validation",
        "fr2_pioneer_slam4",
        "fr2_xyz",
        "fr1_xyz_run",
        "xyz",
    ],
)
def test_another_sequence_is_not_taken_for_it(tmp_path, called):
    (tmp_path / called).mkdir()

    with pytest.raises(SourceError, match=r"none of the sequences.*rgbd_dataset_freiburg1_xyz.*--log"):
        find_sequences(tmp_path, NAMES, {})


def test_recordings_are_logs_and_other_files_are_not(tmp_path):
    (tmp_path / "freiburg1_xyz.bag").touch()
    (tmp_path / "freiburg1_desk.txt").touch()

    found = find_sequences(tmp_path, NAMES, {})

    assert found.logs == {"fr1/xyz": tmp_path / "freiburg1_xyz.bag"}
    assert found.missing == ("fr1/desk", "fr1/desk2", "fr3/long_office", "fr2/pioneer_slam", NAMES[-1])


def test_of_two_the_first_is_used_and_told(tmp_path):
    (tmp_path / "fr1_xyz").mkdir()
    (tmp_path / "freiburg1_xyz.mcap").touch()

    found = find_sequences(tmp_path, NAMES, {})

    assert found.logs["fr1/xyz"] == tmp_path / "fr1_xyz"
    assert found.notes == (
        f"fr1/xyz is there twice: {tmp_path / 'fr1_xyz'} is used, not {tmp_path / 'freiburg1_xyz.mcap'}",
    )


def test_a_log_may_be_named(tmp_path):
    (tmp_path / "odd").mkdir()
    (tmp_path / "fr1_xyz").mkdir()

    found = find_sequences(tmp_path, NAMES, {"fr1/desk": tmp_path / "odd", "fr1/xyz": tmp_path / "odd"})

    assert found.logs == {"fr1/xyz": tmp_path / "odd", "fr1/desk": tmp_path / "odd"}
    assert found.notes == ()


def test_mistakes_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"fr9/xyz.*no sequence of the paper; it has fr1/xyz"):
        find_sequences(tmp_path, NAMES, {"fr9/xyz": tmp_path})
    with pytest.raises(ConfigError, match="no such file"):
        find_sequences(tmp_path, NAMES, {"fr1/xyz": tmp_path / "none"})
    with pytest.raises(SourceError, match="no such file"):
        find_sequences(tmp_path / "none", NAMES, {})


def test_every_table_names_its_source():
    assert all(table["source"] for name, table in published().items() if name != "_note")
    assert published()["isvd_previous_frames"]["rows"]["fr1/xyz"] == [0.0216, 0.0198, 0.0197, 0.0232, 0.0236]


def test_a_table_can_be_turned_on_its_side():
    as_printed = figures("isvd_iterations")
    turned = figures("isvd_iterations", rows="the columns")

    assert as_printed["auto"]["fr1/rpy"] == turned["fr1/rpy"]["auto"] == 0.04999
    assert list(turned) == ["fr1/xyz", "fr2/pioneer_slam", "fr1/rpy", "fr1/desk"]
    assert len(turned["fr1/desk"]) == 12
