"""The page of ``mapper edit --page``: who may ask its server, what that makes of it, and when it ends."""

import http.client
import shutil
import socket
import time
from queue import Queue
from threading import Thread

import pytest

from mapper.api.edit_page import serve_edit_page
from mapper.run.folder import open_run
from tests.support.chromium import CHROMIUM, MISSING
from tests.support.files import files_of
from tests.support.map_page import EditedPage, change

BOX = "[[erase]]\nbox_m = [[-9.0, -9.0, 0.3], [9.0, 9.0, 0.9]]\n"


class Served:
    """A run whose page is served by a thread, and one open tab of it."""

    def __init__(self, folder):
        self.folder = folder
        run, ready = open_run(folder), Queue()
        self.thread = Thread(
            target=lambda: serve_edit_page(run.open_log(), run, on_ready=ready.put), daemon=True
        )
        self.thread.start()
        self.url = ready.get(timeout=30)
        self.host, self.token = self.url.removeprefix("http://").rstrip("/").split("/")
        connection = http.client.HTTPConnection(self.host)
        connection.request("GET", f"/{self.token}/open")
        self.tab = connection.getresponse()
        assert self.tab.status == 200

    def ask(self, method, path, body=None, **headers):
        """Return the status and the text of an answer; the page's own headers are added."""
        connection = http.client.HTTPConnection(self.host, timeout=120)
        connection.request(method, path, body, {"Origin": f"http://{self.host}"} | headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()

    def post(self, name, text=""):
        """Return "done", or what was wrong."""
        status, line = self.ask("POST", f"/{self.token}/{name}", text)
        assert status == 200
        return line.strip(" ")

    def close(self):
        self.tab.close()
        self.thread.join(20)


@pytest.fixture(scope="module")
def served(desk_run, tmp_path_factory):
    served = Served(shutil.copytree(desk_run.path, tmp_path_factory.mktemp("edited") / "desk"))
    yield served
    served.close()


def test_only_the_page_itself_may_ask(served):
    token, other = served.token, "http://example.org"
    for method, path, headers in (
        ("GET", "/", {}),
        ("GET", "/guess/", {}),
        ("GET", f"/{token}/../", {}),
        ("GET", f"/{token}/solve", {}),
        ("GET", f"/{token}/", {"Host": f"example.org:{served.host.split(':')[1]}"}),
        ("GET", f"/{token}/", {"Origin": other}),
        ("POST", f"/{token}/solve", {"Origin": other}),
        ("POST", f"/{token}/solve", {"Origin": "null"}),
        ("POST", "/guess/solve", {}),
        ("GET", f"/{token}/scans/0/../1", {}),
        ("POST", f"/{token}/open", {}),
    ):
        assert served.ask(method, path, BOX if method == "POST" else None, **headers)[0] == 403
    assert served.ask("OPTIONS", f"/{token}/solve")[0] == 501
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", int(served.host.split(":")[1])))


def test_a_mistake_is_one_line_and_changes_nothing(served):
    before = files_of(served.folder)
    for text, said in (
        ("", "edits: none"),
        ("[[erase]", "edits: not valid TOML"),
        ("[[erase]]\nbox = 1\n", "erase.0.box: unknown"),
        ("[[run]]\nname = 'rm'\n", "run: unknown"),
        ("[[accept]]\nnodes = [0, 900]\n", "no node 900"),
        ("[[reject]]\nnodes = [0, 1]\n", "no loop of"),
        ("[[keep]]\nheight_m = [90.0, 91.0]\n", "no voxel in a region to keep"),
        ("#" * 70_000, "at most 65536 at once"),
    ):
        line = served.post("solve", text)
        assert (said in line, "\n" in line) == (True, False)
    assert "nothing was solved" in served.post("undo")
    assert files_of(served.folder) == before


def test_a_solve_is_shown_beside_what_was_and_undone_to_the_byte(served):
    before = files_of(served.folder)
    assert served.post("solve", BOX) == "done"
    assert open_run(served.folder).manifest.edits[0].count > 10
    status, page = served.ask("GET", f"/{served.token}/")
    assert (status, page.count('class="facts"')) == (200, 2)
    assert '"regions":[{"kind":"erase","values":{"box_m":[[-9.0,-9.0,0.3],[9.0,9.0,0.9]]}}]' in page
    assert served.post("undo") == "done"
    assert files_of(served.folder) == before


def test_the_server_ends_with_its_tab_and_leaves_the_run_alone(desk_run, tmp_path):
    served = Served(shutil.copytree(desk_run.path, tmp_path / "desk"))
    served.post("solve", BOX)
    served.close()
    assert not served.thread.is_alive()
    assert [path.name for path in tmp_path.iterdir()] == ["desk"]
    assert len(open_run(served.folder).manifest.edits) == 1


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_person_erases_a_box_solves_and_undoes_it_in_the_page(served):
    with EditedPage(served.url, height_px=800) as browser:
        counts = browser.facts()
        browser.choose("edit-region", "-9 -9 0.3 9 9 0.9")
        browser.click("[data-map=edit-add]")
        browser.ask("edit-solve")
        before, after = browser.facts()
        assert before.endswith(counts[0])
        assert after != before
        browser.ask("edit-undo")
        assert browser.facts() == counts
        assert browser.complaints == []


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_person_drags_one_keyframe_over_another_and_the_server_registers_them(served):
    graph = open_run(served.folder).graph
    i, j, *_ = graph.T_world_node
    with EditedPage(served.url, height_px=800) as browser:
        browser.choose("edit-i", str(i))
        browser.choose("edit-j", str(j))
        browser.click("[data-map=above]")
        browser.click("[data-map=edit-align]")
        while browser.run("document.querySelector('[data-map=edit-moved]').hidden"):
            time.sleep(0.05)
        still = browser.picture()
        x, y = browser.centre(".map canvas")
        browser.drag((x, y), (x + 24, y - 18))
        assert change(still, browser.picture()) > 0.01
        dx, dy, dz, turn = map(float, browser.value("edit-moved").split())
        assert (dz, turn) == (0.0, 0.0)
        assert dx / dy == pytest.approx(12.0 / 9.0, rel=0.05)
        assert 0.02 < dx < 0.3
        browser.click("[data-map=edit-by-eye]")
        browser.click("[data-map=edit-accept]")
        assert browser.edits() == [f"accept {i} – {j}, by eye"]
        browser.click("[data-map=edit-undo]")
        browser.click("[data-map=edit-align]")
        while browser.run("document.querySelector('[data-map=edit-moved]').hidden"):
            time.sleep(0.05)
        browser.click("[data-map=edit-by-eye]")
        browser.click("[data-map=edit-accept]")
        assert browser.edits() == [f"accept {i} – {j}, aligned"]
        browser.ask("edit-solve")
        assert open_run(served.folder).loops[-1].proposed_by == "hand"
        browser.ask("edit-undo")
        assert browser.complaints == []
