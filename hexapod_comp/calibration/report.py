"""Reports of fits, as text and as JSON: scheme ``joint``, and scheme ``lines``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..formats.texts import aligned, number
from ..machine.field import COMPONENTS
from ..measurements.readings import ANGULAR_KINDS, AXES, CHANNELS, SAME_ATTITUDE
from .estimator import SETTLED
from .fit import ChannelFit, ModelFit, Outlier
from .lead import ScrewLead
from .lines import LineFit, LinesFit
from .posterior import BlockSight, Observability, ToolError, UnseenError, listed
from .thermal import warming_json, warming_text
from .trust import TILT

MOST_LISTED, MOST_OF_RUN = 10, 3  # runs with outliers, and outliers of a run, beyond these are counted, not listed
# Standard deviations beyond which a reading looks mistyped: no instrument's own errors are as large
GROSS = 50.0
MOST_RUNS = 5  # number of runs listed with the largest residuals
# A share of the error of a tilted tool above which a warning is printed, when parameters are not observable
TRUST = 0.1


def fit_report(fit: ModelFit) -> str:
    """Return the report of a fit: residual error, parameters, and what the readings could not show."""
    doubts = (*fit.verdict.refusals, *fit.verdict.doubts)
    parts = [
        *_gross_errors(fit),
        *(["IN DOUBT:\n" + "\n".join(f"  {doubt}" for doubt in doubts)] if doubts else []),
        _headline(fit),
        *expected_text(fit.level, fit.tilted, fit.observability),
        fit.held.report(),
        *(["\n".join(f"note: {note}" for note in fit.notes)] if fit.notes else []),
        _channel_table(fit),
        *_chi_square_tables(fit),
        _decision_table(fit),
        observability_text(fit.observability, fit.unseen_errors),
        *filter(None, [warming_text(fit.warming)]),
        *_outliers(fit),
    ]
    return "\n\n".join(parts) + "\n"


def _headline(fit: ModelFit) -> str:
    m = fit.measurements
    kept = ", ".join(block.name for block in fit.space.blocks)
    settled = "settled after" if fit.solution.change < SETTLED else "NOT settled after"
    return (
        f"machine {m.geometry.name}: {len(m)} readings of {len(m.runs)} runs at {len(m.stations)} stations\n"
        f"scheme joint: {fit.space.size} parameters ({kept}), {settled} {fit.solution.steps} steps"
        + (f"\nscrew lead: {fit.lead}" if fit.lead is not None else "")
    )


def expected_text(level: ToolError | None, tilted: ToolError | None, seen: Observability) -> Iterator[str]:
    """Yield the tool error with the model, and whether it can be trusted with a tilted tool."""
    if level is None:
        return
    lines = ["expected tool error at random points of the measured box, both directions, the datum aligned:"]
    lines.append(f"  level tool:  {tool_error_text(level)}")
    if tilted is not None:
        lines.append(f"  tilted 10°:  {tool_error_text(tilted)}")
        lines += [f"  {doubt}" for doubt in tilt_doubt(tilted, seen)]
    yield "\n".join(lines)


def tilt_doubt(tilted: ToolError | None, seen: Observability) -> Iterator[str]:
    """Yield why a model is not to be trusted with a tilted tool, if it is not."""
    if tilted is not None and seen.structure_rank < seen.structure_size and tilted.after > TRUST * tilted.before:
        share = 100.0 * tilted.after / tilted.before
        tilt = f"taken at tilts of up to {np.degrees(seen.tilt):.1f}°" if seen.tilt > SAME_ATTITUDE else "all level"
        yield (
            f"Do not trust this model with a tilted tool: tilted by {np.degrees(TILT):g}°, {share:.0f} % of the error "
            f"stays ({100.0 * TRUST:g} % allowed). The readings, {tilt}, show {seen.structure_rank} of "
            f"{seen.structure_size} parameters of the structure above their noise."
        )


def tool_error_text(error: ToolError) -> str:
    """Return before, after and the interval of a tool error in µm and µrad."""
    removed = 100.0 * (1.0 - error.after / error.before)
    return (
        f"{error.before * 1e6:.2f} → {error.after * 1e6:.3f} µm RMS "
        f"({error.low * 1e6:.3f}…{error.high * 1e6:.3f} with 95 %), {removed:.1f} % less; "
        f"rotation {error.rotation_before * 1e6:.1f} → {error.rotation_after * 1e6:.2f} µrad RMS"
        + rotation_interval(error)
    )


def rotation_interval(error: ToolError) -> str:
    """Return the interval of a tool's rotation in µrad, or that there is none."""
    if error.rotation_low is None or error.rotation_high is None:
        return f" by the priors: {error.rotation_unknown}"
    return f" ({error.rotation_low * 1e6:.2f}…{error.rotation_high * 1e6:.2f})"


