"""Whether ``collect`` reports set-up mistakes of an instrument, and never reports correct readings.

Usage: python -m benchmarks.collect [--machines 60] [--workers 2] [--case NAME ...]; see doc/benchmarks.md. Exit code 1:
a mistake was not reported, or correct readings were reported as a mistake.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import drawn
from benchmarks.drawn import with_wavy_field
from benchmarks.live_machine import LiveMachine
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.measurements.campaign import Campaign, circle_run
from hexapod_comp.measurements.collect import Observation, collect
from hexapod_comp.measurements.set_up import SetUpError
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.imperfections import with_length_map
from hexapod_comp.virtual.instruments import LiveFlaws, LiveInstrument
from hexapod_comp.virtual.named import find_model

DESIGNS = ("paper", "example_6_6", "positioning_unit", "jugglebot")
LENGTH_MAP, FIELD = 50e-6, (100e-6, 500e-6)  # RMS of errors outside any model: struts, m; field, m and rad
ASIDE = Pose.from_angles([2.0, -1.0, 0.5], [0.3, 1.0, 2.5])  # pose of the free tracker in base
FIRST_POSES = 6  # poses within which a tracker's mistake must be reported
Readings = dict[str, float]
Change = Callable[[Readings], Readings]


def scaled(kinds: Collection[str], scale: float, read: Readings) -> Readings:
    """Multiply the readings of some kinds of channels by `scale`."""
    return {name: value * scale if name.partition("_")[0] in kinds else value for name, value in read.items()}


def exchanged(one: int, other: int, read: Readings) -> Readings:
    """Exchange two channels, given by their numbers."""
    names = list(read)
    order = names.copy()
    order[one], order[other] = names[other], names[one]
    return {name: read[there] for name, there in zip(names, order, strict=True)}


def turned(angle: float, read: Readings) -> Readings:
    """Turn straightness optics about the line by an angle, rad."""
    (one, a), (other, b) = [(name, value) for name, value in read.items() if name.startswith("straightness")]
    c, s = np.cos(angle), np.sin(angle)
    return {**read, one: float(c * a - s * b), other: float(s * a + c * b)}


def aside(arm: float, read: Readings) -> Readings:
    """Move the reflector by `arm`, m, away from the tool's tip."""
    about = next(name for name in read if name.startswith("rotation"))
    return {**read, "linear": read["linear"] + arm * read[about]}


def slanting(slope: float, read: Readings) -> Readings:
    """Give the beam a slope relative to the line."""
    across = next(name for name in read if name.startswith("straightness"))
    return {**read, across: read[across] + slope * read["linear"]}


STRAIGHT, ANGLES = ("straightness",), ("rotation",)
ALL, LENGTHS = ("linear", "straightness", "rotation", "length"), ("linear", "straightness", "length")
OF_LASERS: dict[str, Change] = {
    "all reversed": partial(scaled, ALL, -1.0),
    "linear reversed": partial(scaled, ("linear",), -1.0),
    "straightness reversed": partial(scaled, STRAIGHT, -1.0),
    "rotations reversed": partial(scaled, ANGLES, -1.0),
    "mm as m": partial(scaled, LENGTHS, 1e3),
    "µm as m": partial(scaled, LENGTHS, 1e6),
    "inches as mm": partial(scaled, LENGTHS, 25.4),
    "half the travel": partial(scaled, ("linear",), 0.5),
    "linear 5 % too large": partial(scaled, ("linear",), 1.05),
    "degrees": partial(scaled, ANGLES, 180.0 / np.pi),
    "arcsec": partial(scaled, ANGLES, 648e3 / np.pi),
    **{f"channels {a + 1}, {b + 1} exchanged": partial(exchanged, a, b) for a in range(5) for b in range(a)},
    "optics turned by 15°": partial(turned, np.radians(15.0)),
    "reflector 50 mm aside": partial(aside, 0.05),
    "beam 5° off": partial(slanting, np.tan(np.radians(5.0))),
}
OF_BARS: dict[str, Change] = {
    "reversed": partial(scaled, ("length",), -1.0),
    **{name: OF_LASERS[name] for name in ("mm as m", "µm as m", "inches as mm")},
}
TURN = Rotation.from_euler("x", 5.0, degrees=True).as_matrix()
OF_TRACKERS: dict[str, Callable[[Pose], Pose]] = {
    "mm as m": lambda p: Pose(p.position * 1e3, p.rotation),
    "inches as mm": lambda p: Pose(p.position * 25.4, p.rotation),
    "reversed": lambda p: Pose(-p.position, p.rotation),
    "x, y exchanged": lambda p: Pose(p.position[[1, 0, 2]], p.rotation),
    "z reversed": lambda p: Pose(p.position * [1.0, 1.0, -1.0], p.rotation),
}
OF_KNOWN = {
    **OF_TRACKERS,
    "frame turned by 5°": lambda p: Pose(TURN @ p.position, TURN @ p.rotation),
    "origin 20 mm off": lambda p: Pose(p.position + np.array([0.0, 0.02, 0.0]), p.rotation),
    "target 20 mm aside": lambda p: Pose(p.position + 0.02 * p.rotation[:, 0], p.rotation),
    "target turned by 5°": lambda p: Pose(p.position, p.rotation @ TURN),
}


