"""Compare every table and figure of the three papers with computed values: ``make papers``.

papers.html shows the comparison in any browser, offline; papers.csv has a row for each printed number. The report on
the terminal counts the printed numbers that are met, and states for all other numbers the difference (µm, thousandths
of a degree) and its cause. Exit code 0: every number that can be met is met; 1: one of these is not met; 2: bad input.

Usage: python -m examples.papers [--out out] [--machines 50] [--seed 1]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from hexapod_comp.cli.options import count, seed
from hexapod_comp.errors import HexapodError
from hexapod_comp.formats.csv import csv_text
from hexapod_comp.formats.outputs import make_folder, write_text
from hexapod_comp.formats.paths import version
from hexapod_comp.machine.geometry import load_geometry

from . import daake, mou_king, song_mou_king
from .comparing import MISSED, records, report
from .page import page_text


def main(arguments: Sequence[str] | None = None) -> int:
    """Write papers.html and papers.csv, print the report, and return the exit code."""
    parser = argparse.ArgumentParser("python -m examples.papers", description=(__doc__ or "").splitlines()[0])
    text = "folder for papers.html and papers.csv; created if it does not exist (default out)"
    parser.add_argument("--out", type=Path, metavar="FOLDER", default=Path("out"), help=text)
    text = "number of imperfect machines that are drawn for each pose of Tables 4 and 5 (default 50)"
    parser.add_argument("--machines", type=count, metavar="N", default=50, help=text)
    parser.add_argument("--seed", type=seed, metavar="N", default=1, help="seed of all random numbers (default 1)")
    args = parser.parse_args(arguments)
    try:
        make_folder(args.out)
        geometry = load_geometry("paper")
        papers = [
            song_mou_king.paper(geometry, args.machines, args.seed),
            mou_king.paper(geometry, args.seed),
            daake.paper(),
        ]
        note = f"Made by hexapod_comp {version()}, examples.papers --machines {args.machines} --seed {args.seed}."
        page, numbers = args.out / "papers.html", args.out / "papers.csv"
        write_text(page, page_text(papers, note))
        rows = list(records(papers))
        write_text(numbers, csv_text([list(rows[0]), *(list(row.values()) for row in rows)]))
    except HexapodError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return 2
    print(report(papers))
    print(f"page: {page}\nnumbers: {numbers}", file=sys.stderr)
    return 1 if any(paper.count()[MISSED] for paper in papers) else 0


if __name__ == "__main__":
    sys.exit(main())
