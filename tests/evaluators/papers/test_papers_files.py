import csv
import io
import re

import numpy as np
import pytest

from mapper.core.trajectory import trajectory_from
from mapper.evaluators.papers.files import tables_text, write_reproduction
from mapper.evaluators.papers.model import (
    PaperCell,
    PaperPath,
    PaperTable,
    Reproduction,
    as_printed,
    compared,
    everything,
)
from mapper.evaluators.study.table import Column, latex_table, latex_text, shown_cells
from mapper.sources.trajectory_files import write_tum


def ate_table(name, title, *cells, axis=""):
    return PaperTable(name, title, "a thesis", "ATE RMSE", "m", cells, axis, ("the first 200 frames",))


def scene_table(name, row, published, distances_m, yaws_deg):
    cells = (
        PaperCell(row, "MPD, m", published and published[0], distances_m),
        PaperCell(row, "yaw, °", published and published[1], yaws_deg),
    )
    return PaperTable(name, "scenes", "a paper", "", "", cells)


ITERATIONS = ate_table(
    "Table 5.1",
    "by iterations",
    PaperCell("fr1/xyz", "1", 0.0659, (0.07, 0.05, 0.06)),
    PaperCell("fr1/xyz", "3", 0.042, (0.0503,), ("seed 1: lost",)),
    PaperCell("fr1/xyz", "auto", 0.0204, (), ("seed 0: lost", "seed 1: lost")),
    PaperCell("fr1/desk", "1", 0.17551, ()),
    axis="iterations",
)
METHODS = ate_table(
    "Table 5.5",
    "loops & filter",
    PaperCell("fr1/xyz", "ISVD", 0.02, (0.03, 0.02)),
    PaperCell("fr1/xyz", "ISVD, graph", None, (0.01,)),
)
PRINTED = scene_table("Table 1", "Deák HDL", (0.004, 32.0), (), ())
OURS = scene_table("Table 1, ours", "street", None, (0.0121, 0.0457), (181.0, 90.0))
EMPTY = PaperTable("Table 9", "of no log at hand", "a paper", "ATE RMSE", "m", ())


