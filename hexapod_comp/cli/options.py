"""Options of the command line: declarations, readers of values, and rules for combinations. Help, completions, lists of
files, and messages about wrong combinations are made from the declarations in this module. This module imports no slow
module, so that help and completions are fast.
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
LINE_HELP = "mm and degrees: start x,y,z, end x,y,z, and the tool's alpha,beta,gamma (default 0,0,0)"
SHAPE, LINE_SHAPE = "X,Y,Z[,A,B,C]", "X,Y,Z,X,Y,Z[,A,B,C]"
WORDS = "ideal, random or random:SEED"  # in place of a model file


@dataclass(frozen=True)
class Option:
    """An option (``--name``) or a positional argument."""

    name: str
    help: str
    keywords: dict[str, Any] = field(default_factory=dict)  # for argparse: type, metavar, default, nargs, …
    role: str = ""  # "reads": a file to read; "writes": a file to write; "folder": a folder to write into; "": no path
    kind: str = ""  # kind of shipped files that the option accepts; see formats.paths.shipped_names
    heading: str = ""  # heading of the option's group in the help; empty: no group

    @property
    def dest(self) -> str:
        return str(self.keywords.get("dest", self.name.lstrip("-").replace("-", "_")))

    @property
    def label(self) -> str:
        return self.name if self.name.startswith("-") else str(self.keywords.get("metavar", self.name))

    def given(self, args: argparse.Namespace) -> bool:
        """Return whether the option's value differs from the default."""
        given = getattr(args, self.dest)
        return given is not None and given is not False and given != [] and given != self.keywords.get("default")


def flag(name: str, text: str) -> Option:
    return Option(name, text, {"action": "store_true"})


def value(name: str, read: Callable[[str], Any] | None, metavar: str, text: str, **more: Any) -> Option:
    """Return an option with a value, which `read` converts from text."""
    return Option(name, text, {"metavar": metavar, **({} if read is None else {"type": read}), **more})


def choice(name: str, words: Sequence[str], text: str, default: str | None = None) -> Option:
    return Option(name, text, {"choices": words, "default": default})


def reads(name: str, text: str, metavar: str = "FILE", kind: str = "", **more: Any) -> Option:
    """Return an option for an input: a file, a shipped file of the kind `kind`, or a bag's folder."""
    return Option(name, text, {"metavar": metavar, **more}, "reads", kind)


def writes(name: str, text: str, metavar: str = "FILE", **more: Any) -> Option:
    return Option(name, text, {"metavar": metavar, **more}, "writes")


def folder(name: str, text: str, **more: Any) -> Option:
    return Option(name, text, {"metavar": "FOLDER", **more}, "folder")


def under(heading: str, *options: Option) -> tuple[Option, ...]:
    return tuple(replace(option, heading=heading) for option in options)


