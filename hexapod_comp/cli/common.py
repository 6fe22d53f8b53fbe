"""What the verbs share: options, how numbers are read from the command line, how results are shown."""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

from ..formats.texts import number

if TYPE_CHECKING:
    import numpy as np

    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry
    from ..machine.model import MachineModel

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

POSE_HELP = "mm and degrees: x,y,z or x,y,z,alpha,beta,gamma"

DECIMALS = {"mm": 9, "deg": 9, "um": 6, "urad": 6}
"""Digits after the point in CSV files: a picometre, and less than that at the platform's edge."""


def add_verb(subparsers: Subparsers, name: str, run: Callable, summary: str, text: str) -> argparse.ArgumentParser:
    """Add a verb's parser with its one-line summary and the text below its options."""
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=summary,
        epilog=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def add_machine_options(parser: argparse.ArgumentParser, with_model: bool = True) -> None:
    """Add ``--machine`` and ``--model``."""
    parser.add_argument(
        "--machine",
        metavar="FILE",
        default="paper.yaml",
        help="geometry file, or the name of a shipped one (default paper.yaml)",
    )
    if with_model:
        parser.add_argument(
            "--model",
            metavar="FILE",
            default="ideal",
            help="model of the machine's errors: a file, the name of a shipped one, or ideal (default)",
        )


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--json`` and ``--out``."""
    parser.add_argument("--json", action="store_true", help="JSON, for programs; units are in the keys")
    parser.add_argument("--out", metavar="FILE", help="write to a file: CSV, or JSON with --json")


def pose_argument(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read ``x,y,z[,alpha,beta,gamma]`` in mm and degrees; return position, m, and angles, rad."""
    numbers = _numbers(text)
    if len(numbers) not in (3, 6):
        raise argparse.ArgumentTypeError(f"needs three or six numbers ({POSE_HELP}), not {len(numbers)}")
    angles = numbers[3:] or (0.0, 0.0, 0.0)
    return tuple(v * 1e-3 for v in numbers[:3]), tuple(math.radians(v) for v in angles)


def lengths_argument(text: str) -> tuple[float, ...]:
    """Read six lengths in mm; return them in m."""
    numbers = _numbers(text)
    if len(numbers) != 6:
        raise argparse.ArgumentTypeError(f"needs six lengths in mm, not {len(numbers)}")
    return tuple(v * 1e-3 for v in numbers)


def finite(text: str) -> float:
    """Read one finite number."""
    return _numbers(text)[0] if "," not in text else _not_a_number(text)


def bound(text: str) -> float:
    """Read a finite number that is not negative."""
    number = finite(text)
    if number < 0.0:
        raise argparse.ArgumentTypeError(f"must not be negative, not {text}")
    return number


def count(text: str, most: int = 10_000_000) -> int:
    """Read a whole number above zero, and not so large that nobody lives to see the end."""
    if not text.isdecimal() or len(text) > 12 or not 1 <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to {most}, not {text!r}")
    return int(text)


def seed(text: str) -> int:
    """Read a whole number, zero or above."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, 0 or above, not {text!r}")
    return int(text)


def _numbers(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        _not_a_number(text)
    return numbers if all(map(math.isfinite, numbers)) else _not_a_number(text)


def _not_a_number(text: str) -> Any:
    raise argparse.ArgumentTypeError(f"is not finite numbers: {text!r}")


def load_machine(args: argparse.Namespace) -> tuple[HexapodGeometry, MachineModel]:
    """Return the geometry and the model that the options name."""
    from ..machine.geometry import load_geometry
    from ..machine.model_file import load_model

    geometry = load_geometry(args.machine)
    return geometry, load_model(getattr(args, "model", "ideal"), geometry)


def one_row(
    argument: tuple[tuple[float, ...], tuple[float, ...]],
) -> tuple[list[Row], np.ndarray, np.ndarray]:
    """Return a pose given on the command line as a list of one: rows, positions, rotations."""
    import numpy as np

    from ..formats.csv import Row
    from ..pose import rotation_from_angles

    position, angles = argument
    return [Row(0, "1")], np.array([position]), rotation_from_angles(np.array([angles]))


def where(row: Row) -> str:
    """Say where a row stands, for messages."""
    return f"line {row.line} (row {row.label})" if row.line else "the pose"


def csv_text(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows of equal columns as CSV; the digits of a number follow from its column's unit."""
    rows = list(rows)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(rows[0])
    decimals = [DECIMALS.get(name.rpartition("_")[2], 6) for name in rows[0]]
    for row in rows:
        writer.writerow([_cell(value, digits) for value, digits in zip(row.values(), decimals, strict=True)])
    return stream.getvalue()


def _cell(value: Any, digits: int) -> Any:
    if not isinstance(value, float):
        return value
    return number(value, digits) if math.isfinite(value) else ""


def json_text(content: Any) -> str:
    """Return a result as JSON, as :func:`hexapod_comp.formats.json.json_text`, which takes its time to import."""
    from ..formats.json import json_text

    return json_text(content)


def emit(text: str, out: str | None) -> None:
    """Print a result, or write it to the file that ``--out`` names."""
    from ..formats.yaml import write_text_atomically

    if out is None:
        print(text, end="" if text.endswith("\n") else "\n")
    else:
        write_text_atomically(out, text)


def mention_compiling(kernel: str) -> None:
    """Say on a terminal that the first run after an installation takes longer.

    Parameters
    ----------
    kernel : str
        ``module.function`` of the kernel that is about to be used.
    """
    if not sys.stderr.isatty():
        return
    import numba

    from ..kernels.compiling import cache_folder

    if not any(cache_folder(numba.config.CACHE_DIR).rglob(f"{kernel}-*.nbi")):
        print("hexapod_comp: compiling, once after an installation; this takes up to a minute", file=sys.stderr)


def progress_bar(total: int, unit: str) -> Any:
    """Return a progress bar on stderr that appears after a second, on terminals only."""
    from tqdm import tqdm

    return tqdm(total=total, unit=unit, delay=1.0, disable=None, leave=False)


def say_notes(notes: Iterable[str]) -> None:
    """Say on stderr what a reader of files found odd."""
    for note in notes:
        print(f"hexapod_comp: note: {note}", file=sys.stderr)


@contextlib.contextmanager
def stage_line() -> Iterator[Callable[[str], None]]:
    """Give a function that shows on stderr, on terminals only, what a long calculation is at and since when."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    began = time.monotonic()

    def say(text: str) -> None:
        width = os.get_terminal_size(sys.stderr.fileno()).columns - 1
        line = f"{time.monotonic() - began:5.1f} s  {text}"[:width]
        print(f"\r\033[K{line}", end="", file=sys.stderr, flush=True)

    try:
        yield say
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)
