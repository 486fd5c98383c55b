import pytest

from mapper.runtime.atomic import atomic_file, write_bytes, write_text


def test_a_file_appears_whole_with_its_folders(tmp_path):
    path = tmp_path / "a/b/c.txt"
    write_text(path, "Poznań\n")
    assert path.read_bytes() == "Poznań\n".encode()
    write_bytes(path, b"\x00\x01")
    assert path.read_bytes() == b"\x00\x01"
    assert [p.name for p in path.parent.iterdir()] == ["c.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "map.bt"
    path.write_text("old")

    def write_half(part):
        part.write_text("ha")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), atomic_file(path) as part:
        write_half(part)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_old_file_stays_readable_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "map.png"
    path.write_text("old")
    with atomic_file(path) as part:
        assert part.suffix == ".png", "writers choose the format by the ending"
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
