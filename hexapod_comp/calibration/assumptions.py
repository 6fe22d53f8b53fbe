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
