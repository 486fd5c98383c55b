"""The documents name files, functions and settings that exist, by reading sources without importing them."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

from mapper.config.build import BuildConfig
from mapper.core.config import Config, members_of
from mapper.run.files import RUN_FILES
from tests.support.pages import PAGES
from tests.support.paths import ROOT

IDS = [path.name for path in PAGES]
LINKED_TO_CODE = [ROOT / "docs" / name for name in ("architecture.md", "algorithms.md")]

LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+)\)")
CODE = re.compile(r"`([^`\n]+)`")
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
DRAWN = re.compile(r"mapper/[\w/.]+|\w[\w/]*\.py")
FILE = re.compile(r"(?:mapper|evaluators|cli|tests|benchmarks|scripts|configs|docs)(?:/[\w.+-]+)+/?")
DOTTED = re.compile(r"(?:mapper|evaluators|cli)(?:\.\w+)+")
IDENTIFIER = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)?")
SETTING = re.compile(r"([a-z]\w*(?:\.\w+)+)(?:=\S+)?")
PRODUCTS = {name for files in RUN_FILES for name in files.names}


@cache
def names_in(path: Path) -> frozenset[str]:
    """Names of a module: its functions, classes, constants, and their members as ``Class.member``."""
    return frozenset(_names(ast.parse(path.read_text(encoding="utf-8")).body))


def _names(body: list[ast.stmt], prefix: str = "") -> Iterator[str]:
    for node in body:
        match node:
            case ast.FunctionDef(name=name):
                yield prefix + name
            case ast.ClassDef(name=name):
                yield prefix + name
                yield from _names(node.body, f"{name}.")
            case ast.Assign(targets=targets):
                for target in chain.from_iterable(map(ast.walk, targets)):
                    if isinstance(target, ast.Name):
                        yield prefix + target.id
            case ast.AnnAssign(target=ast.Name(id=name)):
                yield prefix + name


def links_of(path: Path) -> list[tuple[str, str]]:
    """Text and relative target of every link to a file, without a heading behind it."""
    found = LINK.findall(FENCE.sub("", path.read_text(encoding="utf-8")))
    return [
        (text, target.split("#")[0]) for text, target in found if "://" not in target and target[0] != "#"
    ]


def anchors_of(path: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", path.read_text(encoding="utf-8")), re.MULTILINE)
    texts = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w -]", "", text).strip().replace(" ", "-") for text in texts}


def code_of(path: Path) -> list[str]:
    """Every piece of code within a line."""
    return CODE.findall(FENCE.sub("", path.read_text(encoding="utf-8")))


def resolves(dotted: str) -> bool:
    """Tell whether a dotted name is a package, a module, or a name in one."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        place, rest = ROOT.joinpath(*parts[:count]), ".".join(parts[count:])
        if (place / "__init__.py").is_file():
            return not rest or rest in names_in(place / "__init__.py")
        if place.with_suffix(".py").is_file():
            return not rest or rest in names_in(place.with_suffix(".py"))
    return False


def is_setting(names: list[str], models: list[type[Config]]) -> bool:
    """Tell whether any of some classes has a setting of this path."""
    fields = [model.model_fields[names[0]] for model in models if names[0] in model.model_fields]
    members = [member for field in fields for member in members_of(field.annotation)]
    return bool(fields) and (len(names) == 1 or is_setting(names[1:], members))


@pytest.mark.parametrize("path", PAGES, ids=IDS)
def test_links_lead_to_files_and_to_the_names_that_they_show(path):
    for text, target in links_of(path):
        file = path.parent / target
        assert file.exists(), f"{path.name}: {target}"
        name = text.strip("`")
        if file.suffix == ".py" and text.startswith("`") and not name.endswith(".py"):
            assert IDENTIFIER.fullmatch(name), f"{path.name}: {text} is no name in {target}"
            assert name in names_in(file), f"{path.name}: {target} has no {name}"


@pytest.mark.parametrize("path", PAGES, ids=IDS)
def test_links_to_headings_lead_to_one(path):
    for _, target in LINK.findall(FENCE.sub("", path.read_text(encoding="utf-8"))):
        name, _, anchor = target.partition("#")
        if anchor and "://" not in target:
            page = path.parent / name if name else path
            assert anchor in anchors_of(page), f"{path.name}: {target}"


@pytest.mark.parametrize("path", PAGES, ids=IDS)
def test_files_and_dotted_names_exist(path):
    for code in code_of(path):
        if FILE.fullmatch(code):
            assert (ROOT / code).exists(), f"{path.name}: {code}"
        if DOTTED.fullmatch(code):
            assert resolves(code), f"{path.name}: {code}"


def test_files_in_the_picture_exist():
    pictures = FENCE.findall((ROOT / "docs/architecture.md").read_text(encoding="utf-8"))
    drawn = DRAWN.findall("".join(pictures))
    assert len(drawn) > 10
    for file in drawn:
        assert (ROOT / file).exists() or (ROOT / "mapper" / file).exists(), file


@pytest.mark.parametrize("path", PAGES, ids=IDS)
def test_settings_exist(path):
    for code in code_of(path):
        setting = SETTING.fullmatch(code)
        if setting and code not in PRODUCTS and code.split(".")[0] in BuildConfig.model_fields:
            assert is_setting(setting[1].split("."), [BuildConfig]), f"{path.name}: {code}"


def folders_of(package: str, marker: str = "__init__.py") -> set[str]:
    """Names of the folders of a package that hold a file."""
    return {marked.parent.name for marked in (ROOT / package).glob(f"*/{marker}")}


def test_every_folder_has_its_line_in_the_order_of_the_layers():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    named = {
        package: re.findall(rf"^\| `{package}/(\w+)/` \|", text, re.MULTILINE)
        for package in ("mapper", "evaluators", "tests")
    }
    assert named["mapper"] == list(layers())
    assert set(named["evaluators"]) == folders_of("evaluators")
    mirrored = folders_of("mapper") | {"evaluators", "cli"}
    assert set(named["tests"]) == folders_of("tests", "*.py") - mirrored


def layers() -> tuple[str, ...]:
    """The folders of mapper in the order that the architecture's test holds."""
    module = ast.parse((ROOT / "tests/architecture/test_layers.py").read_text(encoding="utf-8"))
    for node in module.body:
        match node:
            case ast.Assign(targets=[ast.Name(id="LAYERS")], value=value):
                return tuple(ast.literal_eval(value))
    raise AssertionError("tests/architecture/test_layers.py has no LAYERS")


def test_what_does_not_exist_is_found():
    assert {"extension-points", "decisions"} <= anchors_of(ROOT / "docs/architecture.md")
    assert "the-sensors-own-vehicle" in anchors_of(ROOT / "docs/your-sensor.md")
    assert "extension-point" not in anchors_of(ROOT / "docs/architecture.md")
    assert "Isvd.fit_weighted" in names_in(ROOT / "mapper/registration/isvd.py")
    assert "Isvd.weighted_fit" not in names_in(ROOT / "mapper/registration/isvd.py")
    assert resolves("mapper.pipeline.build.build")
    assert not resolves("mapper.pipeline.build.built")
    assert not resolves("mapper.pipelines")
    assert is_setting(["odometry", "registration", "alpha_mm"], [BuildConfig])
    assert not is_setting(["odometry", "registration", "alpha_m"], [BuildConfig])
    for path in LINKED_TO_CODE:
        assert len(links_of(path)) > 20
