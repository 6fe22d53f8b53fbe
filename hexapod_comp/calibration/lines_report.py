"""What a fit of scheme ``lines`` prints: how good the polynomials are, and what the model is worth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from ..formats.texts import aligned, number
from ..machine.field import COMPONENTS
from ..measurements.readings import AXES
from .evaluation import Worth
from .lines import LineFit, LinesFit

WAYS = {1: "forward", -1: "backward", 0: "both"}


def report(fit: LinesFit, worth: Worth | None = None, every_line: bool = False) -> str:
    """Return the report of a fit.

    Parameters
    ----------
    fit : LinesFit
        What to report.
    worth : Worth, optional
        What the model is worth on the virtual machine that was measured, where there is one.
    every_line : bool
        List every polynomial too, not only each family's summary.
    """
    field = fit.model.field
    nodes = " × ".join(str(len(along)) for along in field.grid)
    blocks = [f"{fit.model.name}: {len(fit.lines)} polynomials on a grid of {nodes} nodes", summary_table(fit.lines)]
    if every_line:
        blocks.append(line_table(fit.lines))
    blocks.append(fit.held.report())
    blocks += [f"note: {note}" for note in fit.notes]
    if worth is not None:
        blocks.append(worth_text(worth))
    return "\n\n".join(blocks) + "\n"


def summary_table(lines: Sequence[LineFit]) -> str:
    """Return one row for each family and component: orders, R², residuals."""
    header = ("lines along", "of", "polynomials", "order", "R² least", "adjusted R² median", "σ median", "largest", "")
    by_family = groupby(sorted(lines, key=_family), key=_family)
    return aligned(header, (_summary_row(list(members)) for _, members in by_family))


def _family(line: LineFit) -> tuple[int, int]:
    return line.axis, line.component


def _summary_row(lines: Sequence[LineFit]) -> Sequence[str]:
    orders = [line.order for line in lines]
    order = f"{min(orders)}…{max(orders)}" if min(orders) < max(orders) else str(orders[0])
    spread = np.array([line.residual_std for line in lines]) * 1e6
    component = lines[0].component
    return (
        AXES[lines[0].axis],
        COMPONENTS[component],
        str(len(lines)),
        order,
        number(min(line.r2 for line in lines), 3),
        number(float(np.median([line.adjusted_r2 for line in lines])), 3),
        f"{np.median(spread):.2f}",
        f"{spread.max():.2f}",
        _unit(component),
    )


def _unit(component: int) -> str:
    return "µm" if component < 3 else "µrad"


def line_table(lines: Sequence[LineFit]) -> str:
    """Return one row for each polynomial; σ of its residuals, and of repeated readings where there are any."""
    header = ("of", "direction", "points", "order", "R²", "adjusted R²", "σ", "σ repeated", "unit", "")
    return aligned(header, (_line_row(line) for line in lines))


def _line_row(line: LineFit) -> Sequence[str]:
    return (
        COMPONENTS[line.component],
        WAYS[line.direction],
        str(len(line.values)),
        str(line.order),
        number(line.r2, 4),
        number(line.adjusted_r2, 4),
        f"{line.residual_std * 1e6:.2f}",
        "–" if np.isnan(line.repeat_std) else f"{line.repeat_std * 1e6:.2f}",
        _unit(line.component),
        line.name,
    )


def worth_text(worth: Worth) -> str:
    """Return what a model is worth on a virtual machine: the paper's measure next to the honest one."""
    return "\n".join(_worth_lines(worth))


def as_json(fit: LinesFit) -> dict[str, Any]:
    """Return a fit of scheme lines as plain numbers; SI units are in the keys."""
    field = fit.model.field
    return {
        "machine": fit.model.machine,
        "scheme": "lines",
        "grid_m": [axis.tolist() for axis in field.grid],
        "lines": [_line_json(line) for line in fit.lines],
        "datum": fit.held.as_json(),
        "notes": fit.notes,
    }


def _line_json(line: LineFit) -> dict[str, Any]:
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


def worth_json(worth: Worth) -> dict[str, Any]:
    """Return what a model is worth on a virtual machine as plain numbers; SI units are in the keys."""
    error = {
        name: {
            "points": one.points,
            "rms_m": one.raw.rms,
            "aligned_rms_m": one.aligned.rms,
            "aligned_max_m": one.aligned.largest,
            "rotation_rms_rad": one.rotation.rms,
        }
        for name, one in (("error_without", worth.before), ("error_with", worth.after))
    }
    along = {"without_m": worth.paper.before, "with_m": worth.paper.after, "lines": worth.paper.lines}
    promised = {"promised_m": worth.promised, "kept": worth.kept}
    return {**error, **promised, "mean_displacement_error_along_lines": along}


def _worth_lines(worth: Worth) -> Iterator[str]:
    before, after, paper = worth.before, worth.after, worth.paper
    along = _fall(paper.before, paper.after, "µm")
    yield f"On the virtual machine, without → with the model (held out: {after.points} points, both ways):"
    yield f"  metric of Mou & King, mean |displacement error| along {paper.lines} lines: {along}"
    yield f"  error vector in space, RMS, datum aligned: {_fall(before.aligned.rms, after.aligned.rms, 'µm')}"
    if worth.promised is not None:
        low, high = (f"{end * 1e6:.2f}" for end in worth.promised)
        yield f"  promised by the fit: {low} to {high} µm, {'kept' if worth.kept else 'NOT KEPT'}"
    yield f"  its largest: {_fall(before.aligned.largest, after.aligned.largest, 'µm')}"
    yield f"  error vector in space, RMS, as it is: {_fall(before.raw.rms, after.raw.rms, 'µm')}"
    yield f"  rotation, RMS, datum aligned: {_fall(before.rotation.rms, after.rotation.rms, 'µrad')}"


def _fall(before: float, after: float, unit: str) -> str:
    """Return a comparison in millionths as text."""
    removed = f" ({100.0 * (1.0 - after / before):.1f} % less)" if before > 0.0 else ""
    return f"{before * 1e6:.2f} → {after * 1e6:.2f} {unit}{removed}"
