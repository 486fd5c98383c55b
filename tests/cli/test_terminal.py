import io
import os
import signal
import subprocess
import sys
import time

from mapper.cli.console import EscapingStream, escaped
from mapper.run.manifest import read_manifest

MAPPER = [sys.executable, "-c", "from mapper.cli.main import main; main()"]


def test_control_characters_are_shown_not_obeyed():
    assert escaped("a\x1b[31mb\x07\r\x9b2J") == r"a\x1b[31mb\x07\r\x9b2J"
    assert escaped("exe\u202egnp.\u2066") == r"exe\u202egnp.\u2066"
    assert escaped(os.fsdecode(b"caf\xe9")) == r"caf\udce9"
    assert escaped("Poznań →\ttab\nline") == "Poznań →\ttab\nline"
    assert escaped("a\nmapper: all is well", one_line=True) == r"a\nmapper: all is well"


def test_a_stream_escapes_what_is_printed_to_it():
    stream = io.StringIO()
    print("topic \x1b]0;title\x07", file=EscapingStream(stream))
    EscapingStream(stream).writelines(["\x1b", "\n"])
    assert stream.getvalue() == "topic \\x1b]0;title\\x07\n\\x1b\n"
    EscapingStream(stream).write("\x1b[0m")
    assert stream.getvalue().endswith("\n\x1b[0m")


def test_a_name_of_a_log_cannot_write_to_the_terminal(tmp_path):
    name = os.fsencode(tmp_path) + b"/log\x1b[2J\xff\nmapper: fine"
    told = subprocess.run([*MAPPER, "inspect", name], capture_output=True, check=False)
    assert told.returncode == 1
    assert told.stderr.count(b"\n") == 1
    assert rb"log\x1b[2J\udcff\nmapper: fine: no such" in told.stderr
    assert b"\x1b" not in told.stderr + told.stdout


def test_a_build_that_is_told_to_end_says_so_in_its_manifest(desk_log, tmp_path):
    out = tmp_path / "run"
    build = subprocess.Popen([*MAPPER, "build", desk_log, "--out", out, "--quiet"], stderr=subprocess.PIPE)
    manifest = tmp_path / "run.partial/manifest.json"
    while not manifest.exists() and build.poll() is None:
        time.sleep(0.01)
    time.sleep(0.2)
    build.send_signal(signal.SIGTERM)
    _, told = build.communicate()

    assert build.returncode == 143
    assert told.count(b"\n") == 1, told
    assert b"what there is so far stays in" in told
    assert read_manifest(manifest).status == "interrupted"
    assert not out.exists()


def test_a_closed_standard_output_is_no_error():
    told = subprocess.run(
        ["sh", "-c", '"$@" >&-', "sh", *MAPPER, "--version"], capture_output=True, check=False
    )
    assert (told.returncode, told.stderr) == (0, b"")
