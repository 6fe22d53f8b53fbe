"""What options are: declared once, with what is read of them, and which of them go together.

A verb's options stand in :data:`.verbs.VERBS`. From there come its parser, its help, what its shell completes, which
files it reads and writes, and every complaint about options that do not go together. Nothing heavy is loaded here.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

from ..formats.texts import number_hint

POSE_HELP = "mm and degrees: x,y,z or x,y,z,alpha,beta,gamma"
LINE_HELP = "mm and degrees: x,y,z of its start, x,y,z of its end, and the tool's alpha,beta,gamma (default 0,0,0)"
SHAPE, LINE_SHAPE = "X,Y,Z[,A,B,C]", "X,Y,Z,X,Y,Z[,A,B,C]"
WORDS = "ideal, random or random:SEED"  # models that are no files


@dataclass(frozen=True)
class Option:
    """An option (``--name``), or an argument that is known by its place."""

    name: str
    help: str
    keywords: dict[str, Any] = field(default_factory=dict)  # of argparse: type, metavar, default, nargs, …
    role: str = ""  # "reads", "writes", "folder": what it names, a file that is read or written, or a folder to make
    kind: str = ""  # of the shipped files that it takes, as formats.paths.shipped_names knows them
    heading: str = ""  # under which it is listed; empty: with all others

    @property
    def dest(self) -> str:
        """Name of its value among the parsed ones."""
        return str(self.keywords.get("dest", self.name.lstrip("-").replace("-", "_")))

    @property
    def label(self) -> str:
        """What it is called in messages."""
        return self.name if self.name.startswith("-") else str(self.keywords.get("metavar", self.name))

    def given(self, args: argparse.Namespace) -> bool:
        """Return whether it was given, as something else than its default."""
        given = getattr(args, self.dest)
        return given is not None and given is not False and given != [] and given != self.keywords.get("default")


def flag(name: str, text: str) -> Option:
    """Return a switch."""
    return Option(name, text, {"action": "store_true"})


def value(name: str, read: Callable[[str], Any] | None, metavar: str, text: str, **more: Any) -> Option:
    """Return an option with a value, which `read` makes of what was typed."""
    return Option(name, text, {"metavar": metavar, **({} if read is None else {"type": read}), **more})


def choice(name: str, words: Sequence[str], text: str, default: str | None = None) -> Option:
    """Return an option that takes one of some words."""
    return Option(name, text, {"choices": words, "default": default})


def reads(name: str, text: str, metavar: str = "FILE", kind: str = "", **more: Any) -> Option:
    """Return an option that names what is read: files, shipped files, or a bag's folder."""
    return Option(name, text, {"metavar": metavar, **more}, "reads", kind)


def writes(name: str, text: str, metavar: str = "FILE", **more: Any) -> Option:
    """Return an option that names a file to write."""
    return Option(name, text, {"metavar": metavar, **more}, "writes")


def folder(name: str, text: str, **more: Any) -> Option:
    """Return an option that names a folder to write into; it is made."""
    return Option(name, text, {"metavar": "FOLDER", **more}, "folder")


def gone(name: str, now: str) -> Option:
    """Return an option of an older version that is refused, with what it is called now."""
    return Option(name, argparse.SUPPRESS, {"action": Renamed, "const": now, "metavar": "X"})


def under(heading: str, *options: Option) -> tuple[Option, ...]:
    """Return options that help lists under a heading."""
    return tuple(replace(option, heading=heading) for option in options)


