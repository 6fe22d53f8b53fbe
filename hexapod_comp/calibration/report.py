"""Reports of fits as text and as JSON, for scheme ``joint`` and scheme ``lines``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..formats.texts import aligned, number, relative_change
from ..machine.field import COMPONENTS
from ..measurements.readings import AXES, SAME_ATTITUDE
from .estimator import SETTLED
from .fit import ModelFit, Outlier
from .lines import LineFit, LinesFit
from .posterior import Observability, ToolError, UnseenError, listed
from .thermal import warming_text
from .trust import TILT

MOST_LISTED, MOST_OF_RUN = 10, 3  # runs with outliers, and outliers of a run, at most
GROSS = 50.0  # σ of a residual from which a reading looks mistyped
MOST_RUNS = 5  # in the list of runs with the largest χ², at most
# Share of a tilted tool's error that may remain without a warning if structure parameters are unobservable
TRUST = 0.1

# Unit of a record → unit in the text, and its factor
SHOWN_UNITS = {
    "m": ("um", 1e6),
    "rad": ("urad", 1e6),
    "m, rad": ("um, urad", 1e6),
    "m/m": ("ppm", 1e6),
    "1/K": ("ppm/K", 1e6),
    "1": ("ppm/100 %", 1e6),
    "m/N": ("um/kN", 1e9),
    "N m": ("N m", 1.0),
}


class Column(NamedTuple):
    """A column of a table: the field of the records that it shows (its key in JSON), its title and its digits."""

    field: str
    title: str
    digits: int | None = None  # decimals; None: text, integer or boolean
    in_unit: bool = False  # in the unit of the record


CHANNELS = (
    Column("kind", "channel"),
    Column("readings", "readings"),
    Column("stated", "stated σ", 2, True),
    Column("found", "found σ", 2, True),
    Column("chi_square", "χ²/freedom", 3),
    Column("held_out", "held out", 2, True),
)
DECISIONS = Column("block", "block"), Column("kept", "kept"), Column("evidence", "evidence", 1)
RUNS = (
    Column("part", "run"),
    Column("kind", "channel"),
    Column("readings", "readings"),
    Column("value", "χ²/freedom", 3),
)
SIGHTS = (
    Column("name", "block"),
    Column("parameters", "parameters"),
    Column("determined", "determined", 1),
    Column("tolerance", "tolerance", 2, True),
    Column("error", "median error", 3, True),
)
OUTLIERS = tuple(
    Column(name, "", None, name == "residual") for name in ("source", "run", "channel", "residual", "sigmas")
)


def table(records: Iterable[Any], columns: Sequence[Column]) -> str:
    """Return a table with the unit of each record in the last column."""
    rows = []
    for record in records:
        unit, factor = SHOWN_UNITS[record.unit] if hasattr(record, "unit") else ("", 1.0)
        row = []
        for column in columns:
            value = getattr(record, column.field)
            if column.digits is not None:
                value = number(value * factor if column.in_unit else value, column.digits)
            row.append({True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value))
        rows.append((*row, unit))
    return aligned((*(column.title for column in columns), ""), rows)


def json_records(records: Iterable[Any], columns: Sequence[Column]) -> list[dict[str, Any]]:
    """Return records for JSON, in SI units; the key of a number with a unit ends with this unit."""
    return [{f"{c.field}_{r.unit}" if c.in_unit else c.field: getattr(r, c.field) for c in columns} for r in records]


def fit_report(fit: ModelFit) -> str:
    """Return the report of a fit with ``--scheme joint`` as text."""
    m, doubts = fit.measurements, (*fit.refusals, *fit.doubts)
    kept = ", ".join(block.name for block in fit.space.blocks)
    settled = "settled after" if fit.solution.change < SETTLED else "NOT settled after"
    headline = f"machine {m.geometry.name}: {len(m)} readings of {len(m.runs)} runs at {len(m.stations)} stations\n"
    headline += f"scheme joint: {fit.space.size} parameters ({kept}), {settled} {fit.solution.steps} steps"
    headline += "" if fit.lead is None else f"\nscrew lead: {fit.lead}"
    families = list(dict.fromkeys(c.part for c in fit.chi_squares))
    known = {(c.kind, c.part): number(c.value, 3) for c in fit.chi_squares}
    by_family = [(c.kind, *(known.get((c.kind, part), "") for part in families)) for c in fit.channels]
    gross = sorted((o for o in fit.outliers if abs(o.sigmas) >= GROSS), key=lambda o: -abs(o.sigmas))
    more = f"; {len(gross) - 1} more beyond {GROSS:g} σ below" if len(gross) > 1 else ""
    parts = [
        f"CHECK THIS READING, which looks mistyped: {_outlier_line(gross[0])}{more}" if gross else "",
        "IN DOUBT:\n" + "\n".join(f"  {doubt}" for doubt in doubts) if doubts else "",
        headline,
        expected_text(fit.level, fit.tilted, fit.observability),
        fit.held.report(),
        "\n".join(f"note: {note}" for note in fit.notes),
        "residuals; held out: error of a line or pose in a fit without it, including the noise of its readings\n"
        + table(fit.channels, CHANNELS),
    ]
    if families:
        table_of_families = aligned(("channel", *families), by_family)
        title = "χ² per degree of freedom, by family of lines and by direction; it is 1 if the noise is as stated"
        parts.append(f"{title}\n{table_of_families}")
    if len(fit.chi_squares_of_runs) > 1:
        parts.append("runs with the largest χ²\n" + table(fit.chi_squares_of_runs[:MOST_RUNS], RUNS))
    blocks = "blocks; evidence: log Bayes factor of the fit with the block over the fit without it\n"
    parts += [
        blocks + table(fit.decisions, DECISIONS),
        observability_text(fit.observability, fit.unseen_errors),
        warming_text(fit.warming),
        "\n".join(_outlier_lines(fit.outliers)),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def expected_text(level: ToolError | None, tilted: ToolError | None, seen: Observability) -> str:
    """Return the expected error of a level and a tilted tool, with :func:`tilt_doubt`; empty if `level` is None."""
    if level is None:
        return ""
    lines = ["expected tool error at random points of the measured box, both directions, after best-fit alignment:"]
    for title, error in (("level tool:  ", level), ("tilted 10°:  ", tilted)):
        if error is None:
            continue
        rotation = f", assumed by the priors: the readings do not show {error.rotation_unknown}"
        if error.rotation_low is not None and error.rotation_high is not None:
            rotation = f" ({error.rotation_low * 1e6:.2f}…{error.rotation_high * 1e6:.2f})"
        lines.append(
            f"  {title}{error.before * 1e6:.2f} → {error.after * 1e6:.3f} µm RMS "
            f"({error.low * 1e6:.3f}…{error.high * 1e6:.3f} with 95 %), {relative_change(error.before, error.after)}; "
            f"rotation {error.rotation_before * 1e6:.1f} → {error.rotation_after * 1e6:.2f} µrad RMS{rotation}"
        )
    return "\n".join([*lines, *(f"  {doubt}" for doubt in tilt_doubt(tilted, seen))])


def tilt_doubt(tilted: ToolError | None, seen: Observability) -> Iterator[str]:
    """Warn if more than the share TRUST of a tilted tool's error remains, and a structure parameter is unobservable."""
    if tilted is not None and seen.structure_rank < seen.structure_size and tilted.after > TRUST * tilted.before:
        share = 100.0 * tilted.after / tilted.before
        tilt = f"taken at tilts of up to {np.degrees(seen.tilt):.1f}°" if seen.tilt > SAME_ATTITUDE else "all level"
        yield (
            f"Do not trust this model with a tilted tool: at a tilt of {np.degrees(TILT):g}°, {share:.3g} % of the "
            f"error remains ({100.0 * TRUST:g} % is allowed). The readings, {tilt}, show {seen.structure_rank} of "
            f"{seen.structure_size} combinations of the structure's parameters above their noise."
        )


