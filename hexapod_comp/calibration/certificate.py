"""A calibration certificate: one page to be filed, which says what was measured, and what the machine was and will be.

It holds what the fit's report says, and no figure that is better than the report's.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..formats.files import MAX_ARCHIVE_BYTES, read_bytes
from ..formats.pages import page, picture, shown, table
from ..formats.paths import input_file, version
from ..formats.texts import number
from ..formats.yaml import read_yaml
from ..machine.temperatures import REFERENCE_TEMPERATURE, Temperatures
from ..measurements.iso230 import (
    AXES_STANDARD,
    CIRCLE_COLUMNS,
    CIRCLES_STANDARD,
    COLUMNS,
    DIAGONALS_STANDARD,
    CircularTest,
    Judged,
    PositioningTest,
    judge,
    largest,
    notes_of,
)
from ..measurements.readings import ANGULAR_KINDS
from ..workspace.overview import corners
from .fit import ModelFit
from .observations import Cells
from .posterior import ToolError, listed
from .report import tilt_doubt

FORMAT, VERSION = "hexapod_comp/certificate", 1

COVERAGE = 2.0
"""Coverage factor k of expanded uncertainties: about 95 %."""

DETAILS = {
    "number": "certificate number",
    "customer": "customer",
    "machine": "machine's maker, type and serial number",
    "place": "place",
    "measured_on": "measured on",
    "operator": "measured by",
    "environment": "environment",
}
"""What no readings tell: keys of a details file, and what they are called. What is not given is left to be written by
hand."""

INSTRUMENTS = {
    "linear": "linear laser",
    "straightness": "straightness optics",
    "rotation": "angle optics, or level",
    "position": "tracker, position",
    "attitude": "tracker, attitude",
    "length": "length from a point: ball bar, probe, station",
    "displacement": "displacement at a ball: R-test",
}
"""What reads each kind of channel."""

MOST_RUNS = 200
"""Runs beyond these are counted, not listed."""


@dataclass(frozen=True)
class Details:
    """What the readings do not tell.

    Attributes
    ----------
    texts : dict of str to str
        By the keys of :data:`DETAILS`.
    instruments, remarks : tuple of str
        Type, serial number and calibration of each instrument; anything else.
    """

    texts: dict[str, str]
    instruments: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def load_details(path: str | Path) -> Details:
    """Read a details file: YAML, every entry text and optional, ``instruments`` and ``remarks`` lists of texts.

    Raises
    ------
    InputFileError
        Naming key, value and what is allowed.
    """
    section = read_yaml(input_file(path, "details"), FORMAT, VERSION)

    def texts(key: str) -> tuple[str, ...]:
        given = section.take(key) if key in section else []
        if not isinstance(given, list) or not all(isinstance(text, str) and text.strip() for text in given):
            raise section.error(key, "must be a list of texts", given)
        return tuple(given)

    details = Details(
        {key: section.text(key) for key in DETAILS if key in section}, texts("instruments"), texts("remarks")
    )
    section.finish()
    return details


@dataclass(frozen=True)
class Filed:
    """What was written with the certificate.

    Attributes
    ----------
    model : str
        Name of the model.
    files : tuple of Path
        The model's file, and those beside it.
    report : str
        The fit's report, as printed. With what it opens, before it says which machine this is, the certificate opens.
    """

    model: str
    files: tuple[Path, ...]
    report: str


def certificate_text(fit: ModelFit, filed: Filed, details: Details | None = None) -> str:
    """Return the certificate of a fit of scheme ``joint``, as HTML.

    Parameters
    ----------
    fit : ModelFit
        The fit.
    filed : Filed
        Model file and report, which must have been written.
    details : Details, optional
        What else is known of machine, instruments and place.

    Raises
    ------
    InputFileError
        A file cannot be read.
    """
    details = details or Details({})
    title = f"Calibration certificate: {fit.measurements.geometry.name}"
    parts = [
        f"<h1>{shown(title)}</h1>",
        *_warning(fit, filed.report),
        _identity(fit, filed, details),
        *_result(fit),
        *_instruments(fit, details),
        _measured(fit),
        *_standards(fit),
        *_pictures(fit),
        _hidden(fit),
        _files(fit, filed),
        f"<h2>The fit's report</h2><pre>{_lines(filed.report)}</pre>",
        SIGNATURES,
    ]
    return page(title, "".join(parts), STYLE)


def _lines(text: str) -> str:
    """Return a text of several lines from outside as HTML."""
    return "\n".join(shown(line, 2000) for line in text.splitlines())


def _warning(fit: ModelFit, report: str) -> Iterator[str]:
    """Yield what the report says before its headline: what is wrong."""
    m = fit.measurements
    opening = report.partition(f"machine {m.geometry.name}: {len(m)} readings")[0].strip()
    if opening:
        yield f"<p class=warning><b>Warning.</b> {_lines(opening)}</p>"


def _identity(fit: ModelFit, filed: Filed, details: Details) -> str:
    rows = [(label, details.texts.get(key, "")) for key, label in DETAILS.items()]
    rows[3:3] = [("machine in these files", fit.measurements.geometry.name), ("model", filed.model)]
    rows += [("remarks", text) for text in details.remarks]
    made = f"hexapod_comp {version()}, scheme joint, {fit.model.origin.date}"
    return table(("", ""), [*rows, ("evaluated with", made)], "text")


def _result(fit: ModelFit) -> Iterator[str]:
    """Yield the machine's error before and after compensation."""
    yield "<h2>Result</h2>"
    if fit.level is None:
        yield "<p>These readings bear no promise of what error is left.</p>"
        return
    yield (
        f"<p>Error of the tool in space at random places of the measured box, {corners(fit.space.work_box)}, both "
        "directions of approach, the datum aligned: one shift and one turn of everything taken out, as a workpiece "
        "zero does.</p>"
    )
    cases = {"level tool": fit.level, "tool tilted by 10°": fit.tilted}
    rows = [row for name, error in cases.items() if error is not None for row in _before_after(name, error)]
    header = ("quantity", "before, RMS", "after, RMS", "after, with 95 %", "after, U (k = 2)", "unit")
    yield table(header, rows)
    yield (
        "<p>Before: the machine as fitted, told nominal strut lengths. After: <b>expected</b> of the same machine with "
        "this model running, from what the readings leave uncertain; it has not been measured yet. U is twice "
        "(coverage factor k = 2) the upper end of the 95 % interval where there is one. Measuring again with the model "
        "running, at places that were not used here, confirms it.</p>"
    )
    notes = (*tilt_doubt(fit.tilted, fit.observability), *fit.notes)
    if notes:
        yield f"<ul>{''.join(f'<li><b>{shown(note, 1000)}</b></li>' for note in notes)}</ul>"


