"""A calibration certificate: one HTML page with the figures of the fit's report, to be filed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from ..formats.files import MAX_ARCHIVE_BYTES, read_bytes
from ..formats.pages import render
from ..formats.paths import input_file, version
from ..formats.schema import Names, Text, read_whole
from ..formats.texts import number
from ..formats.yaml import read_yaml
from ..machine.temperatures import Temperatures
from ..measurements.iso230 import (
    AXES_STANDARD,
    CIRCLE_COLUMNS,
    CIRCLES_STANDARD,
    COLUMNS,
    DIAGONALS_STANDARD,
    Judged,
    figure_cells,
    judge,
    largest,
    notes_of,
)
from ..workspace.overview import corners
from .fit import ModelFit
from .observations import MeanReadings
from .posterior import listed
from .report import tilt_doubt

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT, VERSION = "hexapod_comp/certificate", 1
COVERAGE = 2.0  # coverage factor k of expanded uncertainties: a probability of about 95 %
MOST_RUNS = 200  # largest number of runs that the certificate lists; of more runs it states the number only


@dataclass(frozen=True)
class Details:
    """Content of a details file: facts that readings do not contain; the certificate has blanks for missing facts."""

    number: Annotated[str, Text()] = ""
    customer: Annotated[str, Text()] = ""
    machine: Annotated[str, Text()] = ""
    place: Annotated[str, Text()] = ""
    measured_on: Annotated[str, Text()] = ""
    operator: Annotated[str, Text()] = ""
    environment: Annotated[str, Text()] = ""
    # for each instrument: type, serial number, calibration
    instruments: Annotated[tuple[str, ...], Names(what="texts")] = ()
    remarks: Annotated[tuple[str, ...], Names(what="texts")] = ()


def load_details(path: str | Path) -> Details:
    return read_whole(Details, read_yaml(input_file(path, "details"), FORMAT, VERSION))


def certificate_text(
    fit: ModelFit, model: str, files: Sequence[Path], report: str, details: Details | None = None
) -> str:
    """Return the certificate as HTML; `files`: the model file, then the files beside it.

    The certificate begins with the warnings of `report`, which are its text before the line "machine …".
    """
    m, details, seen = fit.measurements, details or Details(), fit.observability
    unseen = f"{seen.structure_rank} of {seen.structure_size} combinations of structure parameters are observable."
    if fit.unseen_errors:
        unseen += f" Errors that the readings do not show: {listed(fit.unseen_errors)}."
    hashes = [hashlib.sha256(read_bytes(path, MAX_ARCHIVE_BYTES)).hexdigest() for path in files]
    beside = ["model", *("beside it" for _ in files[1:])]
    named = [(what, path.name, digest) for what, path, digest in zip(beside, files, hashes, strict=True)]
    humidity = m.stations.humidity[np.isfinite(m.stations.humidity)]
    damp = [number(100.0 * v, 1) for v in (humidity.min(), humidity.max())] if len(humidity) else []
    before, after = judge(m), judge(m.with_values(left_out(fit)))
    return render(
        "certificate.html",
        title=f"Calibration certificate: {m.geometry.name}",
        warning=report.partition(f"machine {m.geometry.name}: {len(m)} readings")[0].strip(),
        identity=[
            ("certificate number", details.number),
            ("customer", details.customer),
            ("machine's maker, type and serial number", details.machine),
            ("machine in these files", m.geometry.name),
            ("model", model),
            ("place", details.place),
            ("measured on", details.measured_on),
            ("measured by", details.operator),
            ("environment", details.environment),
            *(("remarks", text) for text in details.remarks),
            ("evaluated with", f"hexapod_comp {version()}, scheme joint, {fit.model.origin.date}"),
        ],
        box=corners(fit.space.work_box),
        result=_result(fit),
        notes=(*tilt_doubt(fit.tilted, seen), *fit.notes),
        instruments=[
            (c.kind, c.readings, *(number(v * 1e6, 2) for v in (c.stated, COVERAGE * c.stated, c.found)), f"µ{c.unit}")
            for c in fit.channels
        ],
        named_instruments=[(n, text) for n, text in enumerate(details.instruments or ("",) * len(fit.channels), 1)],
        temperatures=_temperatures(fit),
        humidity=[("relative humidity", *damp, number(1e4 * fit.model.struts.moisture.max(), 2))] if damp else [],
        tests=list(_tests(before, after)) if before else [],
        figures=_figures(fit),
        unseen=unseen,
        datum=fit.held.report(),
        files=named + [("readings", name, digest) for name, digest in m.files],
        report=report,
        most_runs=MOST_RUNS,
    )


Rows = list[tuple[object, ...]]


def _result(fit: ModelFit) -> Rows:
    if fit.level is None:
        return []
    rows: Rows = []
    for name, error in {"level tool": fit.level, "tool tilted by 10°": fit.tilted}.items():
        if error is None:
            continue
        between = f"{number(error.low * 1e6, 3)} … {number(error.high * 1e6, 3)}"
        sizes = number(error.before * 1e6, 2), number(error.after * 1e6, 3)
        rows.append((f"{name}: displacement", *sizes, between, number(COVERAGE * error.high * 1e6, 2), "µm"))
        sizes = number(error.rotation_before * 1e6, 1), number(error.rotation_after * 1e6, 2)
        between, expanded = "roll is not shown", ""
        if error.rotation_low is not None and error.rotation_high is not None:
            between = f"{number(error.rotation_low * 1e6, 2)} … {number(error.rotation_high * 1e6, 2)}"
            expanded = number(COVERAGE * error.rotation_high * 1e6, 1)
        rows.append((f"{name}: rotation", *sizes, between, expanded, "µrad"))
    return rows


def _temperatures(fit: ModelFit) -> Rows:
    """Return a row per part: name, lowest and highest temperature read, °C, and expansion, ppm/K."""
    values, model = fit.measurements.stations.temperatures, fit.model
    rows, read = Rows(), fit.measurements.stations.thermometers
    expansions = (*model.struts.expansion, model.base_expansion, model.platform_expansion)
    for name, of_part, expansion in zip(Temperatures.NAMES, values.T, expansions, strict=True):
        ends = [number(v, 2) if name in read else "20 or not recorded" for v in (of_part.min(), of_part.max())]
        rows.append((name, *ends, number(expansion * 1e6, 2)))
    return rows


def _tests(before: Judged, after: Judged) -> Iterator[dict[str, object]]:
    """Yield tables of ISO 230-2, 230-6 and 230-4 with figures "before → after compensation", µm."""
    along_axes = f"{AXES_STANDARD}, lines along the axes, both directions"
    pairs = [(along_axes, before.axes, after.axes)] if before.axes else []
    for kind, tests in before.diagonals.items():
        pairs.append((f"{DIAGONALS_STANDARD}, {kind} diagonals, both directions", tests, after.diagonals[kind]))
    for title, old, new in pairs:
        rows = []
        for name, test in old.items():
            cells = figure_cells(COLUMNS, 2, test.figures, new[name].figures)
            rows.append((name, f"{len(test.targets)} × {test.cycles}", *cells))
        worst = [largest(tests) for tests in (old, new)]
        ends = [f"{name[0]} {' → '.join(number(w[name] * 1e6, 2) for w in worst)} µm" for name in worst[0]]
        header = ("run", "targets × cycles", *COLUMNS.values())
        yield {"title": title, "header": header, "rows": rows, "largest": ", ".join(ends), "notes": notes_of(old)}
    if before.circles:
        rows = []
        for name, circle in before.circles.items():
            cells = figure_cells(CIRCLE_COLUMNS, 2, circle.figures, after.circles[name].figures)
            rows.append((name, number(circle.radius * 1e3, 1), *cells))
        header, notes = ("run", "radius mm", *CIRCLE_COLUMNS.values()), notes_of(before.circles)
        yield {"title": f"{CIRCLES_STANDARD}, circles", "header": header, "rows": rows, "largest": "", "notes": notes}


def left_out(fit: ModelFit) -> np.ndarray:
    """Return each of N readings minus its prediction by a fit without its line, circle or pose, m or rad."""
    m, solution = fit.measurements, fit.solution
    mean = MeanReadings.of(m).of_reading
    weights = solution.weights / m.stated**2
    total = np.bincount(mean, weights)
    errors = fit.held_out / np.sqrt(total)
    return m.value - (np.bincount(mean, weights * m.value) / total)[mean] + errors[mean]


def _figures(fit: ModelFit) -> list[tuple[str, Figure]]:
    from .pictures import before_after_figure, residuals_by_run_figure

    figures = []
    if fit.model.region is not None:
        text = "Tool error before compensation and expected error after it, at three heights of the measured box"
        figures.append((text, before_after_figure(fit)))
    text = "Residual of each reading divided by its stated standard uncertainty; the band is ± 2 (k = 2)"
    return [*figures, (text, residuals_by_run_figure(fit))]