def observability_text(seen: Observability, unseen_errors: tuple[UnseenError, ...]) -> str:
    lines = [table(seen.blocks, SIGHTS)]
    lines.append(
        f"observable combinations: {seen.structure_rank} of {seen.structure_size} of the structure's parameters, "
        f"{seen.rank} of {seen.size} of all parameters; condition number {seen.condition:.0f}"
    )
    if seen.indices:
        lines.append("observability indices: " + ", ".join(f"{k} {v:.3g}" for k, v in seen.indices.items()))
    if seen.unseen:
        lines.append("structure parameters that are mostly unobservable (kept near nominal): " + ", ".join(seen.unseen))
    if unseen_errors:
        lines.append(f"machine errors that the readings do not show: {listed(unseen_errors)}")
    return "\n".join(lines)


def _outlier_lines(outliers: Sequence[Outlier]) -> Iterator[str]:
    """Yield the number of outliers, then outliers by run, most outliers first."""
    if outliers:
        yield f"outliers, with little weight because they disagree with the other readings: {len(outliers)}"
    runs = Counter(o.run for o in outliers)
    for run, count in runs.most_common(MOST_LISTED):
        yield f"  run {run}: {count}"
        yield from [f"    {_outlier_line(o)}" for o in outliers if o.run == run][:MOST_OF_RUN]
        if count > MOST_OF_RUN:
            yield f"    and {count - MOST_OF_RUN} more"
    if len(runs) > MOST_LISTED:
        yield f"  and {sum(runs.values()) - sum(n for _, n in runs.most_common(MOST_LISTED))} in other runs"


