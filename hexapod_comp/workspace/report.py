"""What a classification prints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..formats.texts import aligned, number
from .combining import Allocation
from .ranking import beside, ranking_rows, ranking_text
from .sources import BY_NAME
from .study import Study

EACH = ("alone", "only", "without", "equal")
"""What an allocation says of each type."""


def report(study: Study, names: Sequence[str]) -> str:
    """Return the report of a study; `names` are those of its orientations."""
    ranking = ranking_text(study.rows, beside(study.geometry, study.errors))
    parts = [_headline(study), _reach_table(study, names), ranking, _combined_text(study)]
    parts += [_allocation_text(study, allocation) for allocation in study.allocations]
    if study.agreement is not None:
        parts.append(_agreement_text(study))
    return "\n\n".join(parts) + "\n"


def _headline(study: Study) -> str:
    return (
        f"machine {study.geometry.name}: {len(study.errors)} single errors of {len(study.errors.kinds)} types "
        f"at {study.extremes.poses} poses"
    )


def _reach_table(study: Study, names: Sequence[str]) -> str:
    """Return volume, size and limits of the workspace at each orientation."""
    rows = []
    for name, reach in zip(names, study.reaches, strict=True):
        size = " × ".join(f"{side * 1e3:.0f}" for side in np.ptp(reach.box, axis=0))
        limits = ", ".join(f"{cause} {100.0 * share:.0f} %" for cause, share in reach.shares().items())
        rows.append((name, number(reach.volume * 1e6, 1), size, str(reach.parts), limits))
    head = ("tilted from home", "volume cm³", "box in work mm", "pieces", "limited by (share of the boundary)")
    return aligned(head, rows)


def _combined_text(study: Study) -> str:
    """Return what the whole budget adds up to."""
    combined, drawn = study.combined, study.combined.monte_carlo
    rows = [
        ("worst case", *_both(combined.worst_case), ""),
        ("root sum of squares", *_both(combined.root_sum_of_squares), ""),
    ]
    for n, percentile in enumerate(drawn.percentiles):
        low, high = drawn.worst_low[n], drawn.worst_high[n]
        cells = _both(drawn.worst_values[n])
        bounds = f"({_both(low)[0]}…{_both(high)[0]} µm with {100.0 * drawn.confidence:.0f} %)"
        rows.append((f"{percentile:g} % of {drawn.draws} machines", *cells, bounds))
    head = ("whole budget, worst pose", "transl. µm", "rot. m°", "")
    return aligned(head, rows) + "\nmachines: all errors uniform within their bounds, each machine's worst pose"


def _both(values: np.ndarray) -> tuple[str, str]:
    return number(float(values[0]) * 1e6, 2), number(float(np.degrees(values[1])) * 1e3, 2)


def _allocation_text(study: Study, allocation: Allocation) -> str:
    """Return what each error may be."""
    how = {"rss": "root sum of squares", "worst_case": "worst case"}[allocation.method]
    head = (
        f"allowed {allocation.allowed * 1e6:g} µm, {how}: the budget adds up to {allocation.combined * 1e6:.2f} µm; "
        f"all errors may be {allocation.scale:.3g} times as large.\nWhat each type adds up to alone, and the others "
        "without it; and what its size may be, when the others stay or when all use up equal parts:"
    )
    header = ("type", "now ±", "alone µm", "the others µm", "may be, the others as now", "may be, equal parts", "")
    rows = []
    for n, (name, size) in enumerate(study.budget.sizes.items()):
        unit, factor = {"length": ("µm", 1e6), "ratio": ("ppm", 1e6)}[BY_NAME[name].dimension]
        now = size * factor
        sums = (number(value * 1e6, 2) for value in (allocation.only[n], allocation.without[n]))
        left = _may_be(now, allocation.alone[n], "nothing is left")
        rows.append((study.errors.kinds[n], number(now, 2), *sums, left, _may_be(now, allocation.equal[n]), unit))
    return head + "\n" + aligned(header, rows)


def _may_be(now: float, factor: float, none: str = "") -> str:
    """Return what a size may grow or must shrink to."""
    return none if np.isnan(factor) else "anything" if np.isinf(factor) else number(now * factor, 2)


def _agreement_text(study: Study) -> str:
    agreement = study.agreement
    if agreement is None:
        return ""
    return (
        f"methods, {agreement.effects} effects, difference to exact over the type's largest effect: "
        f"linear {100.0 * agreement.linear:.3f} %, the paper's iteration {100.0 * agreement.tangential:.4f} % "
        f"(its passive legs drift by {100.0 * agreement.drift:.3f} % of the active leg's travel)"
    )


def as_json(study: Study) -> dict[str, Any]:
    """Return a study as plain numbers; units are in the keys."""
    drawn = study.combined.monte_carlo
    return {
        "machine": study.geometry.name,
        "frame": "work",
        "budget_si": study.budget.sizes,
        "poses": study.extremes.poses,
        "ranking": ranking_rows(study.rows, beside(study.geometry, study.errors)),
        "reach": [
            {"volume_m3": item.volume, "box_m": item.box, "limits": item.shares(), "regions": item.regions()}
            for item in study.reaches
        ],
        "combined_m_rad": {
            "worst_case": study.combined.worst_case,
            "root_sum_of_squares": study.combined.root_sum_of_squares,
            "percentiles": dict(zip(drawn.percentiles, drawn.worst_values, strict=True)),
        },
        "allocations_m": [
            {**vars(item), **{name: dict(zip(study.errors.kinds, getattr(item, name), strict=True)) for name in EACH}}
            for item in study.allocations
        ],
        "agreement": study.agreement,
    }
