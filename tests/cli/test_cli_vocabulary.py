"""``mapper vocabulary`` from the command line."""

import pytest

from mapper.places.vocabulary import load_vocabulary
from tests.support.command_line import mapper

SMALL = ["--frames", "6", "--set", "branching=4", "--set", "levels=2", "--set", "detector.max_features=200"]


def test_training_on_logs_gives_the_same_file_again(desk_log, tmp_path):
    result = mapper("vocabulary", "train", desk_log, desk_log, "--out", tmp_path / "a.words", *SMALL)
    again = mapper(
        "vocabulary", "train", desk_log, desk_log, "--out", tmp_path / "b.words", *SMALL, "--quiet"
    )

    assert again.output == ""
    assert (tmp_path / "a.words").read_bytes() == (tmp_path / "b.words").read_bytes()
    assert "a.words: 16 words, 4 × 2 levels, 1 kB" in result.stdout
    assert "trained on 12 images of desk, desk" in result.stdout
    assert "detect: 6/6" in result.stderr
    assert load_vocabulary(tmp_path / "a.words").words == 16


def test_show_without_a_file_shows_the_shipped_one():
    shown = mapper("vocabulary", "show").stdout
    assert "orb.words: 2197 words, 13 × 3 levels" in shown
    assert "synthetic flats" in shown


def test_an_existing_file_is_replaced_only_when_told(desk_log, tmp_path):
    out = tmp_path / "mine.words"
    out.write_text("precious")
    train = ["vocabulary", "train", desk_log, "--out", out, *SMALL]

    refused = mapper(*train, status=1)

    assert (
        "mine.words: exists already; choose another --out, or pass --overwrite to replace it"
        in refused.stderr
    )
    assert out.read_text() == "precious"
    mapper(*train, "--overwrite", "--quiet")
    assert load_vocabulary(out).words == 16


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--frames", "1"], "nothing to train on: 1 images have features, want at least 2"),
        (["--frames", "0"], "frames_per_log: want more than 0"),
        (["--set", "detector.kind=akaze"], "want one of orb, uniform-orb"),
        (["--set", "branching=1"], "branching: want at least 2"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_file(desk_log, tmp_path, extra, message):
    result = mapper(
        "vocabulary", "train", desk_log, "--out", tmp_path / "v.words", "--quiet", *extra, status=1
    )

    assert result.stderr.startswith("mapper: ")
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
    refused = mapper("vocabulary", "train", desk_log, tmp_path / "none", "--out", tmp_path / "v", status=1)
    assert refused.stderr == f"mapper: {tmp_path / 'none'}: no such file or folder\n"  # before any work


def test_frames_that_cannot_be_read_are_noted_and_left_out(tiny_tum_log, tmp_path):
    log = tiny_tum_log(8)
    sorted((log / "rgb").iterdir())[3].write_bytes(b"no image")

    result = mapper("vocabulary", "train", log, "--out", tmp_path / "v.words")

    assert "not an image of a known format (8 bytes)" in result.stderr
    assert "trained on 7 images of log" in result.stdout
