"""Pages that hold all they show and load nothing from anywhere."""

from collections.abc import Iterable
from html import escape
from importlib import resources

from mapper import __version__

_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'"
)


def document(title: str, *, header: str, main: Iterable[str], scripts: Iterable[str] = ()) -> str:
    """Return a page's HTML.

    Args:
        title: Of the window, as plain text.
        header: HTML inside the bar that stays on top.
        main: HTML of the sections.
        scripts: HTML of script elements.
    """
    style = (resources.files("mapper.export.report") / "page.css").read_text(encoding="utf-8")
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{escape(_POLICY, quote=False)}">',
            f"<title>{escape(title)}</title>",
            f"<style>\n{style}</style>",
            "</head>",
            "<body>",
            f"<header>{header}</header>",
            "<main>",
            *main,
            "</main>",
            f"<footer>mapper {escape(__version__)}</footer>",
            *scripts,
            "</body>",
            "</html>",
            "",
        ]
    )


def section(title: str, body: str) -> str:
    """Return a part of a page under a headline, by which it can be linked to."""
    return f'<section id="{title.lower().replace(" ", "-")}"><h2>{escape(title)}</h2>{body}</section>'
