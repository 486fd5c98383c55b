import json

import pytest

from mapper.core.errors import DataError
from mapper.evaluators.metrics.metric import (
    Metric,
    exceeded,
    json_text,
    markdown_table,
    records_of,
    text_table,
)

METRICS = [
    Metric("matched poses", 786, "pairs"),
    Metric("ATE RMSE", 0.0134726911, "m"),
    Metric("turn", 0.5, "rad"),
]


def test_a_number_without_unit_or_name_is_refused():
    for name, unit in (("ATE RMSE", ""), ("", "m")):
        with pytest.raises(DataError, match="needs a name and a unit"):
            Metric(name, 1.0, unit)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_could_not_be_measured_is_refused(value):
    with pytest.raises(DataError, match="ATE RMSE"):
        Metric("ATE RMSE", value, "m")


def test_a_terminal_sees_columns_and_degrees():
    assert text_table(METRICS).splitlines() == [
        "matched poses        786 pairs",
        "ATE RMSE       0.0134727 m",
        "turn             28.6479 °",
    ]
    assert text_table([]) == ""


def test_a_report_sees_markdown():
    assert markdown_table(METRICS).splitlines() == [
        "| metric | value | unit |",
        "| --- | ---: | --- |",
        "| matched poses | 786 | pairs |",
        "| ATE RMSE | 0.0134727 | m |",
        "| turn | 28.6479 | ° |",
    ]


def test_a_program_reads_back_every_digit_and_radians():
    read = [(entry["name"], entry["value"], entry["unit"]) for entry in json.loads(json_text(METRICS))]
    assert read == [(metric.name, metric.value, metric.unit) for metric in METRICS]


def test_limits_are_compared_in_the_units_that_people_see():
    records = records_of(METRICS)
    assert exceeded(records, {"ATE": 0.02, "matched": 786.0, "turn": 28.7}) == []
    (sentence,) = exceeded(records, {"turn": 28.6})
    assert "28.6479 °" in sentence
    assert len(exceeded(records, {"ATE RMSE": 0.01, "matched poses": 1.0})) == 2
    with pytest.raises(DataError, match="no metric begins"):
        exceeded(records, {"RPE": 1.0})
