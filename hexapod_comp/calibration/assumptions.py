"""What calibration assumes about machines, instruments and numbers: every constant of this room, with unit and source.

Use ``ASSUMED.name``. A number that the readings or textbooks give does not belong here; one that tunes a bar needs an
ablation in benchmarks/ on machines that were not used to find it. ``fit --assumptions`` prints the table.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


def assumed(value: Any, unit: str, what: str, source: str) -> Any:
    """Return a dataclass field: a default with its unit ('' for a pure number), meaning and source."""
    return field(default=value, metadata={"unit": unit, "what": what, "source": source})


@dataclass(frozen=True)
class Assumptions:
    """All constants of the calibration room."""

    # Estimator (estimator.py)
    steps: int = assumed(20, "", "most Gauss-Newton steps", "a handful suffices for errors of 0.1 mm")
    settled: float = assumed(1e-2, "σ", "largest change of a parameter in the last step", "far below what is reported")
    huber: float = assumed(2.5, "σ", "residuals beyond lose weight in proportion", "Huber 1981: 99 % efficient")
    outlier: float = assumed(5.0, "σ", "residuals beyond are listed", "1 in 1.7 million by chance")

    # Blocks (blocks/)
    knot_distance: float = assumed(17e-3, "m", "largest distance of a length map's knots", "a wave of 60 mm has 3.5")
    map_correlation: float = assumed(40e-3, "m", "how far a length map's errors are alike", "Matérn 5/2; ground screws")
    field_decay: float = assumed(0.6, "", "share of the prior that each degree of the field keeps", "fields are smooth")
    reversal_degree: int = assumed(2, "", "degree of the field's part that depends on direction", "few reversals read")
    grid_tolerance: float = assumed(30e-9, "m, rad", "what a field's grid may add to its polynomial", "below readings")
    field_nodes: int = assumed(17, "", "most nodes of a field along its longest axis", "a readable model file")
    field_checks: int = assumed(400, "", "random points at which the grid is checked", "any")
    digits: int = assumed(11, "", "digits after the point in a model file", "a hundredth of a nanometre")
    struts_alike: float = assumed(0.998, "", "correlation of the struts' expansions", "one material: 5 % apart")
    struts_warmed_alike: float = assumed(0.9, "", "the same by another part's thermometer", "loaded, cooled unlike")
    least_warming: float = assumed(0.5, "K", "change that shows an expansion", "3 µm on 0.5 m of steel")
    least_damping: float = assumed(0.1, "", "change of humidity that shows swelling", "5 µm on 0.5 m of carbon fibre")
    largest_expansion: float = assumed(100e-6, "1/K", "no machine grows more", "three times zinc")
    largest_moisture: float = assumed(1e-2, "m/m", "no strut swells more, dry to damp", "wood along its grain: 3e-3")
    shortest_lead: float = assumed(0.1e-3, "m", "shortest lead of a screw", "below it no line shows a period")
    longest_lead: float = assumed(1.0, "m", "longest lead of a screw", "longer than struts")
    beyond_stroke: float = assumed(50e-3, "m", "encoders may read so far beyond the stroke", "zeros of their own")
    # Posterior (posterior.py, datum.py)
    seen: float = assumed(1.0, "σ", "change of all readings from which on a direction is observable", "one σ of noise")
    weak: float = assumed(5.0, "σ", "observable directions below are listed as weak", "known to a fifth")

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Return name, value with unit, meaning and source of every assumption."""
        return [
            (
                f.name,
                f"{getattr(self, f.name):g} {f.metadata['unit']}".strip(),
                f.metadata["what"],
                f.metadata["source"],
            )
            for f in fields(self)
        ]


ASSUMED = Assumptions()
