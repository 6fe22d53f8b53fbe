"""HTML pages that load nothing: one file that opens anywhere, offline, and prints. Texts from outside are escaped."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

from ..errors import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESOLUTION = 110
"""Of embedded pictures, dots per inch."""

LONGEST_CELL = 300
"""Of a text in a table; longer ones end in …"""

MANY = 4
"""Columns from which on a narrow screen shows the cells of a row below each other."""

STYLE = """
 body { font: 16px/1.45 sans-serif; margin: 0; color: #1b1b1b; background: #fff }
 main { max-width: 1180px; margin: 0 auto; padding: 12px 16px 48px }
 h1 { font-size: 24px; line-height: 1.2 } h2 { font-size: 21px; margin-top: 48px; border-top: 2px solid #1b1b1b;
  padding-top: 12px } h3 { font-size: 17px; margin: 32px 0 4px } p { max-width: 80ch; margin: 6px 0 }
 .wide { overflow-x: auto; margin: 8px 0 16px } table { border-collapse: collapse; font-size: 14px }
 .caption { font-size: 14px }
 th, td { border: 1px solid #c8c8c8; padding: 3px 8px; text-align: right; vertical-align: top; white-space: nowrap }
 td { font-variant-numeric: tabular-nums } th small, td small { display: block; font-weight: normal; color: #444 }
 .text th, .text td { text-align: left; white-space: normal; min-width: 9em }
 .text td:first-child, .text th:first-child { min-width: 0 }
 figure { margin: 16px 0 } img { max-width: 100%; height: auto } figcaption { font-size: 14px; color: #444 }
 th[scope=row] { background: #fafafa }
 @media screen and (max-width: 700px) {
  table.rows, .rows tbody, .rows tr, .rows th, .rows td { display: block; border: 0; text-align: left }
  .rows th, .rows td { white-space: normal; max-width: none }
  .rows thead { display: none } .rows tr { border: 1px solid #c8c8c8; margin-bottom: 8px }
  .rows td:not([data-label=""])::before { content: attr(data-label) ": "; color: #444 }
  .rows td:empty { display: none }
 }
"""
"""What all pages look like; a page adds its own."""


def page(title: str, body: str, style: str = "") -> str:
    """Return a page; its own security policy forbids it to load or run anything.

    Parameters
    ----------
    title : str
        Any text.
    body, style : str
        HTML and CSS, as they are.
    """
    policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{shown(title)}</title>\n<style>{STYLE}{style}</style>\n</head>\n"
        f"<body><main>\n{body}</main></body></html>\n"
    )


def shown(text: object, limit: int = LONGEST_CELL) -> str:
    """Return a text from outside as HTML: on one line, escaped, without what turns the direction of reading."""
    return escape(printable(str(text), limit))


def table(header: Sequence[str], rows: Iterable[Sequence[object]], style: str = "") -> str:
    """Return a table whose rows open with their name; all cells are texts from outside."""
    head = "".join(f"<th scope=col>{shown(name)}</th>" for name in header)
    lines = []
    for first, *rest in rows:
        names = [*header[1:], *[""] * len(rest)]
        cells = "".join(f'<td data-label="{shown(n)}">{shown(cell)}</td>' for n, cell in zip(names, rest, strict=False))
        lines.append(f"<tr><th scope=row>{shown(first)}</th>{cells}</tr>")
    top = f"<thead><tr>{head}</tr></thead>" if any(header) else ""
    styles = " ".join(filter(None, (style, "rows" if len(header) >= MANY else "")))
    opening = f'<table class="{styles}">' if styles else "<table>"
    return f"<div class=wide tabindex=0>{opening}{top}<tbody>{''.join(lines)}</tbody></table></div>"


def picture(title: str, figure: Figure) -> str:
    """Return a figure with its caption; the picture is in the page."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=RESOLUTION, metadata={"Software": None})
    content = base64.b64encode(stream.getvalue()).decode("ascii")
    text = shown(title, 1000)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{content}"><figcaption>{text}</figcaption></figure>'
