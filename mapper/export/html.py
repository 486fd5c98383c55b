"""Self-contained HTML pages: they load nothing."""

import base64
from collections.abc import Iterable
from html import escape
from importlib import resources

from mapper import __version__
from mapper.export import figures

_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline' data:; "
    "base-uri 'none'; form-action 'none'"
)


def document(
    title: str,
    *,
    header: str,
    main: Iterable[str],
    scripts: Iterable[str] = (),
    styles: Iterable[str] = (),
    is_served: bool = False,
) -> str:
    """Return a page's HTML.

    Args:
        title: Title of the window, as plain text.
        header: HTML inside the bar that stays on top.
        main: HTML of the sections.
        scripts: HTML of script elements.
        styles: CSS after that of every page.
        is_served: Let scripts ask the server that the page comes from.
    """
    policy = f"{_POLICY}; connect-src 'self'" if is_served else _POLICY
    style = (resources.files("mapper.export.report") / "page.css").read_text(encoding="utf-8")
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{escape(policy, quote=False)}">',
            f"<title>{escape(title)}</title>",
            f"<style>\n{_palette_css()}\n{style}</style>",
            *(f"<style>\n{more}</style>" for more in styles),
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


def _palette_css() -> str:
    named: dict[str, figures.Rgb] = {
        "backdrop": figures.BACKDROP,
        "estimate": figures.ESTIMATE,
        "truth": figures.TRUTH,
        "accepted": figures.ACCEPTED,
        "rejected": figures.REJECTED,
        "doubtful": figures.DOUBTFUL,
        "start": figures.START,
        "end": figures.END,
        "end-on-dark": figures.END_ON_DARK,
        **{f"run{number}": color for number, color in enumerate(figures.RUNS)},
    }
    rules = " ".join(f"--{name}: {figures.hex_of(color)};" for name, color in named.items())
    return f":root {{ {rules} }}"


def section(title: str, body: str) -> str:
    """Return a part of a page under a headline, by which it can be linked to."""
    return f'<section id="{title.lower().replace(" ", "-")}"><h2>{escape(title)}</h2>{body}</section>'


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table of plain text, whose rows begin with what they are about."""
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join(f"<tr>{''.join(map(_cell, range(len(row)), row))}</tr>" for row in map(list, rows))
    table = f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll" tabindex="0">{table}</div>'


def image(png: bytes, text: str) -> str:
    """Return a picture, with the text for who cannot see it."""
    data = base64.b64encode(png).decode("ascii")
    return f'<p><img alt="{escape(text)}" style="max-width:100%" src="data:image/png;base64,{data}"></p>'


def bullets(lines: Iterable[str]) -> str:
    """Return a list of plain lines."""
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"


def _cell(column: int, text: str) -> str:
    tag = "td" if column else "th"
    return f"<{tag}>{escape(text)}</{tag}>"
