"""What is typed becomes numbers in SI; :mod:`argparse` says which option was wrong."""

from __future__ import annotations

import argparse
import math
import re

from ..formats.texts import number_hint

POSE_HELP = "mm and degrees: x,y,z or x,y,z,alpha,beta,gamma"

LINE_HELP = "mm and degrees: x,y,z of its start, x,y,z of its end, and the tool's alpha,beta,gamma (default 0,0,0)"

DIRECTIONS = ("forward", "backward")
"""In which every axis and every strut last moved."""

POSE_OPTIONS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
"""A pose number by number: the options of ik."""


INSTRUMENTS = (
    "linear",
    "straightness",
    "rotation",
    "5-D",
    "6-D",
    "tracker",
    "tracker_6d",
    "ball_bar",
    "station",
    "r_test",
)
"""What plan can propose runs for; a test holds it to the planner's own list, which is slow to import."""


def pose(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read ``x,y,z[,alpha,beta,gamma]`` in mm and degrees; return position, m, and angles, rad."""
    values = numbers(text)
    if len(values) not in (3, 6):
        raise argparse.ArgumentTypeError(f"needs three or six numbers ({POSE_HELP}), not {len(values)}")
    angles = values[3:] or (0.0, 0.0, 0.0)
    return tuple(v * 1e-3 for v in values[:3]), tuple(math.radians(v) for v in angles)


def point(text: str) -> tuple[float, ...]:
    """Read ``x,y,z`` in mm; return m."""
    position, angles = pose(text)
    if any(angles):
        raise argparse.ArgumentTypeError(f"needs three numbers, mm, not {text}")
    return position


def lengths(text: str) -> tuple[float, ...]:
    """Read six lengths in mm; return them in m."""
    values = numbers(text)
    if len(values) != 6:
        raise argparse.ArgumentTypeError(f"needs six lengths in mm, not {len(values)}")
    return tuple(v * 1e-3 for v in values)


def line(text: str) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Read two points in mm and, perhaps, the tool's angles in degrees; return the points, m, and the angles, rad."""
    values = numbers(text)
    if len(values) not in (6, 9):
        raise argparse.ArgumentTypeError(f"needs six or nine numbers ({LINE_HELP}), not {len(values)}")
    start, end = (tuple(v * 1e-3 for v in values[n : n + 3]) for n in (0, 3))
    if start == end:
        raise argparse.ArgumentTypeError(f"must end elsewhere than it starts, not {text}")
    return start, end, tuple(map(math.radians, values[6:] or (0.0, 0.0, 0.0)))


def box(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Read two corners in mm; return the lowest and the highest, m."""
    values = lengths(text)
    low, high = values[:3], values[3:]
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise argparse.ArgumentTypeError(f"must be the lowest corner, then the highest, not {text}")
    return low, high


def tilts(text: str) -> tuple[float, ...]:
    """Read tilts in degrees; return them in rad, rising, each once."""
    return tuple(math.radians(v) for v in sorted({finite(part) for part in text.split(",")}))


def expansions(text: str) -> tuple[float, float, float]:
    """Read one or three expansions in ppm/K; return them in 1/K, for struts, base and platform."""
    values = [finite(part) * 1e-6 for part in text.split(",")]
    if len(values) not in (1, 3):
        raise argparse.ArgumentTypeError(f"needs one or three numbers, not {text}")
    return (values[0], *(values[1:] or (0.0, 0.0)))


def time_constants(text: str) -> tuple[float, ...]:
    """Read time constants in s; return them rising."""
    return tuple(sorted(finite(part) for part in text.split(",")))


def finite(text: str) -> float:
    """Read one finite number."""
    if "," in text:
        raise _not_finite(text)
    return numbers(text)[0]


def bound(text: str) -> float:
    """Read a finite number that is not negative."""
    value = finite(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError(f"must not be negative, not {text}")
    return value


def above_zero(text: str) -> float:
    """Read a finite number above zero."""
    value = finite(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"must be above zero, not {text}")
    return value


def span(text: str) -> tuple[float, float]:
    """Read ``LOW,HIGH``, or one number that stands for 0 to it; both not negative."""
    values = numbers(text)
    low, high = (0.0, *values) if len(values) == 1 else values if len(values) == 2 else (1.0, 0.0)
    if not 0.0 <= low <= high:
        raise argparse.ArgumentTypeError(f"needs one number, or the lowest and the highest, not negative: {text}")
    return low, high


def count(text: str, most: int = 10_000_000) -> int:
    """Read a whole number above zero, and not so large that nobody lives to see the end."""
    if not text.isdecimal() or len(text) > 12 or not 1 <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to {most}, not {text!r}")
    return int(text)


def rate(text: str) -> int:
    """Read the rate of a control loop, a whole number of Hz."""
    return count(text, 10_000)


def joint_names(text: str) -> tuple[str, ...]:
    """Read six different names of joints, in strut order."""
    names = tuple(text.split(","))
    if len(set(names)) != 6 or len(names) != 6:
        raise argparse.ArgumentTypeError(f"needs six different names, in strut order, not {text}")
    strange = [name for name in names if not re.fullmatch(r"[A-Za-z_][\w/]*", name)]
    if strange:
        raise argparse.ArgumentTypeError(
            f"a name has letters, digits, _ and /, a letter or _ first, not {strange[0]!r}"
        )
    return names


def port(text: str) -> int:
    """Read a port's number."""
    return count(text, 65535)


def trials(text: str) -> int:
    """Read how many poses to check: a thousand or more."""
    value = count(text)
    if value < 1000:
        raise argparse.ArgumentTypeError(f"must be 1000 or more, not {text}")
    return value


def workers(text: str) -> int:
    """Read a number of processes; each takes some 200 MB."""
    return count(text, most=256)


def seed(text: str) -> int:
    """Read a whole number, zero or above."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, 0 or above, not {text!r}")
    return int(text)


def csv_file(text: str) -> str:
    """Read the name of a CSV file to write; JSON is printed, so a name that ends so was meant for that."""
    if text.lower().endswith(".json"):
        raise argparse.ArgumentTypeError(f"writes CSV; for JSON: --json > {text}")
    return text


def html_file(text: str) -> str:
    """Read the name of an HTML file to write; a browser makes a PDF of it."""
    if not text.lower().endswith((".html", ".htm")):
        raise argparse.ArgumentTypeError(f"writes HTML, which any browser prints to PDF: name it .html (not {text!r})")
    return text


def times(text: str) -> tuple[str, tuple[float, float, float]]:
    """Read ``NAME=MIN,MIN,S``: the times of an instrument; return its name and s."""
    name, _, values = text.partition("=")
    spent = numbers(values)
    if not name or len(spent) != 3 or min(spent) < 0.0 or spent[2] == 0.0:
        problem = f"needs a name and three numbers, not negative, the last above zero: linear=20,8,4, not {text!r}"
        raise argparse.ArgumentTypeError(problem)
    return name, (60.0 * spent[0], 60.0 * spent[1], spent[2])


def numbers(text: str) -> tuple[float, ...]:
    """Read finite numbers with commas between them."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise _not_finite(text) from None
    if not all(map(math.isfinite, values)):
        raise _not_finite(text)
    return values


def _not_finite(text: str) -> argparse.ArgumentTypeError:
    return argparse.ArgumentTypeError(f"must be finite numbers{number_hint(text)}, not {text!r}")