def _before_after(name: str, error: ToolError) -> Iterator[tuple[str, ...]]:
    between = f"{number(error.low * 1e6, 3)} … {number(error.high * 1e6, 3)}"
    expanded = number(COVERAGE * error.high * 1e6, 2)
    yield f"{name}: displacement", number(error.before * 1e6, 2), number(error.after * 1e6, 3), between, expanded, "µm"
    sizes = (number(error.rotation_before * 1e6, 1), number(error.rotation_after * 1e6, 2))
    between, expanded = "roll is not shown", ""
    if error.rotation_low is not None and error.rotation_high is not None:
        between = f"{number(error.rotation_low * 1e6, 2)} … {number(error.rotation_high * 1e6, 2)}"
        expanded = number(COVERAGE * error.rotation_high * 1e6, 1)
    yield f"{name}: rotation", *sizes, between, expanded, "µrad"


def _instruments(fit: ModelFit, details: Details) -> Iterator[str]:
    """Yield what read the machine, how well, and in what environment."""
    yield "<h2>Instruments and environment</h2>"
    rows = []
    for channel in fit.channels:
        sizes = [number(v * 1e6, 2) for v in (channel.stated, COVERAGE * channel.stated, channel.estimated)]
        unit = "µrad" if channel.kind in ANGULAR_KINDS else "µm"
        rows.append((INSTRUMENTS.get(channel.kind, channel.kind), str(channel.readings), *sizes, unit))
    yield table(("instrument", "readings", "u stated (k = 1)", "U stated (k = 2)", "u as fitted", "unit"), rows)
    named = details.instruments or ("",) * len(rows)
    yield table(("", "type, serial number, calibration"), [(str(n), text) for n, text in enumerate(named, 1)], "text")
    yield table(("part", "lowest °C", "highest °C", "expansion in the model, ppm/K"), _temperatures(fit))
    humidity = fit.measurements.stations.humidity
    if np.isfinite(humidity).any():
        ends = [number(100.0 * v, 1) for v in (np.nanmin(humidity), np.nanmax(humidity))]
        grown = number(1e4 * fit.model.struts.moisture.max(), 2)
        yield table(("", "lowest %", "highest %", "growth of struts, ppm per %"), [("relative humidity", *ends, grown)])