def _outlier_line(o: Outlier) -> str:
    return f"{o.source}: {o.channel} is {o.residual * 1e6:.2f} {SHOWN_UNITS[o.unit][0]} off ({o.sigmas:.1f} σ)"


def as_json(fit: ModelFit) -> dict[str, Any]:
    """Return a fit by the scheme ``joint`` as JSON data in SI; units are in keys, or beside numbers as ``unit``."""
    labels = [(label, block.unit) for block in fit.space.blocks for label in block.labels]
    lead = fit.lead
    if lead is not None:
        error = None if lead.shown is None else lead.error
        screws = {"given_m": lead.given, "shown_m": lead.shown, "standard_error_m": error, "used_m": lead.used}
    return {
        "machine": fit.measurements.geometry.name,
        "scheme": "joint",
        "parameters": [
            {"name": name, "value": value, "standard_error": error, "unit": unit}
            for (name, unit), value, error in zip(labels, fit.solution.x, fit.standard_errors, strict=True)
        ],
        "blocks": fit.decisions,
        "screw_lead": None if lead is None else screws,
        "channels": json_records(fit.channels, CHANNELS),
        **expected_json(fit.level, fit.tilted, fit.observability, fit.unseen_errors),
        "datum": fit.held.as_json(),
        "settled": fit.solution.change < SETTLED,
        "doubts": (*fit.refusals, *fit.doubts),
        "unexplained": fit.unexplained,
        "chi_squares": fit.chi_squares,
        "chi_squares_of_runs": fit.chi_squares_of_runs,
        "outliers": json_records(fit.outliers, OUTLIERS),
        "notes": fit.notes,
        "warming": fit.warming,
    }


def expected_json(
    level: ToolError | None, tilted: ToolError | None, seen: Observability, unseen_errors: tuple[UnseenError, ...]
) -> dict[str, Any]:
    def error(tool: ToolError | None) -> dict[str, Any] | None:
        if tool is None:
            return None
        values = vars(tool).copy()
        unknown = values.pop("rotation_unknown")
        in_si = {f"{name}_{'rad' if 'rotation' in name else 'm'}": value for name, value in values.items()}
        return in_si | {"rotation_unknown": unknown or None}

    return {
        "expected_tool_error": error(level),
        "expected_tool_error_tilted": error(tilted),
        "observability": seen,
        "unseen_errors": [error.name for error in unseen_errors],
        "unseen_errors_traces": [error.trace for error in unseen_errors],
    }


# Scheme lines

WAYS = {1: "forward", -1: "backward", 0: "both"}


def lines_report(fit: LinesFit) -> str:
    """Return a table with a row for each axis and error component."""
    field = fit.model.field
    nodes = " × ".join(str(len(along)) for along in field.grid)
    header = ("lines along", "of", "polynomials", "order", "R² least", "adjusted R² median", "σ median", "largest", "")
    families: dict[tuple[int, int], list[LineFit]] = {}
    for line in fit.lines:
        families.setdefault((line.axis, line.component), []).append(line)
    rows = []
    for (axis, component), members in sorted(families.items()):
        orders, spread = [line.order for line in members], np.array([line.residual_std for line in members]) * 1e6
        order = f"{min(orders)}…{max(orders)}" if min(orders) < max(orders) else str(orders[0])
        worst, median = min(line.r2 for line in members), float(np.median([line.adjusted_r2 for line in members]))
        cells = (number(worst, 3), number(median, 3), f"{np.median(spread):.2f}", f"{spread.max():.2f}")
        rows.append(
            (AXES[axis], COMPONENTS[component], str(len(members)), order, *cells, "µm" if component < 3 else "µrad")
        )
    blocks = [f"{fit.model.name}: {len(fit.lines)} polynomials on a grid of {nodes} nodes", aligned(header, rows)]
    blocks += [fit.held.report(), *(f"note: {note}" for note in fit.notes)]
    return "\n\n".join(blocks) + "\n"


def lines_json(fit: LinesFit) -> dict[str, Any]:
    def one(line: LineFit) -> dict[str, Any]:
        unit = "m" if line.component < 3 else "rad"
        return {
            "name": line.name,
            "component": COMPONENTS[line.component],
            "direction": WAYS[line.direction],
            "points": len(line.values),
            f"coefficients_{unit}": line.coefficients.tolist(),
            "r2": line.r2,
            "adjusted_r2": line.adjusted_r2,
            f"residual_std_{unit}": line.residual_std,
            f"repeat_std_{unit}": line.repeat_std,
        }

    return {
        "machine": fit.model.machine,
        "scheme": "lines",
        "grid_m": [axis.tolist() for axis in fit.model.field.grid],
        "lines": [one(line) for line in fit.lines],
        "datum": fit.held.as_json(),
        "notes": fit.notes,
    }
