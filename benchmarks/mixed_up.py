"""Whether a mistake in the readings is named, also on machines with errors that no model contains.

Usage: python -m benchmarks.mixed_up [--machines 4] [--first 600] [--workers 2] [--kind NAME ...]; see doc/benchmarks.md
Blocks are selected and mistakes are searched, without a fit. Exit code 1: a mistake was named for correct readings.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from benchmarks import drawn
from benchmarks.calibration import LEAD
from benchmarks.promise import FOREIGN, KNOWN, OWN, setting
from hexapod_comp.calibration.fit import mixed_up
from hexapod_comp.calibration.mistakes import RUN_FAMILIES, family_of_run
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.measurements.readings import CHANNELS, MeasurementSet

# Changes of the readings by the mistake that must be reported; empty name: no change
MADE = {
    "": lambda m: m,
    "rotation_x and rotation_y: exchanged": lambda m: exchanged(m, "rotation_x", "rotation_y"),
    "rotation_y and rotation_z: exchanged": lambda m: exchanged(m, "rotation_y", "rotation_z"),
    "x lines, straightness_y and straightness_z: exchanged": lambda m: exchanged(
        m, "straightness_y", "straightness_z", "x lines"
    ),
    "x lines, rotation_y: sign reversed": lambda m: reversed_sign(m, "rotation_y", "x lines"),
    "y lines, straightness_z: sign reversed": lambda m: reversed_sign(m, "straightness_z", "y lines"),
}


def of_family(m: MeasurementSet, family: str) -> np.ndarray:
    """Return the mask, (N,), of the readings of a family of runs; "" stands for all families."""
    return np.ones(len(m), dtype=bool) if not family else family_of_run(m)[m.run] == RUN_FAMILIES.index(family)


def exchanged(m: MeasurementSet, one: str, other: str, family: str = "") -> MeasurementSet:
    a, b = CHANNELS.index(one), CHANNELS.index(other)
    where = np.isin(m.channel, (a, b)) & of_family(m, family)
    return replace(m, channel=np.where(where, a + b - m.channel, m.channel))


def reversed_sign(m: MeasurementSet, channel: str, family: str) -> MeasurementSet:
    where = (m.channel == CHANNELS.index(channel)) & of_family(m, family)
    return m.with_values(np.where(where, -m.value, m.value))


def first_named(kind: str, seed: int) -> list[str]:
    """Return the first mistake that is named, "" for none, for each change of a machine's readings."""
    readings = setting(kind, seed, ("5-D", 4))[-1]
    settings = FitSettings(blocks=KNOWN, lead=LEAD)
    return [next(iter(mixed_up(change(readings), settings)), "") for change in MADE.values()]


def main() -> int:
    parser = drawn.options(__doc__, 4, 600, "kind")
    parser.add_argument("--kind", nargs="+", choices=(*OWN, *FOREIGN), help="run these kinds only")
    args = parser.parse_args()
    causes = [found for _, done in drawn.results(first_named, args.kind or (*OWN, *FOREIGN), args) for found in done]
    table = drawn.Table(["made", "machines", "named", "another named"])
    for made, named in zip(MADE, zip(*causes, strict=True), strict=True):
        right = sum(bool(made) and cause.startswith(made) for cause in named)
        other = sum(map(bool, named)) - right
        table.row(made or "nothing", len(named), right, other, met=bool(made) or not other)
    return 0 if table.met else 1


if __name__ == "__main__":
    sys.exit(main())