def _temperatures(fit: ModelFit) -> Iterator[tuple[str, ...]]:
    """Yield each part with its temperatures while it was measured, and its expansion."""
    values, model = fit.measurements.stations.temperatures, fit.model
    expansions = (*model.struts.expansion, model.base_expansion, model.platform_expansion)
    parts = zip(Temperatures.NAMES, values.T, expansions, strict=True)
    for name, of_part, expansion in parts:
        known = (of_part != REFERENCE_TEMPERATURE).any()
        ends = [number(v, 2) if known else "20 or not recorded" for v in (of_part.min(), of_part.max())]
        yield name, *ends, number(expansion * 1e6, 2)


def _measured(fit: ModelFit) -> str:
    """Return what was measured: how many readings of each kind on which runs."""
    m = fit.measurements
    is_line = np.array([run.is_line for run in m.runs])
    rows = [(name, str(count)) for name, count in (("lines", is_line.sum()), ("other runs", (~is_line).sum())) if count]
    rows += [("places, by direction", str(len(m.stations))), ("readings", str(len(m)))]
    rows += [("readings that disagreed and got little weight", str(len(fit.outliers)))]
    return f"<h2>What was measured</h2>{table(('', ''), rows)}"


def _standards(fit: ModelFit) -> Iterator[str]:
    """Yield the figures of the standards before and after."""
    before = judge(fit.measurements)
    after = judge(fit.measurements.with_values(left_out(fit)))
    yield "<h2>By the standards</h2>"
    if not before:
        yield (
            "<p>No figures of ISO 230: they need lines with two cycles or more, every target read from both sides "
            "in each, or circles.</p>"
        )
        return
    yield (
        "<p>Before: from the readings. After: from the same readings less what the model, fitted <b>without that "
        "line or circle</b> (a circle whose given centre is not its middle: without that place), predicts there; noise "
        "of the instrument included. The uncertainty of one reading stands above; scale errors that a whole instrument "
        "has are not in these figures.</p>"
    )
    for title, old, new in _pairs(before, after):
        yield f"<h3>{shown(title)}, µm</h3>"
        yield from _standard(old, new)
    if before.circles:
        yield f"<h3>{CIRCLES_STANDARD}, circles, µm</h3>"
        yield from _circles(before.circles, after.circles)


def _pairs(
    before: Judged, after: Judged
) -> Iterator[tuple[str, dict[str, PositioningTest], dict[str, PositioningTest]]]:
    if before.axes:
        yield f"{AXES_STANDARD}, lines along the axes, both directions", before.axes, after.axes
    for kind, tests in before.diagonals.items():
        yield f"{DIAGONALS_STANDARD}, {kind} diagonals, both directions", tests, after.diagonals[kind]


def _standard(before: dict[str, PositioningTest], after: dict[str, PositioningTest]) -> Iterator[str]:
    """Yield a table of runs: each figure before → after."""
    header = ("run", "targets × cycles", *COLUMNS.values())
    rows: list[Sequence[str]] = []
    for name, test in list(before.items())[:MOST_RUNS]:
        pairs = test.figures(), after[name].figures()
        cells = [" → ".join(number(figures[key] * 1e6, 2) for figures in pairs) for key in COLUMNS]
        rows.append((name, f"{len(test.targets)} × {test.cycles}", *cells))
    yield table(header, rows)
    if len(before) > MOST_RUNS:
        yield f"<p>And {len(before) - MOST_RUNS} more runs.</p>"
    worst = [largest(tests) for tests in (before, after)]
    ends = [f"{name[0]} {' → '.join(number(w[name] * 1e6, 2) for w in worst)} µm" for name in worst[0]]
    yield f"<p>Largest: {', '.join(ends)}.</p>"
    yield from _departures(notes_of(before))


def _departures(notes: Sequence[str]) -> Iterator[str]:
    """Yield where tests depart from the standard's."""
    if notes:
        yield f"<p class=caption>Beside the standard's test: {shown('; '.join(notes), 1500)}.</p>"


def _circles(before: dict[str, CircularTest], after: dict[str, CircularTest]) -> Iterator[str]:
    """Yield a table of circles: each figure before → after, a dash where a test cannot tell."""
    rows: list[Sequence[str]] = []
    for name, test in list(before.items())[:MOST_RUNS]:
        pairs = test.figures, after[name].figures
        cells = [
            " → ".join(number(figures[key] * 1e6, 2) for figures in pairs) if key in test.figures else "–"
            for key in CIRCLE_COLUMNS
        ]
        rows.append((name, number(test.radius * 1e3, 1), *cells))
    yield table(("run", "radius mm", *CIRCLE_COLUMNS.values()), rows)
    yield from _departures(notes_of(before))


