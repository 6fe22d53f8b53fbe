"""Assumptions of the calibration: all constants that follow from no reading and no textbook, with unit and source.

A constant chosen with a benchmark needs an ablation in benchmarks/ on machines that did not serve to choose it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


def assumed(value: Any, unit: str, what: str, source: str) -> Any:
    return field(default=value, metadata={"unit": unit, "what": what, "source": source})


@dataclass(frozen=True)
class Assumptions:
    # Estimator (estimator.py)
    huber: float = assumed(2.5, "σ", "|residual| / σ above which Huber's weight is < 1", "Huber 1981: 99 % efficiency")
    outlier: float = assumed(5.0, "σ", "|residual| / σ of an outlier exceeds this", "noise causes 1 in 1.7 million")
    hyperprior: float = assumed(
        0.1, "parameters", "weight of the first guess of a block's prior σ", "keeps the prior σ above 0"
    )

    # Observations (observations.py)
    centre: float = assumed(
        5e-3, "m", "σ, along each axis, of a stated centre from which distances are read", "measured with a ruler"
    )
    centre_unseen: float = assumed(
        0.3e-3,
        "m",
        "σ of a stated centre in the directions in which moving the centre hardly changes the distances read",
        "on a machine without errors, the distances read do not show that a centre is wrong by this",
    )

    # Selection (selection.py)
    least_evidence: float = assumed(2.0, "", "log Bayes factor from which the fit keeps a block", "a parameter of 2 σ")

    # Blocks (blocks/)
    knot_distance: float = assumed(
        17e-3, "m", "largest distance between neighbouring knots of a length map", "3.5 knots per wave of 60 mm"
    )
    map_correlation: float = assumed(
        40e-3, "m", "correlation length of a screw's length errors", "Matérn 5/2 prior; typical of ground screws"
    )
    field_decay: float = assumed(
        0.6, "", "prior σ of a term of the error field / prior σ of a term of one degree less", "fields are smooth"
    )
    reversal_degree: int = assumed(2, "", "largest degree of the block `field reversal`", "few readings show reversals")
    struts_alike: float = assumed(
        0.998, "", "prior correlation of the struts' expansions", "expansions of struts of one material differ by 5 %"
    )
    struts_warmed_alike: float = assumed(
        0.9,
        "",
        "prior correlation of the struts' expansions if one thermometer is used for all parts",
        "some struts warm and cool faster than others",
    )
    least_warming: float = assumed(
        0.5, "K", "smallest change of temperature with which thermal expansion is fitted", "3 µm on 0.5 m of steel"
    )
    least_damping: float = assumed(
        0.1, "", "smallest change of relative humidity with which swelling is fitted", "5 µm on 0.5 m of carbon fibre"
    )
    alike: float = assumed(
        0.75, "", "prior correlation of the struts' stiffnesses, clearances and frictions", "benchmarks.plants --alike"
    )
    stated_stiffness: float = assumed(0.1, "", "relative error of a stated stiffness, 1 σ", "ball screw catalogues")

    # Posterior (posterior.py, datum.py)
    seen: float = assumed(1.0, "", "√Σ(change of a reading / σ)² from which an error is seen", "as large as noise")

    # Lead (lead.py)
    lead_odds: float = assumed(25.0, "", "log odds from which a screw lead is detected", "many leads are tried")

    # Thermal (thermal.py)
    rate_persistence: float = assumed(3600.0, "s", "correlation time of a temperature's rate", "machines and rooms")
    clear_evidence: float = assumed(10.0, "", "log odds from which a time constant is used", "odds of 22,000 : 1")
    known_expansion: float = assumed(
        20e-6, "1/K", "an expansion's standard error is computed with a prior σ of at least this", "aluminium"
    )
    known_moisture: float = assumed(
        5e-4, "m/m", "a swelling's standard error is computed with a prior σ of at least this", "polymers"
    )

    # Changes of a machine since its fit (changes.py, check.py). Tuples of numbers: equally likely standard deviations
    prior_odds: tuple = assumed(
        (
            ("datum", 1.0),
            ("strut", 1.0),
            ("temperature", 1.0),
            ("payload", 1.0),
            ("ageing", 0.125),
            ("reading", 0.25),
            ("other", 0.5),
        ),
        "",
        "prior odds of the kinds of change",
        "ageing and a bend of the field (one of 4 groups in `other`) have similar effects: odds of 0.125 each",
    )
    moved: tuple[float, ...] = assumed(
        (3e-6, 1e-5, 3e-5, 1e-4, 3e-4),
        "m",
        "displacement of a joint or of the datum, or change of a strut's length offset",
        "from wear to a crash",
    )
    grown: tuple[float, ...] = assumed(
        (4e-6, 12e-6, 36e-6, 120e-6), "m/m", "thermal growth of a part", "steel warmed by 0.33 K to 10 K"
    )
    loaded: tuple[float, ...] = assumed((1.0, 3.0, 10.0, 30.0), "kg", "change of a payload", "a probe to a workpiece")
    stiffness: float = assumed(20e6, "N/m", "stiffness of a strut with its joints, if not stated", "16 mm ball screws")
    aged: tuple[float, ...] = assumed(
        (0.02, 0.05, 0.1, 0.2), "tolerances", "change of every parameter by ageing", "2 to 20 µm of a joint"
    )
    bent: tuple[float, ...] = assumed(
        (0.5, 1.0, 2.0, 4.0, 8.0), "tolerances", "change of the field", "its tolerances are 5 µm and 20 µrad"
    )
    worn_pitch: tuple[float, ...] = assumed(
        (1e-5, 3e-5, 1e-4, 3e-4), "m/m", "change of one screw's pitch by wear", "up to several classes of ISO 3408"
    )
    worn_backlash: tuple[float, ...] = assumed(
        (1e-6, 3e-6, 1e-5, 3e-5), "m", "change of one screw's backlash by wear", "the nut loses its preload"
    )
    wrong_reading: tuple[float, ...] = assumed(
        (5.0, 20.0, 100.0, 1000.0), "σ", "error of a single wrong reading", "one wrong digit"
    )
    scattered: tuple[float, ...] = assumed(
        (2.0, 5.0, 20.0, 100.0), "σ", "additional scatter of all readings", "air turbulence, vibration"
    )
    false_alarms: float = assumed(0.01, "", "share of unchanged machines reported as changed", "usual test level")
    sure: float = assumed(
        0.9, "", "probability from which a check names a kind of change", "10 % of named changes may be wrong"
    )
    surely: float = assumed(
        4.0, "σ", "a change or a negative backlash counts as real from this size", "noise: 1 in 16,000"
    )
    # Trust (trust.py, promise.py)
    misfit: tuple[float, float, float] = assumed(
        (1.5, 3.0, 10.0),
        "",
        "estimated / stated σ of the readings above which a fit has a note, a doubt, a refusal",
        "χ² 2.25, 9, 100",
    )
    jackknife_prior: float = assumed(
        3.0,
        "",
        "degrees of freedom of the prior of the jackknife factor on the parameters' covariance",
        "best in benchmarks.promise --ablate",
    )
    drift: float = assumed(11.5e-6, "m/m", "drift of scale during a campaign, 1 σ", "steel warmed by 1 K")
    clear: float = assumed(
        3.0, "σ", "a drift, discrepancy or difference of runs counts as real from this size", "1 in 370 by noise"
    )
    lack_margin: float = assumed(
        1.5,
        "",
        "factor by which an error that no parameter describes may be larger between measured places than at them",
        "benchmarks.promise --ablate",
    )
    fine_terms: float = assumed(0.3, "", "σ of log(estimated / true prior σ), maps and field", "factor of 1.35")
    scales: tuple = assumed(
        (("linear", 0.5e-6), ("length", 0.5e-6), ("position", 10e-6)),
        "m/m",
        "σ of an instrument's scale error, for each kind of channel",
        "accuracy classes of lasers, ball bars, trackers",
    )
    alignment: float = assumed(0.5e-3, "rad", "angle of laser beam to motion, 1 σ", "aligned over half a metre")

    # Mix-ups (mixups.py)
    mixup_odds: float = assumed(1e4, "", "prior odds against each mix-up", "100 mix-ups, in 1 of 100 campaigns")
    mistaken: float = assumed(
        10.0,
        "",
        "prior σ of an effect that a mistake causes / prior σ of the effect if a machine error causes it",
        "a mistake: joint 1 mm off, usual 0.1 mm; scale 200 ppm off, usual 20 ppm",
    )
    usual_scale: float = assumed(20e-6, "m/m", "usual scale error of screws and instruments", "steel warmed by 2 K")
    usual_lead: float = assumed(
        0.5e-3, "m", "usual error of a screw's lead, if joints turn the screw", "joint axes 3° off those in the file"
    )

    def rows(self) -> list[tuple[str, str, str, str]]:
        def shown(value: Any) -> str:
            if isinstance(value, tuple):
                named = bool(value) and isinstance(value[0], str)  # a pair of a name and its value
                return (" " if named else ", ").join(map(shown, value))
            return value if isinstance(value, str) else f"{value:g}"

        rows = []
        for f in fields(self):
            value = f"{shown(getattr(self, f.name))} {f.metadata['unit']}".strip()
            rows.append((f.name, value, f.metadata["what"], f.metadata["source"]))
        return rows


ASSUMED = Assumptions()
