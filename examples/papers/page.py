"""The HTML page with all tables and figures of the papers, in one file that opens offline in any browser."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hexapod_comp.formats.pages import render
from hexapod_comp.formats.texts import number

from .comparing import MET, MISSED, OPEN, SHOWN, WRONG, Exhibit, Paper

TITLE = "The papers' tables and figures, computed"

MARKS = {MET: ("✓", "met"), WRONG: ("≠", "wrong"), OPEN: ("?", "open"), MISSED: ("✗", "missed"), SHOWN: ("·", "shown")}
"""Sign and style of each verdict; the signs can be distinguished without colours."""

MEANINGS = {
    MET: "equal within the rounding of the printed digits, or within the accuracy that the paper states",
    WRONG: "the paper's number or formula is a misprint or an approximation; the right one is given",
    OPEN: "the paper does not print the data that would be needed; the difference is given",
    MISSED: "differs although it could be met: a fault of this package",
    SHOWN: "computed only; the paper prints no number to compare",
}


def page_text(papers: Sequence[Paper], note: str) -> str:
    """Return the HTML page; `note` states the program and its options."""
    given = {"title": TITLE, "note": note, "papers": papers, "marks": MARKS, "meanings": MEANINGS, "number": number}
    return render(Path(__file__).with_name("papers.html"), **given)


def exhibit_html(exhibit: Exhibit) -> str:
    """Return the HTML of one exhibit as on the page, for a notebook."""
    page = page_text([Paper("", "", (exhibit,))], "")
    return page[page.index("<section") : page.index("</section>")] + "</section>"
