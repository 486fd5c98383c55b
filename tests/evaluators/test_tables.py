"""Tables as text, Markdown and CSV."""

from mapper.evaluators.study.table import Column, csv_text, markdown_table, text_table

COLUMNS = (
    Column("name", "name"),
    Column("error_m", "error cm", lambda m: f"{100 * m:.1f}"),
    Column("n", "n"),
)
RECORDS = [
    {"name": "one, | first", "error_m": 0.1 + 0.2, "n": 7},
    {"name": "two", "error_m": None, "n": 12},
]


def test_text_is_aligned_and_says_what_is_not_known():
    assert text_table(COLUMNS, RECORDS).splitlines() == [
        "name          error cm   n",
        "one, | first      30.0   7",
        "two                  –  12",
    ]


def test_markdown_has_a_rule_below_its_titles():
    assert markdown_table(COLUMNS, RECORDS).splitlines() == [
        "| name | error cm | n |",
        "| --- | ---: | ---: |",
        r"| one, \| first | 30.0 | 7 |",
        "| two | – | 12 |",
    ]


def test_csv_keeps_every_digit_and_leaves_the_unknown_empty():
    assert csv_text(RECORDS).splitlines() == [
        "name,error_m,n",
        '"one, | first",0.30000000000000004,7',
        "two,,12",
    ]
