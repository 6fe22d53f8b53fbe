"""One HTML page with all tables and figures of the papers; it loads nothing, so it opens anywhere, offline."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hexapod_comp.formats.pages import render
from hexapod_comp.formats.texts import number

from .comparing import MET, MISSED, OPEN, SHOWN, WRONG, Exhibit, Paper

TITLE = "The papers' tables and figures, computed"

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
    given = {"title": TITLE, "note": note, "papers": papers, "marks": MARKS, "meanings": MEANINGS, "number": number}
    return render(Path(__file__).with_name("papers.html"), **given)


def exhibit_html(exhibit: Exhibit) -> str:
    """Return one exhibit as it stands on the page, for a notebook."""
    page = page_text([Paper("", "", (exhibit,))], "")
    return page[page.index("<section") : page.index("</section>")] + "</section>"
