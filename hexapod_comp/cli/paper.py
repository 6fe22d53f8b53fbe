"""``hexapod_comp paper``: every table and figure of the three papers, computed and laid beside what they print."""

from __future__ import annotations

import argparse
import os

from . import common


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..formats.outputs import make_folder, write_text
    from ..formats.paths import version
    from ..machine.geometry import load_geometry
    from ..papers import daake, mou_king, song_mou_king
    from ..papers.comparing import MISSED
    from ..papers.page import write_page
    from ..papers.report import as_json, records, report

    geometry = load_geometry("paper")
    common.mention_compiling("model.actual_pose_one")
    with common.stage_line() as say:
        say("Song, Mou & King")
        papers = [song_mou_king.paper(geometry, args.machines, args.seed)]
        say("Mou & King")
        papers.append(mou_king.paper(geometry, args.seed))
        say("v. Daake, Vetter, Böhm & Zirn")
        papers.append(daake.paper())
        say("page")
        make_folder(args.folder)
        page, table = (os.path.join(args.folder, name) for name in ("papers.html", "papers.csv"))
        note = f"Made by hexapod_comp {version()} paper --machines {args.machines} --seed {args.seed}."
        write_page(page, papers, note)
        write_text(table, common.csv_text(records(papers)))
    common.show(as_json(papers) if args.json else report(papers))
    common.mention(args, f"page: {page}\nnumbers: {table}")
    return 1 if any(paper.count()[MISSED] for paper in papers) else 0