class Assumptions(argparse.Action):
    """Print the constants of calibration."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from ..calibration.assumptions import ASSUMED
        from ..calibration.parameters import TOLERANCES

        for name, value, what, source in ASSUMED.rows():
            print(f"{name} = {value}: {what} ({source})")
        for block, tolerance in TOLERANCES.items():
            print(f"tolerance of {block} = {tolerance:g}: first guess of its size (the fit goes on from there)")
        parser.exit()


class Renamed(argparse.Action):
    """Refuse an option of an older version, and say what it is called now."""

    def __call__(self, parser: argparse.ArgumentParser, _: object, __: object, option: str | None = None) -> None:
        parser.error(f"argument {option}: is now {self.const}")


class StoreMachine(argparse.Action):
    """Store a machine, and that it was given."""

    def __call__(self, _: object, namespace: argparse.Namespace, given: Any, __: str | None = None) -> None:
        namespace.machine, namespace.machine_given = given, True


# Which options go together. In a rule an option stands by its name, or with its value: "--scheme lines".


class Rule(NamedTuple):
    """What must hold for the options of a verb that are given."""

    kind: str
    options: tuple[str, ...]  # of EXACTLY_ONE also several with spaces between them, which stand for one way

    def problem(self, given: Callable[[str], bool], label: Callable[[str], str]) -> str:
        """Return what is wrong, empty if nothing is."""
        by, others = self.options[0], self.options[1:]
        here = [name for name in self.options if any(given(part) for part in re.split(" (?=--)", name))]
        first = next((label(name) for name in others if given(name)), "") if self.kind in (NEEDS, EXCLUDES) else ""
        if self.kind == EXACTLY_ONE and len(here) != 1:
            return f"give exactly one of {', '.join(map(label, self.options))}"
        if self.kind == SOME and not here:
            return f"at least one of {', '.join(map(label, self.options))} is needed"
        if self.kind == TOGETHER and 0 < len(here) < len(self.options):
            missing = next(name for name in self.options if name not in here)
            return f"{missing} is missing: {', '.join(self.options)} go together"
        if self.kind == NEEDS and first and not given(by):
            return f"{first} has no meaning without {label(by)}"
        if self.kind == EXCLUDES and first and given(by):
            return f"{first} has no meaning with {label(by)}"
        return ""


EXACTLY_ONE, SOME, TOGETHER, NEEDS, EXCLUDES = "exactly one", "some", "together", "needs", "excludes"


def _rule(kind: str, *options: str) -> Rule:
    return Rule(kind, options)


exactly_one = partial(_rule, EXACTLY_ONE)  # of the options, and one alone
some_of = partial(_rule, SOME)  # one or more of them
together = partial(_rule, TOGETHER)  # all of them, or none
needed_by = partial(_rule, NEEDS)  # those that follow mean nothing without the first
excluded_by = partial(_rule, EXCLUDES)  # those that follow mean nothing with the first


# What is typed becomes numbers in SI; argparse says which option was wrong.


def wrong(text: str) -> argparse.ArgumentTypeError:
    """Return (not raise) an error about what was typed."""
    return argparse.ArgumentTypeError(text)


def numbers(text: str, counts: tuple[int, ...] = (), what: str = "") -> tuple[float, ...]:
    """Read finite numbers with commas between them; only so many, where counts are given."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise wrong(f"must be finite numbers{number_hint(text)}, not {text!r}")
    if counts and len(values) not in counts:
        raise wrong(f"needs {what}, not {len(values)}")
    return values


def outside_numbers(text: str) -> dict[str, float]:
    """Read numbers by their names, which end in their units: ``elevation_deg=40,rotation_deg=6``."""
    parts = [part.partition("=") for part in text.split(",")]
    if not all(name.strip() and mark for name, mark, _ in parts):
        raise wrong(f"must be NAME_UNIT=NUMBER, with commas between, not {text!r}")
    return {name.strip(): finite(number) for name, _, number in parts}


def finite(text: str) -> float:
    """Read one finite number."""
    if "," in text:
        raise wrong(f"must be finite numbers{number_hint(text)}, not {text!r}")
    return numbers(text)[0]


def bound(text: str) -> float:
    """Read a finite number that is not negative."""
    if (number := finite(text)) < 0.0:
        raise wrong(f"must not be negative, not {text}")
    return number


def above_zero(text: str) -> float:
    """Read a finite number above zero."""
    if (number := finite(text)) <= 0.0:
        raise wrong(f"must be above zero, not {text}")
    return number


def scaled(read: Callable[[str], Any], size: float) -> Callable[[str], Any]:
    """Return what reads as another does, and multiplies by the size of the option's unit in SI."""

    def in_si(text: str) -> Any:
        value = read(text)
        return tuple(size * v for v in value) if isinstance(value, tuple) else size * value

    return in_si


def span(text: str) -> tuple[float, float]:
    """Read ``LOW,HIGH``, or one number that stands for 0 to it; both not negative."""
    values = numbers(text)
    low, high = (0.0, *values) if len(values) == 1 else values if len(values) == 2 else (1.0, 0.0)
    if not 0.0 <= low <= high:
        raise wrong(f"needs one number, or the lowest and the highest, not negative: {text}")
    return low, high


