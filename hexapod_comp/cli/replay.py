"""``hexapod_comp replay``: a recorded run through the compensator again."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ..compensation.journal import Source
from ..errors import InputFileError
from ..formats.paths import input_file
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel
from ..replay.bag import Files, Recording, read_recording
from ..replay.replay import replay_recording, what_if
from ..replay.report import Report, rows_of
from ..virtual.named import find_model, is_random, is_word
from . import common

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOTHING = (
    "nothing in it can be compared: no answer follows a snapshot of the journal without a page lost between; "
    "record for longer than a second"
)


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb; 0 when the replay gives the same."""
    with common.progress_bar(0, " messages") as bar:
        recording = read_recording(args.bag, args.namespace, bar.update)
    report, geometry = _replayed(args, recording)
    text, content = report.shown()

    def pictures() -> dict[str, Figure]:
        from ..replay.pictures import figures_of

        return figures_of(report, geometry)

    code = 0 if report.same else 1
    return common.Result(lambda: text, lambda: content, rows_of(report), pictures, code)


def _replayed(args: argparse.Namespace, recording: Recording) -> tuple[Report, HexapodGeometry]:
    """Replay with what was in use, where that is at hand, and with what the options name, where that is another."""
    files = Files(recording, _given(args))
    other = _other(args, recording, files)
    as_it_was = other is None or files.missing() is None
    report = Report(recording, None, tolerance=args.tolerance_um * 1e-6)
    with common.progress_bar(len(recording.commands) * (as_it_was + bool(other)), " answers") as bar:
        if as_it_was:
            report.replayed = replay_recording(recording, files, bar.update)
            if other is None and not report.replayed.compared:
                raise InputFileError(args.bag, "", NOTHING)
        if other is not None:
            report.other = what_if(recording, *other, bar.update)
            report.other_name = f"machine {other[0].name}, model {other[1].name}"
    geometry = files.geometry(recording.first.geometry) if as_it_was or other is None else other[0]
    report.work_frames = geometry.work_frames
    return report, geometry


def _given(args: argparse.Namespace) -> dict[str, Source]:
    """Return the texts of the files that the options name, by hash."""
    files = {"geometry": args.machine, "model": None if is_word(args.model or "") else args.model}
    sources = [Source.read(input_file(name, kind)) for kind, name in files.items() if name is not None]
    return {source.sha256: source for source in sources}


def _other(args: argparse.Namespace, recording: Recording, files: Files) -> tuple[HexapodGeometry, MachineModel] | None:
    """Return the geometry and the model of the options, when one of them is another than was in use."""
    first, model = recording.first, args.model or ""
    if not (set(_given(args)) - files.used or is_random(model) or (model == "ideal" and not files.used_ideal)):
        return None
    geometry = load_geometry(args.machine) if args.machine else files.geometry(first.geometry)
    return geometry, find_model(args.model, geometry) if args.model else files.model(first.model, geometry)
