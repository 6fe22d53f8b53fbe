"""One HTML page with all tables and figures of the papers; it loads nothing, so it opens anywhere, offline."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from hexapod_comp.formats.pages import page, picture
from hexapod_comp.formats.texts import number

from .comparing import MET, MISSED, OPEN, SHOWN, VERDICTS, WRONG, Exhibit, NumberTable, Paper, Statement

MARKS = {MET: ("✓", "met"), WRONG: ("≠", "wrong"), OPEN: ("?", "open"), MISSED: ("✗", "missed"), SHOWN: ("·", "shown")}
"""Sign and style of each verdict: told apart without colours too."""

MEANINGS = {
    MET: "within what the printed digits, or the paper's own words, allow",
    WRONG: "the paper's number or formula is a misprint or an approximation; the right one stands beside it",
    OPEN: "what would be needed is not printed; the difference is given all the same",
    MISSED: "could be met and is not: a fault of this package",
    SHOWN: "computed; the paper prints no number to compare it with",
}


def page_text(papers: Sequence[Paper], note: str) -> str:
    """Return the page; `note` says how it was made."""
    contents = "".join(
        f'<li><a href="#p{p}">{escape(paper.short)}</a>: {escape(paper.headline())}<ol>'
        + "".join(
            f'<li><a href="#p{p}s{s}">{escape(exhibit.title)}</a></li>' for s, exhibit in enumerate(paper.exhibits)
        )
        + "</ol></li>"
        for p, paper in enumerate(papers)
    )
    legend = "".join(
        f"<li>{_mark(verdict)} {escape(verdict)}: {escape(MEANINGS[verdict])}</li>" for verdict in VERDICTS
    )
    body = "".join(_paper(p, paper) for p, paper in enumerate(papers))
    top = f"<h1>{TITLE}</h1><p>{escape(note)}</p><ul class=legend>{legend}</ul><nav><ol>{contents}</ol></nav>"
    return page(TITLE, top + body, OWN_STYLE)


def _paper(p: int, paper: Paper) -> str:
    exhibits = "".join(
        f'<section id="p{p}s{s}">{exhibit_html(exhibit)}</section>' for s, exhibit in enumerate(paper.exhibits)
    )
    return f'<h2 id="p{p}">{escape(paper.short)}</h2><p><i>{escape(paper.title)}</i></p>{exhibits}'


def exhibit_html(exhibit: Exhibit) -> str:
    """Return a table or figure of a paper as HTML with all its pictures."""
    parts = [f"<h3>{escape(exhibit.title)}</h3><p>{escape(exhibit.text)}</p>"]
    parts += [_table(table) for table in exhibit.tables]
    if exhibit.statements:
        parts.append(_statements(exhibit.statements))
    parts += [picture(title, figure) for title, figure in exhibit.figures.items()]
    return "".join(parts)


def _table(table: NumberTable) -> str:
    """Return a table whose cells hold the printed number, the computed one and the difference."""
    head = "".join(
        f"<th scope=col>{escape(c.name)}<small>{escape(c.unit)}<br>Δ {escape(c.difference_unit)}</small></th>"
        for c in table.columns
    )
    rows = []
    for r, name in enumerate(table.rows):
        cells = "".join(_cell(table, r, c) for c in range(len(table.columns)))
        rows.append(f"<tr><th scope=row>{escape(name)}</th>{cells}</tr>")
    caption = escape(table.summary())
    return (
        f"<p>{escape(table.note)}</p><p class=caption>{caption}. In each cell: printed, computed, difference Δ.</p>"
        f"<div class=wide tabindex=0><table><thead><tr><th></th>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _cell(table: NumberTable, r: int, c: int) -> str:
    column, verdict = table.columns[c], table.verdicts[r, c]
    computed = number(float(table.computed[r, c]), column.digits)
    difference = table.difference_text(r, c)
    return (
        f"<td class={MARKS[verdict][1]}><b>{escape(table.printed[r][c])}</b><br>{computed}<br>"
        f"<small>{escape(difference)} {_mark(verdict)}</small></td>"
    )


def _statements(statements: Sequence[Statement]) -> str:
    rows = "".join(
        f"<tr class={MARKS[one.verdict][1]}><td>{_mark(one.verdict)}</td><th scope=row>{escape(one.what)}</th>"
        f"<td>{escape(one.printed)}</td><td>{escape(one.computed)}</td><td>{escape(one.why)}</td></tr>"
        for one in statements
    )
    head = "".join(f"<th scope=col>{name}</th>" for name in ("", "what", "paper", "found", "why"))
    table = f"<table class=text><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    return f"<div class=wide tabindex=0>{table}</div>"


def _mark(verdict: str) -> str:
    sign, style = MARKS[verdict]
    return f'<span class="mark {style}" title="{escape(verdict)}">{sign}</span>'


TITLE = "The papers' tables and figures, computed"

OWN_STYLE = """
 .legend { list-style: none; padding: 0 } nav ol ol { padding-left: 20px } nav li { margin: 2px 0 }
 td.wrong, tr.wrong { background: #fdf1d8 } td.open, tr.open { background: #eef1f6 }
 td.missed, tr.missed { background: #f8d7d7 } .mark { font-weight: bold } .mark.met { color: #1f6b3a }
 .mark.wrong { color: #8a5a00 } .mark.open { color: #35507c } .mark.missed { color: #a01515 }
 @media (max-width: 700px) {
  .text thead { display: none } .text tr { display: block; border: 1px solid #c8c8c8; margin-bottom: 8px }
  .text td, .text th { display: block; border: 0; background: none } .text td:first-child { float: left }
  .text td:nth-child(3):not(:empty)::before { content: "paper: " }
  .text td:nth-child(4):not(:empty)::before { content: "found: " }
 }
"""
