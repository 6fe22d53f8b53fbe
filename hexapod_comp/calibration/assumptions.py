"""Assumptions of calibration about machines, instruments and numbers: every constant of this package, with unit and
source.

Use ``ASSUMED.name``. Numbers given by the readings or textbooks do not belong here; a number that tunes a bar needs an
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
    huber: float = assumed(2.5, "σ", "residuals beyond lose weight in proportion", "Huber 1981: 99 % efficient")
    outlier: float = assumed(5.0, "σ", "residuals beyond are listed", "1 in 1.7 million by chance")
    hyperprior: float = assumed(0.1, "", "parameters that a first tolerance counts as", "or empty blocks collapse")

    # Observations (observations.py)
    centre: float = assumed(5e-3, "m", "error of a centre's stated place, 1 σ of each axis", "by a rule")
    across: float = assumed(
        0.3e-3, "m", "the same where lengths hardly depend on it", "it acts with the machine's error alone"
    )

    # Selection (selection.py)
    least_evidence: float = assumed(2.0, "", "log Bayes factor above which a block is kept", "one number 2 σ from zero")

    # Blocks (blocks/)
    knot_distance: float = assumed(17e-3, "m", "largest distance of a length map's knots", "a wave of 60 mm has 3.5")
    map_correlation: float = assumed(
        40e-3, "m", "correlation length of a length map's errors", "Matérn 5/2; ground screws"
    )
    field_decay: float = assumed(
        0.6, "", "ratio of the priors of one degree of the field and the next", "fields are smooth"
    )
    reversal_degree: int = assumed(2, "", "degree of the field's part that depends on direction", "few reversals read")
    struts_alike: float = assumed(0.998, "", "correlation of the struts' expansions", "one material: 5 % apart")
    struts_warmed_alike: float = assumed(0.9, "", "the same by another part's thermometer", "loaded, cooled unlike")
    least_warming: float = assumed(0.5, "K", "change that determines an expansion", "3 µm on 0.5 m of steel")
    least_damping: float = assumed(
        0.1, "", "change of humidity that determines swelling", "5 µm on 0.5 m of carbon fibre"
    )
    alike: float = assumed(
        0.75, "", "correlation of the struts' stiffnesses, clearances, and frictions", "benchmarks.plants --alike"
    )
    stated_stiffness: float = assumed(0.1, "", "error of a stated stiffness, 1 σ", "catalogues of ball screws: ±10 %")

    # Posterior (posterior.py, datum.py)
    seen: float = assumed(1.0, "σ", "change of all readings above which a direction is observable", "one σ of noise")

    # Lead (lead.py)
    lead_odds: float = assumed(
        25.0, "", "log odds that establish a period, against none and any other", "look-elsewhere"
    )

    # Thermal (thermal.py)
    rate_persistence: float = assumed(3600.0, "s", "how long the rate of a temperature persists", "machines and rooms")
    clear_evidence: float = assumed(10.0, "", "log evidence that establishes a time constant", "odds of 22,000 : 1")
    known_expansion: float = assumed(20e-6, "1/K", "expansion that is plausible for any material", "aluminium: 23e-6")
    known_moisture: float = assumed(5e-4, "m/m", "swelling that is plausible for any material", "polymers, dry to damp")

    # Changes of a machine since its fit (changes.py, check.py); each has several standard deviations, equally likely
    prior_odds: tuple[float, ...] = assumed(
        (1.0, 1.0, 1.0, 1.0, 0.125, 0.25, 0.5),
        "",
        "of datum, strut, temperature, payload, ageing, a wrong reading and all others",
        "ageing as likely as each of the last one's four groups: each can represent the other",
    )
    moved: tuple[float, ...] = assumed(
        (3e-6, 1e-5, 3e-5, 1e-4, 3e-4), "m", "how far joints, struts or the datum may have moved", "wear to crash"
    )
    grown: tuple[float, ...] = assumed(
        (4e-6, 12e-6, 36e-6, 120e-6), "m/m", "growth of a body", "steel by a third of a kelvin to ten kelvin"
    )
    loaded: tuple[float, ...] = assumed((1.0, 3.0, 10.0, 30.0), "kg", "change of a payload", "a probe to a workpiece")
    stiffness: float = assumed(20e6, "N/m", "of a strut with its joints where none is stated", "ball screws of 16 mm")
    aged: tuple[float, ...] = assumed(
        (0.02, 0.05, 0.1, 0.2), "tolerances", "ageing of everything", "joints by 2 to 20 µm of 100"
    )
    bent: tuple[float, ...] = assumed(
        (0.5, 1.0, 2.0, 4.0, 8.0), "tolerances", "a smooth field's growth", "5 µm and 20 µrad"
    )
    worn_pitch: tuple[float, ...] = assumed(
        (1e-5, 3e-5, 1e-4, 3e-4), "m/m", "wear of one screw's pitch", "up to several classes of ISO 3408"
    )
    worn_backlash: tuple[float, ...] = assumed(
        (1e-6, 3e-6, 1e-5, 3e-5), "m", "wear of one screw's backlash", "preload lost"
    )
    wrong_reading: tuple[float, ...] = assumed(
        (5.0, 20.0, 100.0, 1000.0), "σ", "size of one wrong reading", "a slip of a digit"
    )
    scattered: tuple[float, ...] = assumed(
        (2.0, 5.0, 20.0, 100.0), "σ", "additional scatter of all readings", "air, vibration"
    )
    false_alarms: float = assumed(
        0.01, "", "share of unchanged machines that may be reported as changed", "usual level"
    )
    sure: float = assumed(
        0.9, "", "share of the probability at which one kind of change is stated", "chosen: 10 % wrong"
    )
    surely: float = assumed(4.0, "σ", "size beyond which changes, or a negative backlash, are certain", "1 in 16,000")
    # Trust (trust.py, promise.py)
    misfit: tuple[float, float, float] = assumed(
        (1.5, 3.0, 10.0), "", "noise found over noise stated: noted, in doubt, refused", "χ² of 2.25, 9, 100"
    )
    jackknife_prior: float = assumed(
        3.0, "", "degrees of freedom assigned to a covariance", "most likely by benchmarks.promise --ablate"
    )
    drift: float = assumed(11.5e-6, "m/m", "prior of the scale's change over a campaign", "steel by 1 K")
    clear: float = assumed(3.0, "σ", "significance of a drift, a discrepancy or a difference between runs", "1 in 370")
    lack_margin: float = assumed(
        1.5, "", "largest ratio of a discrepancy elsewhere to that at the readings", "benchmarks.promise --ablate"
    )
    fine_terms: float = assumed(
        0.3, "", "uncertainty of a field's fine terms given the coarse ones, log", "factor of 1.35"
    )
    scales: tuple = assumed(
        (("linear", 0.5e-6), ("length", 0.5e-6), ("position", 10e-6)), "m/m", "scale of an instrument, 1 σ", "classes"
    )
    alignment: float = assumed(0.5e-3, "rad", "beam's angle to its line, 1 σ", "set up over half a metre")

    # Mix-ups (mixups.py)
    mixup_odds: float = assumed(1e4, "", "prior odds against any one mix-up", "1 campaign in 100, some 100 ways")
    mistaken: float = assumed(
        10.0, "", "ratio of a mistake common to all readings to the usual deviation", "1 mm; 200 ppm"
    )
    usual_scale: float = assumed(20e-6, "m/m", "scale that screws and instruments may share, 1 σ", "steel by 2 K")

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Return name, value with unit, meaning and source of every assumption."""

        def shown(value: Any) -> str:
            if isinstance(value, tuple):
                named = bool(value) and isinstance(value[0], str)  # of what, and its value
                return (" " if named else ", ").join(map(shown, value))
            return value if isinstance(value, str) else f"{value:g}"

        return [
            (
                f.name,
                f"{shown(getattr(self, f.name))} {f.metadata['unit']}".strip(),
                f.metadata["what"],
                f.metadata["source"],
            )
            for f in fields(self)
        ]


ASSUMED = Assumptions()