@pytest.fixture(scope="module")
def reproduction(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("reproduction")
    straight = trajectory_from((i * 10**8, shifted(0.1 * i)) for i in range(20))
    bent = trajectory_from((i * 10**8, shifted(0.1 * i, 0.001 * i)) for i in range(20))
    write_tum(tmp_path / "truth.tum", straight)
    write_tum(tmp_path / "estimate.tum", bent)
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures/pair.png").write_bytes(b"")
    return Reproduction(
        paper="Somlyai: 100 % of ISVD & <LC>",
        tables=(ITERATIONS, METHODS, PRINTED, OURS, EMPTY),
        paths=(PaperPath("fr1/xyz", "ISVD", 0.011, tmp_path / "estimate.tum", tmp_path / "truth.tum"),),
        missing=("fr2/desk",),
        seeds=3,
        notes=("other hardware",),
        pictures=(tmp_path / "pictures/pair.png",),
    )


@pytest.fixture(scope="module")
def written(reproduction):
    folder = reproduction.paths[0].truth.parent
    write_reproduction(folder, reproduction)
    return folder


def rows_of(table):
    return shown_cells(table.columns, table.records)


def shifted(x_m, y_m=0.0):
    T = np.eye(4)
    T[:2, 3] = x_m, y_m
    return T


def test_a_line_tells_printed_ours_spread_ratio_verdict_and_failures():
    shown = compared(ITERATIONS)
    rows = rows_of(shown)
    assert [column.title for column in shown.columns][1:] == (
        ["iterations", "printed", "ours", "spread", "ratio", "verdict", "failed"]
    )
    assert rows[0] == ["fr1/xyz", "1", "0.0659", "0.0600", "0.0500–0.0700", "0.91", "better", "–"]
    assert rows[1] == ["fr1/xyz", "3", "0.0420", "0.0503", "–", "1.20", "worse", "1"]
    assert rows[2] == ["fr1/xyz", "auto", "0.0204", "–", "–", "–", "failed", "2"]
    assert rows[3] == ["fr1/desk", "1", "0.17551", "–", "–", "–", "not run", "–"]  # printed keeps its digits


def test_the_printed_layout_has_a_line_for_each_kind_of_figure():
    assert rows_of(as_printed(ITERATIONS, with_spread=True)) == [
        ["fr1/xyz", "printed", "0.0659", "0.0420", "0.0204"],
        ["", "ours", "0.0600", "0.0503", "–"],
        ["", "lowest", "0.0500", "–", "–"],
        ["", "highest", "0.0700", "–", "–"],
        ["", "ratio", "0.91", "1.20", "–"],
        ["fr1/desk", "printed", "0.17551", "–", "–"],
    ]
    without = as_printed(ITERATIONS, with_spread=False).records
    assert [record["line"] for record in without] == ["printed", "ours", "ratio", "printed"]


def test_columns_of_their_own_units_have_digits_of_their_own():
    assert rows_of(as_printed(OURS, with_spread=False)) == [["street", "0.0289", "136"]]


def test_the_terminal_sees_all_but_no_empty_table(reproduction):
    text = tables_text(reproduction)

    assert "Table 5.1: by iterations; ATE RMSE, m\n" in text
    assert "fr1/xyz, 3 (and 1 more): seed 1: lost" in text
    assert "1 better, 1 worse, 1 failed, 1 not run" in text
    assert "not at hand: fr2/desk" in text
    assert "the median of 3 seeds" in text
    assert "Table 9" not in text
    assert all(len(line) <= 118 for line in text.splitlines())


def test_every_figure_is_in_the_csv_with_all_its_digits(reproduction, written):
    records = list(csv.DictReader(io.StringIO((written / "tables.csv").read_text())))
    assert len(records) == len(everything(reproduction)) == 10
    first = records[0]
    assert (first["published"], first["ours_low"], first["ours_high"], first["seeds"]) == (
        "0.0659", "0.05", "0.07", "3",
    )  # fmt: skip
    assert float(first["ratio"]) == 0.06 / 0.0659
    assert records[2]["ours_median"] == ""
    assert records[2]["failures"] == "seed 0: lost; seed 1: lost"


def test_latex_has_as_many_cells_in_every_line_and_no_bare_signs(written):
    text = (written / "tables.tex").read_text()
    tabulars = re.findall(r"\\begin\{tabular\}\{(lr*)\}\n(.*?)\\end\{tabular\}", text, re.S)
    assert len(tabulars) == text.count(r"\begin{table}") == text.count(r"\end{table}") == 4
    for columns, body in tabulars:
        lines = [line for line in body.splitlines() if not line.endswith("rule")]
        assert all(line.endswith(r" \\") for line in lines)
        assert {len(re.findall(r"(?<!\\)&", line)) for line in lines} == {len(columns) - 1}
    assert not re.search(r"(?<!\\)[%#_](?! \\usepackage)", text)
    assert re.sub(r"\\.", "", text).count("$") % 2 == 0
    assert re.sub(r"\\.", "", text).count("{") == re.sub(r"\\.", "", text).count("}")
    assert r"loops \& filter" in text
    assert r"yaw, $^\circ$" in text
    assert "Deák" in text


def test_latex_text_escapes_what_latex_reads():
    assert latex_text(r"a_b & 5 % #1 {x} ~ ^ \ $") == (
        r"a\_b \& 5 \% \#1 \{x\} \textasciitilde{} \textasciicircum{} \textbackslash{} \$"
    )
    assert latex_text("≥ 3 cm – 10°") == r"$\geq$ 3 cm -- 10$^\circ$"
    table = latex_table([Column("a", "a")], [{"a": "[3]"}, {"a": "*x"}])
    assert "\n[" not in table  # after a line's end it would be its option
    assert "\n*" not in table


def test_the_page_holds_tables_and_plots_and_loads_nothing(written):
    page = (written / "index.html").read_text()
    assert "<h1>Somlyai: 100 % of ISVD &amp; &lt;LC&gt;</h1>" in page
    assert page.count("data:image/png;base64,") == 4
    assert 'href="pictures/pair.png"' in page
    assert not re.search(r'(src|href)="https?:', page)
    names = {path.name for path in written.glob("*.png")}
    assert names == {"Table_5.1.png", "Table_5.5.png", "scenes.png", "trajectories.png"}


def test_the_same_figures_give_the_same_bytes(reproduction, written):
    once = {path.name: path.read_bytes() for path in written.iterdir() if path.is_file()}

    write_reproduction(written, reproduction)

    assert {path.name: path.read_bytes() for path in written.iterdir() if path.is_file()} == once


def test_small_figures_beside_large_ones_keep_their_digits():
    sizes = PaperTable(
        "Table 5", "sizes", "a paper", "file size", "MB",
        (PaperCell("fr1/xyz", "cloud", 7.7, (0.4,)), PaperCell("fr1/xyz", "octree", 0.216, (0.0213,))),
    )  # fmt: skip
    assert [row[3] for row in rows_of(compared(sizes))] == ["0.4", "0.021"]
