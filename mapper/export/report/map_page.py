"""The map in 3D as a part of a page, or as a page of its own; the browser draws it from ``map/*.js``."""

import json
from collections.abc import Iterator, Sequence
from functools import partial
from html import escape
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import numpy as np

from mapper.export.html import document
from mapper.export.report.data import Chapter, drawn, refuse_same_names, views_uri
from mapper.export.report.map_data import MOST_POINTS, map_of
from mapper.mapping.cloud import height_colors
from mapper.runtime.atomic import write_text

_LAYERS = (
    ("path", "path", "run0", True),
    ("keyframes", "keyframes", "run0", True),
    ("ends", "start, end, direction", "start", True),
    ("band", "uncertainty, 2 σ", "run0", True),
    ("doubtful", "doubtful frames", "doubtful", True),
    ("truth", "truth", "truth", False),
    ("accepted", "<b></b> loops that hold", "accepted", True),
    ("rejected", "<b></b> loops refused", "rejected", False),
)
Editing = Literal["to a file", "served"]
"""What happens to edits of a page: it saves them as a file, or sends them to the server that it is from."""

_AS_IS = " !\"$&'()*+,/:;<=>?@[\\]^`{|}~"  # what a data: address may hold as it is, and % and # may not


def write_map_page(path: Path, chapters: Sequence[Chapter]) -> None:
    """Write a page that shows the maps of some runs in 3D, whole or not at all; it loads nothing.

    Raises:
        ConfigError: No runs, or two of one name.
        MapperError: A file of a run cannot be read.
    """
    refuse_same_names(chapters)
    title = " · ".join(chapter.name for chapter in chapters)
    write_text(path, run_page(title, chapters, editing="to a file" if len(chapters) == 1 else None))


def run_page(title: str, chapters: Sequence[Chapter], *, editing: Editing | None = None) -> str:
    """Return a page that shows the maps of some runs, with their verdicts and key figures.

    Args:
        title: Title of the page.
        chapters: The runs.
        editing: Lets a person edit the last run.

    Raises:
        MapperError: A file of a run cannot be read.
    """
    curves = [drawn(chapter) for chapter in chapters]
    facts_of = partial(_facts, names_it=len(chapters) > 1)
    facts = "".join(map(facts_of, chapters, curves))
    pictures = pictures_of(chapters)
    edited = None if editing is None else _edited(title, chapters, editing)
    return map_page(title, curves, maps_of(chapters), pictures=pictures, facts=facts, edited=edited)


def _edited(title: str, chapters: Sequence[Chapter], editing: Editing) -> dict[str, Any]:
    """Return what the page has to know of the run that is edited, with the regions that it has already."""
    regions = [
        {"kind": edit.kind, "values": edit.region.model_dump(exclude_none=True)}
        for edit in chapters[-1].run.manifest.edits
    ]
    return {
        "name": title,
        "run": len(chapters) - 1,
        "isServed": editing == "served",
        "regions": regions,
    }


def _facts(chapter: Chapter, curves: dict[str, Any], *, names_it: bool) -> str:
    verdict, counts = chapter.run.verdict, chapter.run.manifest.counts
    figures = [
        f"{counts.tracked} of {counts.listed} frames",
        f"{counts.loops} of {counts.loop_candidates} loops hold",
        f"{counts.voxels_text} of {chapter.run.config.octree.resolution_m:g} m",
    ]
    if curves["error"] and (misses_m := curves["error"]["m"]):
        figures.insert(0, f"ATE RMSE {np.sqrt(np.mean(np.square(misses_m))):.4f} m")
    title = f"{escape(chapter.name)}: " if names_it else ""
    why = escape(" ".join(verdict.sentences))
    return f'<p class="facts" title="{why}">{title}<b>{verdict.state}</b> · {escape(" · ".join(figures))}</p>'


