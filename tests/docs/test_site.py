"""The pages as a site: it is built without a warning, is complete, and asks no other host for anything."""

import os
import re
import subprocess
import sys
import time
from html import unescape
from pathlib import Path

import pytest

from mapper.config.describe import settings
from tests.support.chromium import CHROMIUM, MISSING, Page
from tests.support.pages import PAGES
from tests.support.paths import ROOT

pytest.importorskip("mkdocs", reason="MkDocs is an extra of tests: dev")
pytest.importorskip("material", reason="MkDocs's theme is an extra of tests: dev")

ASSET = re.compile(
    r"<(?:script|img|iframe|source|video|audio|embed)\b[^>]*\bsrc=[\"']?([^\"'\s>]+)"
    r"|<link\b(?=[^>]*\brel=[\"']?(?:stylesheet|icon|preload|preconnect|dns-prefetch))[^>]*\bhref=[\"']?([^\"'\s>]+)"
)
SEARCHED = {
    "localization": "localising",
    "relocalization": "localising",
    "splatting": "splatting",
    "QGIS": "gis",
    "AMCL": "nav2",
    "Autoware": "viewing",
    "octree.resolution_m": "settings",
}
"""Words that are typed into the search, and the page that each must find."""
FETCHED = re.compile(r"@import\s+[\"']?([^\"';\s)]+)|url\([\"']?([^\"')]+)")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out, pages = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("pages")
    for command in (
        ["scripts/make_pages.py", pages],
        ["-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", out],
    ):
        done = subprocess.run(
            [sys.executable, *command],
            cwd=ROOT,
            env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "PAGES": str(pages), "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    return out


@pytest.mark.slow
def test_every_page_is_in_the_site_and_in_its_navigation(site):
    index = (site / "index.html").read_text(encoding="utf-8")
    names = {"index.html", *(path.with_suffix(".html").name for path in PAGES if path.parent != ROOT)}
    for name in names:
        assert (site / name).is_file()
        assert name == "index.html" or re.search(rf"href=[\"']?{name}[\"'>\s]", index), name


@pytest.mark.slow
def test_no_page_asks_another_host_for_anything(site):
    checked = 0
    for page in site.rglob("*.html"):
        for asset in ("".join(found) for found in ASSET.findall(page.read_text(encoding="utf-8"))):
            checked += 1
            assert not re.match(r"(?:\w+:)?//", asset), f"{page.name}: {asset}"
            assert asset.startswith("data:") or page.name == "404.html" or (page.parent / asset).is_file(), (
                asset
            )
    for style in site.rglob("*.css"):
        for asset in ("".join(found) for found in FETCHED.findall(style.read_text(encoding="utf-8"))):
            assert not re.match(r"(?:\w+:)?//", asset), f"{style.name}: {asset}"
    assert checked > 3 * len(PAGES)


@pytest.mark.slow
def test_links_within_the_site_lead_to_files(site):
    for page in site.glob("*.html"):
        for link in re.findall(r"<a\b[^>]*\bhref=[\"']?([^\"'\s>]+)", page.read_text(encoding="utf-8")):
            path = unescape(link).partition("#")[0]
            if path and "://" not in path and page.name != "404.html":
                assert (page.parent / path).exists(), f"{page.name}: {link}"


@pytest.mark.slow
def test_every_setting_and_every_verb_is_in_the_reference(site):
    def text_of(name: str) -> str:
        return unescape(re.sub(r"<[^>]+>", "", (Path(site) / name).read_text(encoding="utf-8")))

    page = text_of("settings.html")
    for setting in settings():
        assert setting.key in page
    commands = text_of("commands.html")
    for verb in ("build", "fuse", "export", "sensor depth", "vocabulary train"):
        assert f"mapper {verb}" in commands
    assert "--require-truth" in commands


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM, reason=MISSING)
def test_the_search_works_from_disk_and_knows_other_spellings_and_names(site):
    field = "document.querySelector('input[data-md-component=\"search-query\"]')"
    found = (
        "Array.from(document.querySelectorAll('.md-search-result__item a')).map(a => a.pathname).join(' ')"
    )
    with Page(site / "index.html") as page:
        for word, name in SEARCHED.items():
            page.run(f"{field}.focus(); {field}.value = {word!r}; {field}.dispatchEvent(new Event('keyup'))")
            for _ in range(100):
                if f"/{name}.html" in (places := page.run(found)):
                    break
                time.sleep(0.1)
            assert f"/{name}.html" in places, word
        assert not [address for address in page.asked_for if not address.startswith(("file:", "data:"))]
