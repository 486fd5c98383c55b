import pytest

from mapper.runtime.regular_files import parse_toml, read_text

DEEP = ".a" * 40_000


@pytest.mark.parametrize(
    "text",
    [
        "a" + ".a" * 40_000 + "=1",
        "[a" + " . a" * 40_000 + "]",
        "x = {a" + ".a" * 40_000 + "=1}",
        "#" * (2 << 20),
    ],
    ids=["key", "table", "inline table", "size"],
)
def test_a_document_that_would_take_gigabytes_is_refused(text):
    with pytest.raises(ValueError, match="at most"):
        parse_toml(text)


def test_what_people_write_is_read():
    text = "a.b.c = [" + ", ".join(["1.5"] * 100) + "]\n[source.camera]\nname = 'v1.2.3'"
    assert parse_toml(text)["a"]["b"]["c"] == [1.5] * 100


def test_a_byte_order_mark_is_no_text(tmp_path):
    (tmp_path / "list.csv").write_bytes("stamp_s,rgb\n".encode("utf-8-sig"))
    assert read_text(tmp_path / "list.csv") == "stamp_s,rgb\n"