class Assumptions(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from ..calibration.assumptions import ASSUMED
        from ..calibration.blocks import ERRORS

        for name, value, what, source in ASSUMED.rows():
            print(f"{name} = {value}: {what} ({source})")
        for block in ERRORS:
            unit = "" if block.unit == "1" else f" {block.unit}"
            value = f"{block.tolerance:g}{unit}: the fit starts from this value"
            stated = "stated_stiffness times the stated compliance: the fit does not change this value"
            print(f"tolerance of {block.name} = {stated if block.stated else value}")
        parser.exit()


class StoreMachine(argparse.Action):
    def __call__(self, _: object, namespace: argparse.Namespace, given: Any, __: str | None = None) -> None:
        namespace.machine, namespace.machine_given = given, True


class Rule(NamedTuple):
    """A rule for combinations of options. An entry of `options` is an option, an option with a value, such as
    "--scheme lines", or several options of which one suffices, such as "--linuxcnc or --table"."""

    kind: str
    options: tuple[str, ...]

    def problem(self, given: Callable[[str], bool], label: Callable[[str], str]) -> str:
        by, others = self.options[0], self.options[1:]
        here = [name for name in self.options if given(name)]
        first = next((label(name) for name in others if given(name)), "") if self.kind in (NEEDS, EXCLUDES) else ""
        if self.kind == EXACTLY_ONE and len(here) != 1:
            return f"give exactly one of {', '.join(map(label, self.options))}"
        if self.kind == SOME and not here:
            return f"at least one of {', '.join(map(label, self.options))} is needed"
        if self.kind == NEEDS and first and not given(by):
            return f"{first} needs {label(by)}"
        if self.kind == EXCLUDES and first and given(by):
            return f"{first} cannot be combined with {label(by)}"
        return ""


EXACTLY_ONE, SOME, NEEDS, EXCLUDES = "exactly one", "some", "needs", "excludes"


def _rule(kind: str, *options: str) -> Rule:
    return Rule(kind, options)


exactly_one = partial(_rule, EXACTLY_ONE)
some_of = partial(_rule, SOME)  # at least one option must be given
needed_by = partial(_rule, NEEDS)  # the second and later options need the first option
excluded_by = partial(_rule, EXCLUDES)  # the first option excludes the second and later options


# Readers of an option's value, which return numbers in SI; argparse adds the option's name to their errors.

OptionError = argparse.ArgumentTypeError


def numbers(text: str, counts: tuple[int, ...] = (), what: str = "") -> tuple[float, ...]:
    """Read finite numbers separated by commas; `counts` lists the allowed counts of numbers (empty: any count)."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise OptionError(f"must be finite numbers{number_hint(text)}, not {text!r}")
    if counts and len(values) not in counts:
        raise OptionError(f"needs {what}, found {len(values)}")
    return values


def outside_numbers(text: str) -> dict[str, float]:
    """Read values of external quantities, such as ``elevation_deg=40,rotation_deg=6``; each name ends in its unit."""
    parts = [part.partition("=") for part in text.split(",")]
    if not all(name.strip() and mark for name, mark, _ in parts):
        raise OptionError(f"must be NAME_UNIT=NUMBER, such as elevation_deg=40,rotation_deg=6, not {text!r}")
    return {name.strip(): finite(number) for name, _, number in parts}


def vector(text: str) -> tuple[float, ...]:
    return numbers(text, (3,), "three numbers")


def finite(text: str) -> float:
    try:
        return numbers("" if "," in text else text)[0]
    except argparse.ArgumentTypeError:
        raise OptionError(f"must be a finite number{number_hint(text)}, not {text!r}") from None


def bound(text: str) -> float:
    if (number := finite(text)) < 0.0:
        raise OptionError(f"must not be negative, not {text}")
    return number


def above_zero(text: str) -> float:
    if (number := finite(text)) <= 0.0:
        raise OptionError(f"must be above zero, not {text}")
    return number


def scaled(read: Callable[[str], Any], size: float) -> Callable[[str], Any]:
    """Return a function that reads a text with `read` and multiplies the numbers by `size`, the option's unit in SI."""

    def in_si(text: str) -> Any:
        value = read(text)
        return tuple(size * v for v in value) if isinstance(value, tuple) else size * value

    return in_si


def span(text: str) -> tuple[float, float]:
    """Read a range ``LOW,HIGH``, or ``HIGH`` for the range from 0 to HIGH; refuse negative numbers."""
    values = numbers(text)
    low, high = values[0] if len(values) > 1 else 0.0, values[-1]
    if len(values) > 2 or not 0.0 <= low <= high:
        raise OptionError(f"must be HIGH or LOW,HIGH with 0 ≤ LOW ≤ HIGH, not {text}")
    return low, high


def whole(low: int, high: int = 10_000_000) -> Callable[[str], int]:
    def whole_number(text: str) -> int:
        if not text.isdecimal() or not low <= float(text) <= high:  # int() raises for very long texts
            raise OptionError(f"must be a whole number from {low} to {high}, not {text!r}")
        return int(text)

    return whole_number


count = whole(1)


def seed(text: str) -> int:
    if not text.isdecimal():
        raise OptionError(f"must be a whole number, 0 or above, not {text!r}")
    return int(text)


def pose(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read ``x,y,z[,alpha,beta,gamma]`` in mm and degrees; return position, m, and angles, rad."""
    values = numbers(text, (3, 6), f"three or six numbers ({POSE_HELP})")
    return tuple(v * 1e-3 for v in values[:3]), tuple(map(math.radians, values[3:] or (0.0, 0.0, 0.0)))


point = scaled(partial(numbers, counts=(3,), what="three numbers, mm"), 1e-3)
lengths = scaled(partial(numbers, counts=(6,), what="six lengths, mm"), 1e-3)
corners = scaled(partial(numbers, counts=(6,), what="six numbers, mm (lowest x,y,z, highest x,y,z)"), 1e-3)


def line(text: str) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Read a line's start and end, mm, and optional tool angles, degrees; return all three, in m and rad."""
    values = numbers(text, (6, 9), f"six or nine numbers ({LINE_HELP})")
    start, end = (tuple(v * 1e-3 for v in values[n : n + 3]) for n in (0, 3))
    if start == end:
        raise OptionError(f"must have an end that differs from the start, not {text}")
    return start, end, tuple(map(math.radians, values[6:] or (0.0, 0.0, 0.0)))


def box(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read the lowest and the highest corner of a box, mm; return both in m."""
    low, high = corners(text)[:3], corners(text)[3:]
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise OptionError(f"must be the lowest x,y,z, then the highest x,y,z, not {text}")
    return low, high


def tilts(text: str) -> tuple[float, ...]:
    """Read tilts, degrees; return sorted tilts, rad, without duplicates."""
    return tuple(math.radians(v) for v in sorted(set(numbers(text))))


def expansions(text: str) -> tuple[float, float, float]:
    """Read thermal expansions, ppm/K, of the struts, and optionally of base and platform; return all three, 1/K."""
    first, *others = (v * 1e-6 for v in numbers(text, (1, 3), "one or three numbers"))
    return (first, *(others or (0.0, 0.0)))


def time_constants(text: str) -> tuple[float, ...]:
    return tuple(sorted(numbers(text)))


def times(text: str) -> tuple[str, tuple[float, float, float]]:
    """Read ``NAME=SETUP,RUN,STOP``: an instrument's name and times (min, min, s); return both, with the times in s."""
    name, mark, values = text.partition("=")
    spent = numbers(values) if mark else ()
    if not name or len(spent) != 3 or min(spent) < 0.0 or spent[2] == 0.0:
        wanted = "must be NAME=SETUP,RUN,STOP in minutes, minutes and seconds (≥ 0, ≥ 0, > 0), such as linear=20,8,4"
        raise OptionError(f"{wanted}, not {text!r}")
    return name, (60.0 * spent[0], 60.0 * spent[1], spent[2])


def joint_names(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    if len(set(names)) != 6 or len(names) != 6:
        raise OptionError(f"needs six different names, in the order of the struts, not {text}")
    strange = [name for name in names if not re.fullmatch(r"[A-Za-z_][\w/]*", name)]
    if strange:
        raise OptionError(f"a name must be a letter or _, then letters, digits, _ or /, not {strange[0]!r}")
    return names


def csv_file(text: str) -> str:
    if text.lower().endswith(".json"):
        raise OptionError(f"must not end in .json, because this file is CSV; for JSON: --json > {text}")
    return text


def html_file(text: str) -> str:
    if not text.lower().endswith((".html", ".htm")):
        raise OptionError(f"must end in .html (a browser prints the page to PDF), not {text!r}")
    return text


# Options with the same meaning in every verb that has them.

JSON = flag("--json", "print the result as JSON in place of text; units are in the keys")
TOOL = value("--tool", None, "NAME", "name of a tool in `tools` of the geometry file (default: the frame `tool`)")
WORK = value("--work", None, "NAME", "frame of the poses: base, or a name in `work_frames` of the geometry file "
             "(default: the frame `work`)")  # fmt: skip
DIRECTION = choice(
    "--direction",
    ("forward", "backward"),
    "direction in which every axis and every strut last moved (default: the mean of both directions)",
)
NAMESPACE = value("--namespace", None, "NAME", "namespace of the machine's nodes (default: none)", default="")
SEPARATE = flag("--separate-joints", "give each strut its own platform joint, also where two platform joints coincide")
COMPENSATED = flag("--compensated", "the check readings were taken with compensation on, with the model to be checked")


def machine(default: str = "paper.yaml") -> Option:
    text = f"geometry file, or the name of a shipped file (default {default})"
    return reads("--machine", text, kind="geometry", default=default, action=StoreMachine)


MACHINE = machine()
MODEL = reads(
    "--model",
    f"model of the machine's errors: a file, the name of a shipped file, {WORDS} (default ideal)",
    kind="model",
    default="ideal",
)
OUTSIDE = value("--outside", outside_numbers, "NAME_UNIT=NUMBER,…", "values of the external quantities of the model's "
                "table, such as elevation_deg=40,rotation_deg=6 (default: the table is not used)")  # fmt: skip
FRAMES = (MACHINE, MODEL, OUTSIDE, TOOL, WORK)
TRUTH = reads(
    "--truth",
    f"errors of the virtual machine: a file, the name of a shipped file, {WORDS} (default: paper_machine for the "
    "machine `paper`, random for other machines)",
    kind="model",
)


def table_out(what: str) -> Option:
    return writes("--out", f"write {what} to a CSV file", type=csv_file)


def pictures(default: str | None = None) -> Option:
    return folder("--pictures", "folder for pictures; created if missing" + f" (default {default})" * bool(default),
                  default=default)  # fmt: skip


def seed_of(what: str, default: int = 0) -> Option:
    return value("--seed", seed, "N", f"seed of {what} (default {default})", default=default)


def readings(required: bool = True) -> tuple[Option, ...]:
    return (
        reads("files", "files of readings", kind="readings", nargs="+", default=None if required else []),
        MACHINE,
        reads("--columns", "YAML file that describes the columns of wide CSV files", kind="columns"),
        value("--probe-mm", point, "X,Y,Z", "measured point, in the frame `platform` (default: the tool's tip)"),
    )


# Options of `fit --scheme joint`, and of `plan` for such a fit; `dest` may be a field of FitSettings: then an option
# returns the field's SI value
ESTIMATION = under(
    "scheme joint",
    value("--lead-mm", scaled(bound, 1e-3), "MM", "period of the screws' errors (default: the lead in the geometry "
                                                  "file; if it has none, estimated from the readings)", dest="lead"),
    value("--blocks", None, "A,B,…", "errors that may be fitted: pitch, wave, harmonics, backlash, map, backlash map, "
          "field, expansion, moisture, late, compliance, lost motion, friction (default all)"),
    SEPARATE,
    value("--tolerance-um", bound, "UM", "expected size of the joints' position errors, µm, at the start of the fit "
                                         "(default 100)"),
    choice("--tracker-frame", ("free", "known"), "free: the tracker's frame is estimated, six parameters per run "
                                                 "(default); known: the tracker's frame is the work frame"),
    value("--field-degree", whole(1, 8), "N", "degree of the field's polynomials, 1 to 8 (default 6)"),
    value("--expansion-ppm", expansions, "S[,B,P]", "thermal expansion of struts, or of struts, base and platform, "
                                                    "ppm/K; if a warm-up is fitted, the fit starts from these values "
                                                    "(default 0)"),
    value("--moisture-ppm", scaled(bound, 1e-4), "PPM", "growth of struts by humidity, ppm per %% (usual: 1…5)",
          dest="strut_moisture"),
    reads("--load", "file of stiffness and weight, with the keys of a model's block load (default: struts are rigid)",
          kind="load"),
    value("--thermometer", None, "PART", "part whose sensor gives the temperature of all parts (default: the only part "
                                         "with data)"),
    value("--time-constants-s", time_constants, "S[,S]", "time constants, s, with which parts' temperatures follow "
                                                         "their sensors (default: estimated)", dest="time_constants"),
)  # fmt: skip