def left_out(fit: ModelFit) -> np.ndarray:
    """Return each reading less what the model, fitted without that reading's line or pose, predicts, (N,), m or rad.

    A run's unknown zero is taken off.
    """
    m, solution = fit.measurements, fit.solution
    cell = Cells.of(m).of_reading
    weights = solution.weights / m.stated**2
    total = np.bincount(cell, weights)
    errors = solution.held_out * solution.posterior.noise[solution.problem.kind] / np.sqrt(total)
    return m.value - (np.bincount(cell, weights * m.value) / total)[cell] + errors[cell]


def _pictures(fit: ModelFit) -> Iterator[str]:
    """Yield the error maps and the residuals."""
    from .pictures import before_after_figure, residuals_by_run_figure

    yield "<h2>Pictures</h2>"
    if fit.model.region is not None:
        text = "Error in space before compensation, and what is expected after it, at three heights of the measured box"
        yield picture(text, before_after_figure(fit))
    text = "What the fit leaves of each reading, over its stated standard uncertainty; the band is ± U (k = 2)"
    yield picture(text, residuals_by_run_figure(fit))
    rows = list(_runs(fit))
    yield table(("run", "readings", "RMS, σ", "largest, σ"), rows[:MOST_RUNS])
    if len(rows) > MOST_RUNS:
        yield f"<p>And {len(rows) - MOST_RUNS} more runs.</p>"


def _runs(fit: ModelFit) -> Iterator[tuple[str, ...]]:
    """Yield each run with its residuals."""
    sigmas, runs = fit.solution.residuals / fit.measurements.stated, fit.measurements.runs
    for n, run in enumerate(runs):
        own = sigmas[fit.measurements.run == n]
        if len(own):
            sizes = (number(float(np.sqrt((own**2).mean())), 2), number(float(np.abs(own).max()), 1))
            yield f"{n + 1}: {run.name}", str(len(own)), *sizes


def _hidden(fit: ModelFit) -> str:
    """Return what the readings cannot show."""
    seen = fit.observability
    text = f"{seen.structure_rank} of {seen.structure_size} parameters of the structure are seen by these readings."
    if fit.unseen_errors:
        text += f" Errors that they do not show: {listed(fit.unseen_errors)}."
    return f"<h2>What the readings do not show</h2><p>{shown(text, 2000)}</p><p>{_lines(fit.held.report())}</p>"


def _files(fit: ModelFit, filed: Filed) -> str:
    """Return names and hashes of model and readings."""
    rows: Iterable[tuple[str, str, str]] = [
        *(("model" if n == 0 else "beside it", path.name, _sha256(path)) for n, path in enumerate(filed.files)),
        *(("readings", name, digest) for name, digest in fit.measurements.files),
    ]
    return f"<h2>Files</h2>{table(('', 'name', 'SHA-256'), rows, 'text hashes')}"


def _sha256(path: Path) -> str:
    return hashlib.sha256(read_bytes(path, MAX_ARCHIVE_BYTES)).hexdigest()


SIGNATURES = """<table class="text sign"><tbody><tr><th scope=row>evaluated by, date</th><td></td></tr>
<tr><th scope=row>released by, date</th><td></td></tr></tbody></table>"""

STYLE = """
 th[scope=row], th:first-child { text-align: left }
 th[scope=row] { white-space: normal; overflow-wrap: break-word; max-width: 28em }
 .warning { border: 3px solid #a01515; padding: 8px 12px; max-width: none; white-space: pre-line }
 .text td:nth-child(2) { min-width: 22em } .sign { margin-top: 48px } .sign td { min-width: 22em; height: 40px }
 .hashes td:last-child { font-family: monospace; word-break: break-all; min-width: 0 }
 pre { font-size: 11px; line-height: 1.3; overflow-x: auto; white-space: pre }
 @media (max-width: 700px) { .text td:nth-child(2), .sign td { min-width: 9em } table { font-size: 12px }
  th, td { padding: 2px 4px } }
 @page { size: A4; margin: 14mm }
 @media print {
  body { font-size: 10pt } main { max-width: none; padding: 0 } h1 { font-size: 16pt }
  h2 { font-size: 12pt; margin-top: 18pt; break-after: avoid } h3 { font-size: 10.5pt; break-after: avoid }
  table { font-size: 7.5pt } th, td { padding: 1pt 4pt } tr, figure { break-inside: avoid } .wide { overflow: visible }
  figcaption, .caption { font-size: 8pt } pre { font-size: 6pt; white-space: pre-wrap } p { max-width: none }
 }
"""
