"""What a check of a model prints, and what renewing it adds."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..formats.texts import aligned, number
from ..machine.region import region_json, region_text
from .changes import DATUM, FAMILIES, READING, STRUT, TEMPERATURE
from .check import NAMED, UNDECIDED, VALID, Candidate, Update, Verification


def verification_report(result: Verification) -> str:
    """Return what check readings say of a model, for people."""
    m, region = result.measurements, result.model.measured
    parts = [
        f"machine {m.geometry.name}, model {result.model.name!r}: {len(m)} check readings of {len(np.unique(m.run))} "
        f"runs, {result.independent} numbers without what the instruments leave open\n"
        f"{region_text(region, m.geometry)}",
        "\n".join(_verdict(result)),
    ]
    if result.doubts:
        parts.insert(0, "IN DOUBT:\n" + "\n".join(f"  {doubt}" for doubt in result.doubts))
    slack = 1e-3  # m: so far outside the box is still in it
    inside = region is None or region.contains(m.stations.positions, m.stations.rotations, slack)
    if not np.all(inside):
        outside = np.logical_not(inside)
        parts.append(f"{outside.sum()} of {outside.size} places lie outside the box in which the model was fitted")
    if m.notes:
        parts.append("\n".join(f"note: {note}" for note in m.notes))
    if result.verdict != VALID:
        least = 0.001  # kinds of change less probable than this are not listed
        rows = [
            (FAMILIES[c.family], number(100.0 * result.families[c.family], 1), _described(c))
            for c in result.candidates
            if result.families[c.family] >= least
        ]
        parts.append(aligned(("kind of change", "%", "its best explanation"), rows))
    if result.settling:
        first, second = (FAMILIES[c.family] for c in result.candidates[:2])
        reads = [(s.name, str(s.readings), ", ".join(s.channels), _odds(s.odds)) for s in result.settling]
        table = aligned(("read", "readings", "channels", "odds to expect"), reads)
        parts.append(f'to tell "{first}" from "{second}", with the instruments used so far\n{table}')
    return "\n\n".join([*parts, "\n".join(_visible(result))]) + "\n"


def _verdict(result: Verification) -> Iterator[str]:
    """Yield whether the model is valid, and what has happened."""
    best, percent = result.candidates[0], f"{100.0 * result.usual:.2g} %"
    if result.verdict == VALID:
        yield f"VALID: a machine that has not changed reads as strangely as this in {percent} of checks"
    else:
        nothing = "in a way that no motion of the datum, strut, temperature or ageing explains"
        yield "CHANGED: " + {
            NAMED: f"{FAMILIES[best.family]}: {_described(best)}",
            UNDECIDED: f"either {', or '.join(FAMILIES[c.family] for c in result.candidates[:2])}",
        }.get(result.verdict, f"{nothing} (nearest: {_described(best)})")
        share = f"in {'fewer than ' if result.usual < 1e-3 else ''}{percent}"
        yield f"a machine that has not changed reads as strangely as this {share} of checks"
        doubted = [c.name for c in result.candidates[: 1 + (result.verdict == UNDECIDED)] if c.family == READING]
        yield from (f"take {name} again: the machine itself need not have changed" for name in doubted)
    yield f"χ² {result.chi_square:.3g} per number against the model and what its fit knows"
    if result.tool is not None:
        standing, with_datum = (1e6 * size for size in result.tool)
        text = f"{standing:.3g} µm RMS in the measured box, {with_datum:.3g} µm with the datum aligned"
        yield f"what the most probable change does to the tool: {text}"


def _described(candidate: Candidate) -> str:
    """Return what a candidate is, with sizes where they mean something."""
    shown = candidate.change.shown
    sizes = [
        f"{value * factor:+.3g} ± {deviation * factor:.2g} {unit}"
        for (_, factor, unit), value, deviation in zip(shown, candidate.coefficients, candidate.deviations, strict=True)
    ]
    if len(sizes) < 2:
        return " by ".join((candidate.name, *sizes))
    return f"{candidate.name}: " + ", ".join(f"{label} {size}" for (label, *_), size in zip(shown, sizes, strict=True))


def _odds(logarithm: float) -> str:
    most = 1e6  # odds above this are all the same to a reader
    return f"{math.exp(logarithm):.3g} : 1" if logarithm < math.log(most) else "over a million : 1"


def _visible(result: Verification) -> Iterator[str]:
    """Yield the smallest changes that these readings surely show."""
    most = 1e-3  # m or m/m: larger ones are not worth naming
    for family, name, unit in ((STRUT, "any strut's offset", "µm"), (TEMPERATURE, "growth by temperature", "ppm")):
        size = result.visible.get(family, math.inf)
        if size > most:
            yield f"these readings do not surely show {name}"
        else:
            yield f"these readings surely show {name} from {1e6 * size:.2g} {unit} on"
    if result.visible.get(DATUM, math.inf) > most:
        yield "where base and workpiece stand as a whole these readings do not show, or not in all directions"


def update_report(update: Update, written: str) -> str:
    """Return what renewing a model did, for people."""
    head = (
        f"renewed; χ² of the readings against the new model: {update.chi_square:.3g} per number, by their noise alone"
    )
    held = update.fitted.held
    return "\n\n".join([head, *([held.report()] if held else []), f"model: {written}\n"])


def verification_json(result: Verification) -> dict:
    """Return a check as plain numbers; SI units are in the keys, or stand beside numbers as ``unit``."""
    return {
        "machine": result.measurements.geometry.name,
        "model": result.model.name,
        "verdict": result.verdict,
        "measured_box": region_json(result.model.measured, result.measurements.geometry),
        "readings": len(result.measurements),
        "independent": result.independent,
        "chi_square": result.chi_square,
        "unchanged_reads_so": result.usual,
        "false_alarms": result.false_alarms,
        "probabilities": result.families,
        "candidates": [
            {
                "kind": c.family,
                "name": c.name,
                "probability": c.probability,
                "sizes": [
                    {"name": label, "value": value * factor, "standard_error": deviation * factor, "unit": unit}
                    for (label, factor, unit), value, deviation in zip(
                        c.change.shown, c.coefficients, c.deviations, strict=True
                    )
                ],
            }
            for c in result.candidates
        ],
        "tool_m": None if result.tool is None else {"standing": result.tool[0], "aligned": result.tool[1]},
        "surely_seen": {
            f"{kind}{'' if kind == TEMPERATURE else '_m'}": size if math.isfinite(size) else None
            for kind, size in result.visible.items()
        },
        "settling": [
            {"read": s.name, "channels": s.channels, "readings": s.readings, "log_odds": s.odds}
            for s in result.settling
        ],
        "doubts": result.doubts,
        "notes": result.measurements.notes,
    }
