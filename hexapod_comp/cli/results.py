"""What the verbs share: output of tables and results, loading of machines, and progress on stderr."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..formats.csv import Row, csv_text
from ..formats.json import json_text
from ..formats.outputs import write_text
from ..formats.texts import CODES, aligned, number, own_terminal
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..measurements.campaign import Campaign

# Number of decimals by unit in CSV files: 1 pm, or for angles about 1 pm at the platform's edge
DECIMALS = {"mm": 9, "deg": 9, "um": 6, "urad": 6}
TEXT_DECIMALS = {"mm": 6, "deg": 6}  # Number of decimals by unit in texts; three for other units


class Table:
    """Rows with the same columns, whose names end in units; a value is a text, an int, a float or None."""

    def __init__(self, rows: Sequence[Mapping[str, Any]]) -> None:
        self.rows = rows

    def csv(self) -> str:
        """Return the rows as CSV, with an empty cell for None and for a number that is not finite."""
        return csv_text([list(self.rows[0]), *self._cells(list(self.rows[0]), DECIMALS, 6, "", lambda value: value)])

    def text(self, names: Sequence[str] = (), digits: Mapping[str, int] | None = None) -> str:
        """Return the columns `names`, or all, as aligned text; `digits` gives the decimals for a column or a unit."""
        names, digits = names or list(self.rows[0]), {**TEXT_DECIMALS, **(digits or {})}
        return aligned(names, self._cells(names, digits, 3, "–", lambda v: "–" if v is None else str(v)))

    def _cells(
        self, names: Sequence[str], digits: Mapping[str, int], usual: int, missing: str, other: Callable[[Any], Any]
    ) -> Iterator[list[Any]]:
        """Yield the cells of each row; floats have `usual` decimals, unless `digits` has their column or their unit."""
        places = {name: digits.get(name, digits.get(name.rpartition("_")[2], usual)) for name in names}

        def cell(name: str, value: Any) -> Any:
            if not isinstance(value, float):
                return other(value)
            return number(value, places[name]) if math.isfinite(value) else missing

        for row in self.rows:
            yield [cell(name, row[name]) for name in names]


@dataclass(frozen=True)
class Result:
    text: Callable[[], str]
    content: Callable[[], Any]  # for --json
    rows: Iterable[Mapping[str, Any]] = ()  # of the CSV file that --out writes
    pictures: Callable[[], Mapping[str, Figure]] | None = None  # by file name, for the folder of --pictures
    code: int = 0  # exit code
    notes: Iterable[str] = ()  # printed on stderr after the result

    def finish(self, args: argparse.Namespace) -> int:
        text = json_text(self.content()) if args.json else self.text()
        if self.rows and args.out is not None:
            write_text(args.out, Table(list(self.rows)).csv())
        if text:
            print(text, end="" if text.endswith("\n") else "\n")
        print_notes(self.notes)
        if self.pictures is not None and args.pictures is not None:
            save_pictures(args, self.pictures)
        return self.code


def load_machine(args: argparse.Namespace) -> tuple[HexapodGeometry, MachineModel]:
    """Return the geometry, with tool and work frame, and the model that the options name."""
    from ..virtual.named import find_model

    geometry = load_geometry(args.machine).using(getattr(args, "tool", None), getattr(args, "work", None))
    model, outside = find_model(getattr(args, "model", "ideal"), geometry), getattr(args, "outside", None)
    if outside is not None:
        model = model.at(model.outside.numbers_of(outside))
    elif model.outside.names and hasattr(args, "outside"):
        over = " and ".join(model.outside.names)
        print_notes([f"the model's table over {over} is not used, because --outside is not given"])
    return geometry, model


def print_default_machine(args: argparse.Namespace, geometry: HexapodGeometry) -> None:
    """Print a note on stderr if the default machine is used because --machine was not given."""
    if not getattr(args, "machine_given", False):
        print_notes([f"--machine was not given: the default machine, {geometry.name}, is used"])


def load_campaign(args: argparse.Namespace, geometry: HexapodGeometry) -> Campaign:
    """Return the campaign that the options name; if its file gives no box, use the machine's largest box."""
    from ..machine.passes import level_attitude
    from ..measurements.campaign import load_campaign
    from ..workspace.overview import corners
    from ..workspace.reach import machine_box

    if args.campaign is None:
        args.campaign = "campaign_5d.yaml" if geometry.name == "paper" else "campaign.yaml"
        if os.path.isfile(args.campaign):
            print_notes([f"your file {args.campaign} is used, not the shipped one; --campaign names another"])

    def own_box() -> np.ndarray:
        box = machine_box(geometry).box
        used = f"the largest box that {geometry.name} reaches is used, {corners(box)}"
        print_notes([f"{args.campaign} gives no box: {used}"])
        return box

    return load_campaign(args.campaign, own_box, level_attitude(geometry))


