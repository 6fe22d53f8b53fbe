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
    most_left_out: int = assumed(3, "", "most runs left out of a fit that does not settle", "more are a bad campaign")
    slow: float = assumed(0.7, "", "a step that changes more than this share of the last is halved", "steps may swing")
    least_share: float = assumed(0.3, "", "shortest share of a step", "two halvings")
    huber: float = assumed(2.5, "σ", "residuals beyond lose weight in proportion", "Huber 1981: 99 % efficient")
    outlier: float = assumed(5.0, "σ", "residuals beyond are listed", "1 in 1.7 million by chance")
    rounds: int = assumed(12, "", "most rounds of hyperparameters at one step", "they go on at the next step")
    rounds_settled: float = assumed(1e-3, "", "relative change after which rounds stop", "they are known to 1/√(2n)")
    longest_stride: float = assumed(16.0, "", "longest extrapolation of rounds, in rounds", "SQUAREM")
    leap: float = assumed(2.3, "", "largest extrapolated change, logarithm", "a factor of ten")
    hyperprior: float = assumed(0.1, "", "parameters that a first tolerance counts as", "or empty blocks collapse")
    largest_structure: float = assumed(5e-3, "m", "largest tolerance of joints", "no machine is built worse")
    least_freedom: float = assumed(10.0, "", "readings beyond parameters for a noise", "its own error is then 22 %")
    chunk: int = assumed(512, "", "cells whose derivatives are worked out together", "a processor's cache")
    threaded: int = assumed(500, "", "rows from which on threads share the work", "their start: 0.1 ms each")

    # Observations (observations.py)
    centre: float = assumed(5e-3, "m", "where a centre of lengths is beside its place, 1 σ of each axis", "by a rule")
    across: float = assumed(
        0.3e-3, "m", "the same where lengths hardly show it", "it acts with the machine's error alone"
    )
    unmoved: float = assumed(1e-3, "", "change of lengths by a body's motion that hardly shows it", "a circle's centre")
    far: float = assumed(5.0, "σ", "a centre further off its place is refused", "coordinates or unit are wrong")
    frame_stations: int = assumed(4, "", "tracker runs with fewer stations share a frame", "six unknowns need three")
    frame_rank: float = assumed(1e-9, "", "what moves readings less does not count as a frame's", "rounding")

    # Selection (selection.py)
    least_evidence: float = assumed(2.0, "", "log Bayes factor that keeps a block", "one number 2 σ from zero")
    first_rounds: int = assumed(10, "", "rounds of hyperparameters with all blocks in", "they go on in the fit")
    selection_rounds: int = assumed(2, "", "rounds without one block", "they start at the last")

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

    # Lead (lead.py)
    shortest_period: float = assumed(1e-3, "m", "shortest period that is looked for", "no screw repeats faster")
    longest_period: float = assumed(30e-3, "m", "longest", "above, a wave is as smooth as what a length map is for")
    wave_amplitude: float = assumed(10e-6, "m", "prior of amplitudes while periods are compared", "loose")
    lead_odds: float = assumed(25.0, "", "log odds that show a period, against none and any other", "look-elsewhere")
    lead_freedom: float = assumed(200.0, "", "fewest readings beyond the parameters that show one", "a wave has 12")
    lead_readings: int = assumed(5000, "", "readings in which it is looked for first", "plenty; time")
    lead_agrees: float = assumed(6.0, "σ", "a given or a round lead agrees within", "misfits of other terms")
    lead_close: float = assumed(5e-3, "", "share of a lead by which another agrees too", "no screws are nearer")

    # Thermal (thermal.py)
    thermometer_bin: float = assumed(60.0, "s", "readings of a sensor within that count as one", "twice the filter")
    rate_persistence: float = assumed(3600.0, "s", "how long the rate of a temperature persists", "machines and rooms")
    clear_evidence: float = assumed(10.0, "", "log evidence that shows a time constant", "odds of 22,000 : 1")
    known_expansion: float = assumed(20e-6, "1/K", "expansion that surprises in no material", "aluminium: 23e-6")
    known_late: float = assumed(60e-6, "1/K", "what of it may come late", "a part much faster than its thermometer")
    known_moisture: float = assumed(5e-4, "m/m", "swelling that surprises in no material", "polymers, dry to damp")

    # Changes of a machine since its fit (changes.py, check.py); each has some standard deviations, equally likely
    prior_odds: tuple[float, ...] = assumed(
        (1.0, 1.0, 1.0, 0.125, 0.25, 0.5),
        "",
        "of datum, strut, temperature, ageing, a wrong reading and all else",
        "ageing as likely as each of the last one's four groups: each can stand for the other",
    )
    moved: tuple[float, ...] = assumed(
        (3e-6, 1e-5, 3e-5, 1e-4, 3e-4), "m", "how far joints, struts or the datum may have moved", "wear to crash"
    )
    grown: tuple[float, ...] = assumed(
        (4e-6, 12e-6, 36e-6, 120e-6), "m/m", "growth of a body", "steel by a third of a kelvin to ten kelvin"
    )
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
        (5.0, 20.0, 100.0, 1000.0), "σ", "how far off one wrong reading may be", "a slip of a digit"
    )
    scattered: tuple[float, ...] = assumed(
        (2.0, 5.0, 20.0, 100.0), "σ", "additional scatter of all readings", "air, vibration"
    )
    false_alarms: float = assumed(0.01, "", "share of unchanged machines that may be called changed", "usual level")
    sure: float = assumed(
        0.9, "", "share of the probability at which one kind of change is stated", "chosen: 10 % wrong"
    )
    surely: float = assumed(4.0, "σ", "changes of this size are surely seen", "1 in 16,000 missed by chance")
    unchanged_draws: int = assumed(4000, "", "unchanged machines drawn to find the false alarms", "1 % to ± 0.16 %")
    most_check_readings: int = assumed(500, "", "readings of a check; more are a calibration", "chosen")
    # Trust (trust.py, promise.py)
    refused_noise: float = assumed(10.0, "", "noise found over noise stated that refuses a fit", "χ² of 100")
    doubtful_noise: float = assumed(3.0, "", "the same that puts it in doubt", "χ² of 9")
    by_chance: float = assumed(0.002, "", "how rarely runs of a right model differ more than is called clear", "3 σ")
    jackknife_prior: float = assumed(
        12.0, "", "freedom with which a covariance is believed", "most likely by benchmarks.promise --ablate"
    )
    drift: float = assumed(11.5e-6, "m/m", "prior of the scale's change over a campaign", "steel by 1 K")
    clear: float = assumed(3.0, "σ", "a drift or a discrepancy that is no chance", "1 in 370")
    held: float = assumed(0.5, "", "share of a promise that may come from the priors", "half")
    fine_terms: float = assumed(0.3, "", "how well coarse terms of a field tell the fine ones, log", "factor of 1.35")
    scales: tuple = assumed(
        (("linear", 0.5e-6), ("length", 0.5e-6), ("position", 10e-6)), "m/m", "scale of an instrument, 1 σ", "classes"
    )
    alignment: float = assumed(0.5e-3, "rad", "beam's angle to its line, 1 σ", "set up over half a metre")

    # Mix-ups (mixups.py)
    mixup_odds: float = assumed(1e4, "", "prior odds against any one mix-up", "1 campaign in 100, some 100 ways")
    mixup_readings: int = assumed(2500, "", "readings, at random, by which mix-ups are weighed", "tell by far; time")
    mixup_few: int = assumed(400, "", "readings by which other frames and machines are tried first", "time")
    mixup_rounds: int = assumed(10, "", "rounds of estimating priors and noise for an alternative", "as in selection")
    mixup_first_rounds: int = assumed(2, "", "the same where other frames and machines are tried first", "time")
    noisy: float = assumed(1.5, "", "noise found over noise stated that is remarked on", "χ² of 2.25")
    mistaken: float = assumed(10.0, "", "a mistake that all readings share, over what is usual", "1 mm; 200 ppm")
    mode_rounds: int = assumed(3, "", "rounds in which priors are estimated with such a mistake", "as steps of a fit")
    usual_scale: float = assumed(20e-6, "m/m", "scale that screws and instruments may share, 1 σ", "steel by 2 K")
    mixup_finalists: int = assumed(3, "", "alternatives of a sort for which they are estimated", "time")
    parallel: float = assumed(0.999, "", "cosine from which a line is parallel to an axis", "2.6° off")
    negative_backlash: float = assumed(4.0, "σ", "backlash so far below zero is no noise", "3 in 100,000")
    strange_check: float = assumed(100.0, "", "χ² per number above which check readings may be misread", "10 × noise")
    plausible_check: float = assumed(10.0, "", "χ² per number of check readings read rightly", "3 × noise")
    as_good_check: float = assumed(3.0, "", "χ² ratio to the best at which another is named", "1.7 × noise")

    # Design of measurements (design.py, candidates.py)
    faint: float = assumed(0.05, "σ", "directions that readings see by less are left out", "0.25 % of a variance")
    least_reached: float = assumed(0.3, "", "share of the box in which the tool must tilt as wanted", "chosen")
    tilts: tuple = assumed((10.0, 5.0, 2.0), "°", "tilts of scattered poses: the first within reach", "usual limits")
    crash: float = assumed(20e-6, "m", "change of a strut that a proposed check is to name", "a light collision")
    warmth: float = assumed(12e-6, "m/m", "growth of all struts that it is to name", "steel by a kelvin")
    check_readings: int = assumed(12, "", "readings of a proposed check", "named 20 µm in 95 % (benchmarks.upkeep)")
    machines_drawn: int = assumed(2000, "", "machines drawn for the percentile of the worst pose", "95 % to ± 0.5 %")

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