def map_page(
    title: str,
    curves: Sequence[dict[str, Any]],
    maps: Sequence[dict[str, Any]],
    *,
    pictures: str,
    facts: str = "",
    edited: dict[str, Any] | None = None,
) -> str:
    """Return a page that shows maps in 3D, each with its path and its loops.

    Args:
        title: Title of the page.
        curves: Name, path, truth and loops that belong to each map, see :func:`~.data.drawn`.
        maps: Points, voxels and layers, see :func:`~.map_data.map_of`.
        pictures: HTML that takes the maps' place where they cannot be shown.
        facts: HTML of what the page says about them.
        edited: Name and index of a run that may be edited, see :func:`run_page`; None if none may.
    """
    return document(
        f"{title} – map",
        header=f"<h1>{escape(title)}</h1>{facts}",
        main=[map_html([one["name"] for one in curves], pictures, css="map whole")],
        scripts=[
            json_element("data", curves),
            json_element("edited", edited),
            *map_scripts(maps),
        ],
        styles=[map_style()],
        is_served=bool(edited and edited["isServed"]),
    )


def map_html(names: Sequence[str], pictures: str, *, css: str = "map") -> str:
    """Return the map's place in a page, with its controls; and the pictures that take its place."""
    runs = "".join(
        f'<label><input type="checkbox" data-map-run="{i}" checked> '
        f'<i style="--of: var(--run{i % 6})"></i>{escape(name)}</label>'
        for i, name in enumerate(names)
    )
    layers = "".join(
        f'<label><input type="checkbox" data-map-layer="{layer}"{" checked" if is_on else ""}> '
        f'<i style="--of: var(--{color})"></i>{label}</label>'
        for layer, label, color, is_on in _LAYERS
    )
    template = (_folder() / "map.html").read_text(encoding="utf-8")
    return (
        template.replace("{css}", css)
        .replace("{runs}", runs)
        .replace("{layers}", layers)
        .replace("{pictures}", pictures)
    )


def maps_of(chapters: Sequence[Chapter], *, most_points: int = MOST_POINTS) -> list[dict[str, Any]]:
    """Return the maps of some runs, which share a page's limits."""
    return [map_of(chapter, runs=len(chapters), most_points=most_points) for chapter in chapters]


def pictures_of(chapters: Sequence[Chapter]) -> str:
    """Return the runs' pictures of their clouds, for where maps cannot be shown in 3D."""
    return "".join(
        f'<img src="{uri}" alt="{escape(chapter.name)} from above and from the side">'
        for chapter in chapters
        if (uri := views_uri(chapter.run))
    )


def map_scripts(maps: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the script elements of the map: its data, the modules by their names, and its start.

    The page has the paths and loops in a JSON element called ``data``.
    """
    ramp = height_colors(np.linspace(0.0, 1.0, 256), between_m=(0.0, 1.0))
    yield json_element("maps", {"ramp": ramp.tolist(), "maps": maps})
    yield f'<script type="importmap">{_safe(json.dumps({"imports": dict(_modules())}))}</script>'
    yield '<script type="module">import "mapper/main";</script>'


def map_style() -> str:
    """Return the style of the map."""
    return (_folder() / "map.css").read_text(encoding="utf-8")


def json_element(name: str, data: Any) -> str:
    """Return a script element that holds data for scripts."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return f'<script type="application/json" id="{name}">{_safe(text)}</script>'


def _safe(json_text: str) -> str:
    """Return JSON as it may stand in a script element, which nothing ends but its end tag."""
    return json_text.replace("<", "\\u003c")


def _modules() -> Iterator[tuple[str, str]]:
    """Yield the name by which each module is imported, and its text as an address.

    A page that is opened from a disk may import no file beside it, and a module in the page has no name.
    """
    vendored = _folder() / "three"
    yield "three", _address(vendored / "three.module.min.js")
    yield "three/OrbitControls", _address(vendored / "OrbitControls.js")
    for module in sorted(_folder().iterdir(), key=lambda module: module.name):
        stem, _, ending = module.name.rpartition(".")
        if ending == "js":
            yield f"mapper/{stem}", _address(module)


def _address(module: Traversable) -> str:
    return f"data:text/javascript;charset=utf-8,{quote(module.read_text(encoding='utf-8'), safe=_AS_IS)}"


def _folder() -> Traversable:
    return resources.files("mapper.export.report") / "map"