def _channel_table(fit: ModelFit) -> str:
    header = ("channel", "readings", "stated σ", "found σ", "χ²/freedom", "held out", "")
    rows = []
    for c in fit.channels:
        unit = "urad" if c.kind in ANGULAR_KINDS else "um"
        cells = (number(c.stated * 1e6, 2), number(c.estimated * 1e6, 2), number(c.chi_square, 3))
        rows.append((c.kind, str(c.readings), *cells, number(c.held_out * 1e6, 2), unit))
    return "residuals; held out: a line or a pose at a time, noise included\n" + aligned(header, rows)


def _chi_square_tables(fit: ModelFit) -> Iterator[str]:
    """Yield χ² by channel, family of lines and direction; and the runs with the largest residuals."""
    parts = list(dict.fromkeys(c.part for c in fit.verdict.chi_squares))
    known = {(c.kind, c.part): number(c.value, 3) for c in fit.verdict.chi_squares}
    rows = [(c.kind, *(known.get((c.kind, part), "") for part in parts)) for c in fit.channels]
    if parts:
        yield "χ²/freedom by lines and direction; 1: as stated\n" + aligned(("channel", *parts), rows)
    worst = [(c.part, c.kind, str(c.readings), number(c.value, 3)) for c in fit.verdict.worst_runs[:MOST_RUNS]]
    if len(fit.verdict.worst_runs) > 1:
        yield "runs that were met worst\n" + aligned(("run", "channel", "readings", "χ²/freedom"), worst)


def _decision_table(fit: ModelFit) -> str:
    rows = [(d.block, "yes" if d.kept else "no", number(d.evidence, 1)) for d in fit.decisions]
    head = "blocks; evidence: logarithm of the Bayes factor with the block to without it"
    return head + "\n" + aligned(("block", "kept", "evidence"), rows)


def observability_text(seen: Observability, unseen_errors: tuple[UnseenError, ...]) -> str:
    """Return what the data determine: block by block, rank, indices, unseen parameters."""
    header = ("block", "parameters", "determined", "tolerance", "median error", "")
    lines = [aligned(header, [_sight_row(b) for b in seen.blocks])]
    lines.append(
        f"{seen.structure_rank} of {seen.structure_size} structure parameters are observable; "
        f"of all {seen.size} parameters {seen.rank} are, condition number {seen.condition:.0f}"
    )
    if seen.indices:
        lines.append("observability indices: " + ", ".join(f"{k} {v:.3g}" for k, v in seen.indices.items()))
    if seen.unseen:
        lines.append("not seen (left near nominal): " + ", ".join(seen.unseen))
    if unseen_errors:
        lines.append(f"machine errors that the readings do not show: {listed(unseen_errors)}")
    return "\n".join(lines)


# Units in which blocks are displayed, and the factor of the numbers
SHOWN_UNITS = {
    "m": ("um", 1e6),
    "rad": ("urad", 1e6),
    "m, rad": ("um, urad", 1e6),
    "m/m": ("ppm", 1e6),
    "1/K": ("ppm/K", 1e6),
    "1": ("ppm/100 %", 1e6),
    "m/N": ("um/kN", 1e9),
}


def _sight_row(b: BlockSight) -> tuple[str, ...]:
    unit, factor = SHOWN_UNITS[b.unit]
    cells = (number(b.determined, 1), number(b.tolerance * factor, 2), number(b.error * factor, 3))
    return (b.name, str(b.parameters), *cells, unit)


def _outliers(fit: ModelFit) -> Iterator[str]:
    """Yield the list of readings that disagree with all others."""
    if not fit.outliers:
        return
    lines = [f"readings that disagree with all others, and got little weight: {len(fit.outliers)}"]
    runs = Counter(o.run for o in fit.outliers)
    for run, count in runs.most_common(MOST_LISTED):
        of_run = [o for o in fit.outliers if o.run == run]
        lines.append(f"  run {run}: {count}")
        lines += [f"    {_outlier_line(o)}" for o in of_run[:MOST_OF_RUN]]
        if count > MOST_OF_RUN:
            lines.append(f"    and {count - MOST_OF_RUN} more")
    if len(runs) > MOST_LISTED:
        lines.append(f"  and {sum(runs.values()) - sum(n for _, n in runs.most_common(MOST_LISTED))} in other runs")
    yield "\n".join(lines)


def _gross_errors(fit: ModelFit) -> Iterator[str]:
    """Yield the worst reading, before anything else, if it looks mistyped."""
    gross = sorted((o for o in fit.outliers if abs(o.sigmas) >= GROSS), key=lambda o: -abs(o.sigmas))
    if gross:
        more = f"; {len(gross) - 1} more beyond {GROSS:g} σ below" if len(gross) > 1 else ""
        yield f"CHECK THIS READING, which looks mistyped: {_outlier_line(gross[0])}{more}"


