"""What a check of a model prints, and what renewing it adds."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..formats.texts import aligned, number
from ..machine.region import region_json, region_text
from .changes import DATUM, FAMILIES, READING, STRUT, TEMPERATURE
from .update import Update
from .verification import NAMED, UNDECIDED, VALID, Candidate, Verification

SHOWN = 0.001
"""Kinds of change less probable than this are not listed."""

SLACK = 1e-3
"""So far outside a box, m, is still in it."""

MOST_ODDS = 1e6
"""Odds above this are all the same to a reader."""


def verification_report(result: Verification) -> str:
    """Return what check readings say of a model, for people."""
    m = result.measurements
    parts = [
        f"machine {m.geometry.name}, model {result.model.name!r}: {len(m)} check readings of {len(np.unique(m.run))} "
        f"runs, {result.independent} numbers without what the instruments leave open\n"
        f"{region_text(result.model.measured, m.geometry)}",
        "\n".join(_verdict(result)),
    ]
    if result.doubts:
        parts.insert(0, "IN DOUBT:\n" + "\n".join(f"  {doubt}" for doubt in result.doubts))
    if outside := _outside(result):
        parts.append(outside)
    if m.notes:
        parts.append("\n".join(f"note: {note}" for note in m.notes))
    if result.verdict != VALID:
        parts.append(_table(result))
    parts += [*_settling(result), "\n".join(_visible(result))]
    return "\n\n".join(parts) + "\n"


def _outside(result: Verification) -> str:
    """Return how many places lie outside the box that the model was fitted in; empty if none does."""
    region, stations = result.model.measured, result.measurements.stations
    if region is None:
        return ""
    beyond = ~region.contains(stations.positions, stations.rotations, SLACK)
    if not beyond.any():
        return ""
    return f"{beyond.sum()} of {len(beyond)} places lie outside the box in which the model was fitted"


def _verdict(result: Verification) -> Iterator[str]:
    """Yield whether the model is valid, and what has happened."""
    best = result.candidates[0]
    if result.verdict == VALID:
        yield f"VALID: a machine that has not changed reads as strangely as this in {_percent(result.usual)} of checks"
    else:
        head = {
            NAMED: f"{FAMILIES[best.family]}: {_described(best)}",
            UNDECIDED: f"either {', or '.join(FAMILIES[c.family] for c in result.candidates[:2])}",
        }.get(
            result.verdict, f"in a way that no motion of the datum, strut, temperature or ageing explains{_near(best)}"
        )
        yield f"CHANGED: {head}"
        share = f"in fewer than {_percent(result.usual)}" if result.usual < 1e-3 else f"in {_percent(result.usual)}"
        yield f"a machine that has not changed reads as strangely as this {share} of checks"
        doubted = [c.name for c in result.candidates[: 1 + (result.verdict == UNDECIDED)] if c.family == READING]
        yield from (f"take {name} again: the machine itself need not have changed" for name in doubted)
    yield f"χ² {result.chi_square:.3g} per number against the model and what its fit knows"
    if result.tool is not None:
        standing, aligned_ = (1e6 * size for size in result.tool)
        text = f"{standing:.3g} µm RMS in the measured box, {aligned_:.3g} µm with the datum aligned"
        yield f"what the most probable change does to the tool: {text}"


def _near(best: Candidate) -> str:
    return f" (nearest: {_described(best)})"


def _described(candidate: Candidate) -> str:
    """Return what a candidate is, with sizes where they mean something."""
    if candidate.change is None or not len(candidate.coefficients):
        return candidate.name
    shown = candidate.change.shown
    sizes = [
        f"{value * factor:+.3g} ± {deviation * factor:.2g} {unit}"
        for (_, factor, unit), value, deviation in zip(shown, candidate.coefficients, candidate.deviations, strict=True)
    ]
    if len(sizes) == 1:
        return f"{candidate.name} by {sizes[0]}"
    return f"{candidate.name}: " + ", ".join(f"{label} {size}" for (label, *_), size in zip(shown, sizes, strict=True))


def _table(result: Verification) -> str:
    rows = [
        (FAMILIES[c.family], number(100.0 * result.families[c.family], 1), _described(c))
        for c in result.candidates
        if result.families[c.family] >= SHOWN
    ]
    return aligned(("kind of change", "%", "its best explanation"), rows)


def _settling(result: Verification) -> Iterator[str]:
    """Yield the readings that would settle an open question."""
    if not result.settling:
        return
    first, second = (FAMILIES[c.family] for c in result.candidates[:2])
    rows = [(s.name, str(s.readings), ", ".join(s.channels), _odds(s.odds)) for s in result.settling]
    table = aligned(("read", "readings", "channels", "odds to expect"), rows)
    yield f'to tell "{first}" from "{second}", with the instruments used so far\n{table}'


def _odds(logarithm: float) -> str:
    return f"{math.exp(logarithm):.3g} : 1" if logarithm < math.log(MOST_ODDS) else "over a million : 1"


def _visible(result: Verification) -> Iterator[str]:
    """Yield the smallest changes that these readings surely show."""
    for family, name, unit in ((STRUT, "any strut's offset", "µm"), (TEMPERATURE, "growth by temperature", "ppm")):
        size = result.visible.get(family, math.inf)
        if math.isinf(size) or size > 1e-3:
            yield f"these readings do not surely show {name}"
        else:
            yield f"these readings surely show {name} from {1e6 * size:.2g} {unit} on"
    if result.visible.get(DATUM, math.inf) > 1e-3:
        yield "where base and workpiece stand as a whole these readings do not show, or not in all directions"


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"


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
        "candidates": [_candidate_json(c) for c in result.candidates],
        "tool_m": None if result.tool is None else {"standing": result.tool[0], "aligned": result.tool[1]},
        "surely_seen": {f"{k}{'' if k == TEMPERATURE else '_m'}": v for k, v in _finite(result.visible).items()},
        "settling": [
            {"read": s.name, "channels": s.channels, "readings": s.readings, "log_odds": s.odds}
            for s in result.settling
        ],
        "doubts": result.doubts,
        "notes": result.measurements.notes,
    }


def _finite(sizes: dict[str, float]) -> dict[str, float | None]:
    return {key: value if math.isfinite(value) else None for key, value in sizes.items()}


def _candidate_json(candidate: Candidate) -> dict:
    shown = candidate.change.shown if candidate.change is not None else ()
    return {
        "kind": candidate.family,
        "name": candidate.name,
        "probability": candidate.probability,
        "sizes": [
            {"name": label, "value": value * factor, "standard_error": deviation * factor, "unit": unit}
            for (label, factor, unit), value, deviation in zip(
                shown, candidate.coefficients, candidate.deviations, strict=True
            )
        ],
    }
