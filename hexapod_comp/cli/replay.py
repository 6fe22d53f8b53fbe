"""``hexapod_comp replay``: a recorded run through the compensator again."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from ..compensation.journal import Source
    from ..machine.geometry import HexapodGeometry
    from ..machine.model import MachineModel
    from ..replay.bag import Files, Recording
    from ..replay.report import Report

SUMMARY = "run a recorded bag through the compensator again: the same corrections, bit for bit?"

TEXT = """BAG is a folder that `ros2 bag record` has written (MCAP or sqlite3), or one of its files. It must hold
compensator/journal; with compensator/files the geometry and the model that were in use come along. strut_states and
tool_pose_estimate are shown in the pictures.

With --model (or --machine) of another file than was in use, the report also says what that would have corrected.
Exit code 0: the same bits, or within --tolerance-um; 1: not the same; 2: the bag cannot be used.

example:
  $ ros2 bag record --storage mcap --output run --all
  $ hexapod_comp replay run --pictures out/replay
  run: /compensator, machine paper, model shipped example: the virtual machine of the demo
  from 2026-11-21 20:11:05 UTC, 12.0 s: 3001 commands taken, 3000 answered, 1 refused
  replayed 3000 of 3000 answers: identical bit for bit
  …"""

NOTHING = (
    "nothing in it can be compared: no answer follows a snapshot of the journal without a page lost between; "
    "record for longer than a second"
)


def add_parser(subparsers: common.Subparsers) -> None:
    """Add the verb."""
    parser = common.add_verb(subparsers, "replay", run, SUMMARY, TEXT)
    parser.add_argument("bag", metavar="BAG", help="folder of a bag, .mcap or .db3 file")
    parser.add_argument("--namespace", metavar="NAME", help="the machine meant, when the bag holds several")
    own = "(default: what the recording carries)"
    parser.add_argument("--machine", metavar="FILE", help=f"geometry file, or the name of a shipped one {own}")
    parser.add_argument("--model", metavar="FILE", help=f"model file, the name of a shipped one, or ideal {own}")
    parser.add_argument(
        "--tolerance-um",
        type=common.bound,
        default=0.0,
        metavar="UM",
        help="accept differences up to this, µm (default 0: the same bits)",
    )
    parser.add_argument("--pictures", metavar="FOLDER", help="write pictures into a folder")
    common.add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    """Run the verb; 0 when the replay gives the same."""
    from ..replay.bag import read_recording

    with common.progress_bar(0, " messages") as bar:
        recording = read_recording(args.bag, args.namespace, bar.update)
    report, geometry = _replayed(args, recording)
    _show(args, report)
    if args.pictures:
        from ..replay.pictures import write_pictures

        for path in write_pictures(report, geometry, args.pictures):
            print(f"hexapod_comp: wrote {path}", file=sys.stderr)
    return 0 if report.same else 1


def _replayed(args: argparse.Namespace, recording: Recording) -> tuple[Report, HexapodGeometry]:
    """Replay with what was in use, where that is at hand, and with what the options name, where that is another."""
    from ..errors import InputFileError
    from ..replay.bag import Files
    from ..replay.replay import replay_recording, what_if
    from ..replay.report import Report

    files = Files(recording, _given(args))
    other = _other(args, recording, files)
    as_it_was = other is None or files.missing() is None
    report = Report(recording, None, tolerance=args.tolerance_um * 1e-6)
    with common.progress_bar(len(recording.answers) * (as_it_was + bool(other)), " answers") as bar:
        if as_it_was:
            report.replayed = replay_recording(recording, files, bar.update)
            if other is None and not report.replayed.compared:
                raise InputFileError(args.bag, "", NOTHING)
        if other is not None:
            report.other = what_if(recording, *other, bar.update)
            report.other_name = f"machine {other[0].name}, model {other[1].name}"
    return report, files.geometry(recording.first.geometry) if as_it_was or other is None else other[0]


def _show(args: argparse.Namespace, report: Report) -> None:
    from ..replay.report import as_json, rows_of, text

    if args.json:
        common.emit(common.json_text(as_json(report)), args.out)
        return
    if args.out:
        common.emit(common.csv_text(rows_of(report)), args.out)
    print(text(report))


def _given(args: argparse.Namespace) -> dict[str, Source]:
    """Return the texts of the files that the options name, by hash."""
    from ..compensation.journal import Source
    from ..formats.paths import input_file

    names = [name for name in (args.machine, args.model) if name is not None and name != "ideal"]
    sources = [Source.read(input_file(name)) for name in names]
    return {source.sha256: source for source in sources}


def _other(args: argparse.Namespace, recording: Recording, files: Files) -> tuple[HexapodGeometry, MachineModel] | None:
    """Return the geometry and the model of the options, when one of them is another than was in use."""
    from ..machine.geometry import load_geometry
    from ..machine.model_file import load_model

    first, ideal = recording.first, args.model == "ideal"
    if not (set(_given(args)) - files.used or (ideal and not files.used_ideal)):
        return None
    geometry = load_geometry(args.machine) if args.machine else files.geometry(first.geometry)
    return geometry, load_model(args.model, geometry) if args.model else files.model(first.model, geometry)