def whole(low: int, high: int = 10_000_000) -> Callable[[str], int]:
    """Return what reads a whole number within bounds."""

    def count(text: str) -> int:
        if not text.isdecimal() or len(text) > 12 or not low <= int(text) <= high:
            raise wrong(f"must be a whole number from {low} to {high}, not {text!r}")
        return int(text)

    return count


count = whole(1)


def seed(text: str) -> int:
    """Read a whole number, zero or above."""
    if not text.isdecimal():
        raise wrong(f"must be a whole number, 0 or above, not {text!r}")
    return int(text)


def pose(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read ``x,y,z[,alpha,beta,gamma]`` in mm and degrees; return position, m, and angles, rad."""
    values = numbers(text, (3, 6), f"three or six numbers ({POSE_HELP})")
    return tuple(v * 1e-3 for v in values[:3]), tuple(map(math.radians, values[3:] or (0.0, 0.0, 0.0)))


point = scaled(partial(numbers, counts=(3,), what="three numbers, mm"), 1e-3)  # ``x,y,z`` in mm as m
lengths = scaled(partial(numbers, counts=(6,), what="six lengths in mm"), 1e-3)  # in mm as m


def line(text: str) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Read two points in mm and, perhaps, the tool's angles in degrees; return the points, m, and the angles, rad."""
    values = numbers(text, (6, 9), f"six or nine numbers ({LINE_HELP})")
    start, end = (tuple(v * 1e-3 for v in values[n : n + 3]) for n in (0, 3))
    if start == end:
        raise wrong(f"must end elsewhere than it starts, not {text}")
    return start, end, tuple(map(math.radians, values[6:] or (0.0, 0.0, 0.0)))


def box(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read two corners in mm; return the lowest and the highest, m."""
    low, high = lengths(text)[:3], lengths(text)[3:]
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise wrong(f"must be the lowest corner, then the highest, not {text}")
    return low, high


def tilts(text: str) -> tuple[float, ...]:
    """Read tilts in degrees; return them in rad, rising, each once."""
    return tuple(math.radians(v) for v in sorted(set(numbers(text))))


def expansions(text: str) -> tuple[float, float, float]:
    """Read one or three expansions in ppm/K; return them in 1/K, for struts, base and platform."""
    first, *others = (v * 1e-6 for v in numbers(text, (1, 3), "one or three numbers"))
    return (first, *(others or (0.0, 0.0)))


def time_constants(text: str) -> tuple[float, ...]:
    """Read time constants in s; return them rising."""
    return tuple(sorted(numbers(text)))


def times(text: str) -> tuple[str, tuple[float, float, float]]:
    """Read ``NAME=MIN,MIN,S``: the times of an instrument; return its name and s."""
    name, _, values = text.partition("=")
    spent = numbers(values)
    if not name or len(spent) != 3 or min(spent) < 0.0 or spent[2] == 0.0:
        raise wrong(f"needs a name and three numbers, not negative, the last above zero: linear=20,8,4, not {text!r}")
    return name, (60.0 * spent[0], 60.0 * spent[1], spent[2])


def joint_names(text: str) -> tuple[str, ...]:
    """Read six different names of joints, in strut order."""
    names = tuple(text.split(","))
    if len(set(names)) != 6 or len(names) != 6:
        raise wrong(f"needs six different names, in strut order, not {text}")
    strange = [name for name in names if not re.fullmatch(r"[A-Za-z_][\w/]*", name)]
    if strange:
        raise wrong(f"a name has letters, digits, _ and /, a letter or _ first, not {strange[0]!r}")
    return names


def csv_file(text: str) -> str:
    """Read the name of a CSV file to write; JSON is printed, so a name that ends so was meant for that."""
    if text.lower().endswith(".json"):
        raise wrong(f"writes CSV; for JSON: --json > {text}")
    return text


def html_file(text: str) -> str:
    """Read the name of an HTML file to write; a browser makes a PDF of it."""
    if not text.lower().endswith((".html", ".htm")):
        raise wrong(f"writes HTML, which any browser prints to PDF: name it .html (not {text!r})")
    return text


# Options that mean the same wherever they stand.

JSON = flag("--json", "print JSON, for programs, in place of text; units are in the keys")
TOOL = value("--tool", None, "NAME", "one of the geometry file's `tools` (default: its `tool`)")
WORK = value("--work", None, "NAME", "the poses' frame: one of its `work_frames`, or base (default: its `work`)")
DIRECTION = choice(
    "--direction",
    ("forward", "backward"),
    "the direction in which every axis and every strut last moved (default: not known, midway between both)",
)
NAMESPACE = value("--namespace", None, "NAME", "where the machine's nodes are (default: none)", default="")
SEPARATE = flag("--separate-joints", "platform joints at the same place are two joints, not one")
COMPENSATED = flag("--compensated", "check readings: taken with the compensation running, by the model that is checked")


def machine(default: str = "paper.yaml") -> Option:
    """Return the option that names the geometry file."""
    text = f"geometry file, or the name of a shipped one (default {default})"
    return reads("--machine", text, kind="geometry", default=default, action=StoreMachine)


MACHINE = machine()
MODEL = reads(
    "--model",
    f"model of the machine's errors: a file, the name of a shipped one, {WORDS} (default ideal)",
    kind="model",
    default="ideal",
)
OUTSIDE = value("--outside", outside_numbers, "NAME_UNIT=NUMBER,…", "where the model's table of outside numbers is "
                "looked up: elevation_deg=40,rotation_deg=6 (default: the table does not count)")  # fmt: skip
FRAMES = (MACHINE, MODEL, OUTSIDE, TOOL, WORK)
TRUTH = reads(
    "--truth",
    f"errors of the virtual machine: file, shipped name, {WORDS} (default: paper_machine for the paper's machine, "
    "random for others)",
    kind="model",
)


def table_out(what: str) -> Option:
    """Return the option for a table's CSV file."""
    return writes("--out", f"write {what} to a CSV file", type=csv_file)


def pictures(default: str | None = None) -> Option:
    """Return the option for the folder of pictures."""
    return folder("--pictures", "folder for pictures; made if it is missing" + f" (default {default})" * bool(default),
                  default=default)  # fmt: skip


def seed_of(what: str, default: int = 0) -> Option:
    """Return the option for a seed."""
    return value("--seed", seed, "N", f"of {what} (default {default})", default=default)


def readings(required: bool = True) -> tuple[Option, ...]:
    """Return the options for measured files, the machine, and how the files are read."""
    return (
        reads("files", "measured files", kind="readings", nargs="+", default=None if required else []),
        MACHINE,
        reads("--columns", "columns file that explains wide CSV files", kind="columns"),
        value("--probe-mm", point, "X,Y,Z", "measured point in platform (default: the tool's tip)"),
    )


# What a fit of scheme joint, or a plan for one, can be given; most by the name that FitSettings has for it, in SI
ESTIMATION = under(
    "scheme joint",
    value("--lead-mm", scaled(bound, 1e-3), "MM", "period of the screws' errors (default: the geometry's; else what "
          "the readings show)", dest="lead"),
    value("--blocks", None, "A,B,…", "what may be fitted: pitch, wave, harmonics, backlash, map, field, expansion, "
          "moisture, late, compliance, lost motion (default all)"),
    SEPARATE,
    value("--tolerance-um", bound, "UM", "how well joints are built, to start from, µm (default 100)"),
    choice("--tracker-frame", ("free", "known"), "free: a tracker stands anywhere, six unknowns a run (default); "
           "known: its frame is the work frame"),
    value("--field-degree", count, "N", "degree of the field (default 6)"),
    value("--expansion-ppm", expansions, "S[,B,P]", "thermal expansion of struts, or of struts, base and platform, "
          "ppm/K; a warm-up starts there (default 0)"),
    value("--moisture-ppm", scaled(bound, 1e-4), "PPM", "growth of struts by humidity, ppm per %% (1 to 5)",
          dest="strut_moisture"),
    reads("--load", "file that states stiffness and weight, as a model's block load (default: the struts are rigid)",
          kind="load"),
    value("--thermometer", None, "PART", "part whose sensor stands for all (default: the one that alone was read)"),
    value("--time-constants-s", time_constants, "S[,S]", "how late parts follow their sensors (default: sought from "
          "the readings)"),
)  # fmt: skip