@dataclass(frozen=True)
class Case:
    """An instrument and the set-up mistakes that are tried on it."""

    name: str
    kind: str
    components: str
    mistakes: Mapping[str, Callable]
    frame: str = "known"


CASES = (
    Case("5-D laser", "laser", "5-D", OF_LASERS),
    Case("6-D laser", "laser", "6-D", OF_LASERS),
    Case("ball bar", "ball_bar", "5-D", OF_BARS),
    Case("tracker in base", "tracker", "5-D", OF_KNOWN),
    Case("tracker anywhere", "tracker", "5-D", OF_TRACKERS, "free"),
)


class Wrong(LiveMachine):
    """A machine with a set-up mistake, which changes its readings."""

    change: Callable | None = None

    def observe(self) -> Observation | None:
        seen = super().observe()
        if seen is None or self.change is None:
            return seen
        if seen.pose is not None:
            return seen._replace(pose=self.change(seen.pose))
        read = self.change({name: value for name, (value, _) in seen.channels.items()})
        return seen._replace(channels={name: (value, 1e-7) for name, value in read.items()})


def truth_of(geometry: HexapodGeometry, seed: int) -> MachineModel:
    """Return a machine's hidden errors; an even seed also draws errors that no model contains."""
    truth = find_model(f"random:{seed}", geometry)
    if seed % 2:
        return truth
    half = 0.3 * geometry.characteristic_length
    box = geometry.home.position + half * np.array([[-1.0] * 3, [1.0] * 3])
    return with_wavy_field(with_length_map(truth, geometry, seed, rms=LENGTH_MAP), box, seed, *FIELD)


def campaign_of(case: Case, geometry: HexapodGeometry) -> Campaign:
    """Return a campaign near home, in a box of a tenth of the machine's size."""
    home = geometry.tool_pose(geometry.home)
    half = 0.1 * geometry.characteristic_length
    box = home.position + half * np.array([[-1.0] * 3, [1.0] * 3])
    kept = {"cell": 2.0 * half, "step": half / 2.0, "diagonals": 0, "level": home.rotation}
    if case.kind == "laser":
        return Campaign(box, instrument=case.components, **kept)
    if case.kind == "tracker":
        return Campaign(box, instrument=None, poses=24, tilt=np.radians(5.0), **kept)
    runs = [circle_run(f"circle {n}", home.position, half, 12, np.eye(3)[[n, n - 1]], home.rotation) for n in range(3)]
    return Campaign(box, instrument=None, runs=tuple(runs), **kept)


def outcomes(number: int, seed: int) -> Counter[str]:
    """Count mistakes that were reported, reported late or not reported, and correct readings called a mistake."""
    case = CASES[number]
    geometry = load_geometry(DESIGNS[seed % len(DESIGNS)])
    truth, campaign, counts = truth_of(geometry, seed), campaign_of(case, geometry), Counter[str]()
    for name, change in (("", None), *[*case.mistakes.items()][seed % 4 :: 4]):
        stands = ASIDE if case.frame == "free" else Pose.from_angles([0.002, -0.003, 0.001], [0.005, -0.005, 0.005])
        flaws = LiveFlaws(wild_share=0.01, centre_off=3e-3)
        instrument = LiveInstrument(geometry, case.kind, case.components, flaws, stands, seed)
        machine, rng, visited = Wrong(geometry, truth, instrument), np.random.default_rng(seed), list[str]()
        machine.change = change
        machine.broken, machine.silent = ({*rng.integers(10, 300, 3).tolist()} for _ in range(2))
        with TemporaryDirectory() as folder:
            try:
                note = lambda done, of, where, visited=visited: visited.append(where)  # noqa: E731
                file = Path(folder) / "out.csv"
                collect(campaign, geometry, machine, file, progress=note, tracker_frame=case.frame)
            except SetUpError as error:
                at_once = len({where.partition(",")[0] for where in visited}) == 1
                at_once &= case.kind != "tracker" or len(visited) <= FIRST_POSES
                counts["accused" if not name else "reported" if at_once else f"late: {name}"] += 1
                if not name:
                    counts[f"accused: {error}"] += 1
            else:
                counts[f"not reported: {name}" if name else "right"] += 1
    return counts


def main() -> int:
    parser = drawn.options(__doc__, 60)
    names = [case.name for case in CASES]
    parser.add_argument("--case", choices=names, action="append", help="run this instrument only (default: all)")
    args = parser.parse_args()
    table = drawn.Table(["instrument", "machines", "mistakes made", "reported at once", "right readings accused"])
    for number, results in drawn.results(outcomes, [names.index(name) for name in args.case or names], args):
        counts = sum(results, Counter[str]())
        made = counts.total() - sum(counts[name] for name in counts if name.startswith(("accused", "right")))
        met = counts["reported"] >= made and not counts["accused"]
        right = f"{counts['accused']} of {counts['accused'] + counts['right']}"
        table.row(names[number], len(results), made, counts["reported"], right, met=met)
        for name in sorted(counts.keys() - {"accused", "right", "reported"}):
            drawn.show(f"  {name}: {counts[name]}")
    return 0 if table.met else 1


if __name__ == "__main__":
    sys.exit(main())