def _outlier_line(o: Outlier) -> str:
    unit = "urad" if CHANNELS[o.channel].partition("_")[0] in ANGULAR_KINDS else "um"
    return f"{o.source}: {CHANNELS[o.channel]} is {o.residual * 1e6:.2f} {unit} off ({o.sigmas:.1f} σ)"


def as_json(fit: ModelFit) -> dict:
    """Return a fit of scheme joint as plain numbers; SI units are in the keys, or stand beside numbers as ``unit``."""
    x, errors = fit.solution.x, fit.standard_errors
    labels = [(label, block.unit) for block in fit.space.blocks for label in block.labels]
    return {
        "machine": fit.measurements.geometry.name,
        "scheme": "joint",
        "parameters": [
            {"name": name, "value": v, "standard_error": e, "unit": unit}
            for (name, unit), v, e in zip(labels, x, errors, strict=True)
        ],
        "blocks": fit.decisions,
        "screw_lead": _lead_json(fit.lead),
        "channels": [_channel_json(c) for c in fit.channels],
        **expected_json(fit.level, fit.tilted, fit.observability, fit.unseen_errors),
        "datum": fit.held.as_json(),
        "settled": fit.solution.change < SETTLED,
        "doubts": (*fit.verdict.refusals, *fit.verdict.doubts),
        "unexplained": fit.verdict.unexplained.as_json(),
        "chi_squares": [c._asdict() for c in fit.verdict.chi_squares],
        "chi_squares_of_runs": [c._asdict() for c in fit.verdict.worst_runs],
        "outliers": [_outlier_json(o) for o in fit.outliers],
        "notes": fit.notes,
        "warming": warming_json(fit.warming),
    }


def _lead_json(lead: ScrewLead | None) -> dict | None:
    if lead is None:
        return None
    error = None if lead.shown is None else lead.error
    return {"given_m": lead.given, "shown_m": lead.shown, "standard_error_m": error, "used_m": lead.used}


def _channel_json(channel: ChannelFit) -> dict:
    unit = _unit(channel.kind)
    sizes = {"stated": channel.stated, "found": channel.estimated, "held_out": channel.held_out}
    sizes = {f"{name}_{unit}": value for name, value in sizes.items()}
    return {"kind": channel.kind, "readings": channel.readings, "chi_square": channel.chi_square, **sizes}


def _outlier_json(outlier: Outlier) -> dict:
    name = CHANNELS[outlier.channel]
    residual = {f"residual_{_unit(name.partition('_')[0])}": outlier.residual, "sigmas": outlier.sigmas}
    return {"source": str(outlier.source), "run": outlier.run, "channel": name, **residual}


def _unit(kind: str) -> str:
    return "rad" if kind in ANGULAR_KINDS else "m"


def expected_json(
    level: ToolError | None, tilted: ToolError | None, seen: Observability, unseen_errors: tuple[UnseenError, ...]
) -> dict:
    """Return the keys that a fit and a plan for one share."""

    def error(tool: ToolError | None) -> dict | None:
        if tool is None:
            return None
        values = vars(tool).copy()
        unknown = values.pop("rotation_unknown")
        in_si = {f"{name}_{'rad' if 'rotation' in name else 'm'}": value for name, value in values.items()}
        return in_si | {"rotation_unknown": unknown or None}

    return {
        "expected_tool_error": error(level),
        "expected_tool_error_tilted": error(tilted),
        "observability": {**vars(seen), "blocks": [vars(block) for block in seen.blocks]},
        "unseen_errors": [error.name for error in unseen_errors],
        "unseen_errors_traces": [error.trace for error in unseen_errors],
    }


# Scheme lines

WAYS = {1: "forward", -1: "backward", 0: "both"}


def lines_report(fit: LinesFit) -> str:
    """Return the report of a fit of scheme ``lines``: a row for each family and component."""
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
        rows.append((AXES[axis], COMPONENTS[component], str(len(members)), order, *cells, _micro(component)))
    blocks = [f"{fit.model.name}: {len(fit.lines)} polynomials on a grid of {nodes} nodes", aligned(header, rows)]
    blocks += [fit.held.report(), *(f"note: {note}" for note in fit.notes)]
    return "\n\n".join(blocks) + "\n"


def _micro(component: int) -> str:
    return "µm" if component < 3 else "µrad"


def lines_json(fit: LinesFit) -> dict[str, Any]:
    """Return a fit of scheme ``lines`` as plain numbers; SI units are in the keys."""

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
