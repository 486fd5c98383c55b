import pytest

from mapper.runtime.regular_files import parse_toml

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