def about(geometry: HexapodGeometry, model: MachineModel | None = None) -> dict[str, str]:
    """Return the first keys of a JSON result: machine, model, tool, and frame of the poses."""
    named = {"machine": geometry.name} | ({} if model is None else {"model": model.name})
    return named | {"tool": geometry.tool_name, "frame": geometry.work_name}


def tool_in_frame(geometry: HexapodGeometry) -> str:
    return f"the {geometry.tool_name} in {geometry.work_name}"


def machine_title(geometry: HexapodGeometry, model: MachineModel) -> str:
    return f"machine {geometry.name}" + (f", model {model.name}" if model.name != "ideal" else "")


def where(row: Row) -> str:
    return f"line {row.line} (row {row.label})" if row.line else "the pose"


def print_written(args: argparse.Namespace, text: str) -> None:
    """Print a text about a written file on stdout, or with --json on stderr, since stdout then has only JSON."""
    print(text, file=sys.stderr if args.json else sys.stdout)


def print_notes(notes: Iterable[str]) -> None:
    for note in notes:
        print(f"hexapod_comp: note: {note}", file=sys.stderr)


def save_pictures(args: argparse.Namespace, pictures: Callable[[], Mapping[str, Figure]]) -> None:
    """Draw pictures, write them to the folder of --pictures, and print the names of the files."""
    from ..formats.figures import save

    with stage("drawing pictures"):
        figures = pictures()
    for name, figure in figures.items():
        path = os.path.join(args.pictures, name)
        with stage(f"writing {path}"):
            save(figure, path)
        print_written(args, f"picture: {path}")


@contextlib.contextmanager
def exit_on_signals() -> Iterator[None]:
    """Context in which SIGTERM and SIGHUP raise SystemExit (128 + signal number), so that inner contexts can stop their
    processes; a second signal ends this process at once, and nohup's SIGHUP has no effect."""

    def leave(caught: int, frame: object) -> None:
        signal.signal(caught, signal.SIG_DFL)
        raise SystemExit(128 + caught)

    handled = [one for one in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(one) == signal.SIG_DFL]
    for one in handled:
        signal.signal(one, leave)
    try:
        yield
    finally:
        for one in handled:
            signal.signal(one, signal.SIG_DFL)


def progress_bar(total: int, unit: str) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, unit=unit, delay=1.0, disable=None, leave=False, file=own_terminal())


@contextlib.contextmanager
def stage(text: str) -> Iterator[None]:
    with stage_line() as say:
        say(text)
        yield


@contextlib.contextmanager
def stage_line() -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the elapsed time and a text in one line on stderr, if stderr is a terminal."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    began = time.monotonic()

    def say(text: str) -> None:
        width = (os.get_terminal_size(sys.stderr.fileno()).columns or 80) - 1  # some terminals report 0 columns
        line = CODES.sub("", f"{time.monotonic() - began:5.1f} s  {text}")[:width]
        print(f"\r\033[K{line}", end="", file=own_terminal(), flush=True)

    try:
        yield say
    finally:
        print("\r\033[K", end="", file=own_terminal(), flush=True)
