"""Fit a machine model to measurements (scheme ``joint``: one least-squares problem), and evaluate the fit.

:func:`_begin` smooths temperatures, and estimates time constants of growth and the screws' lead; :func:`_choose`
selects blocks of parameters and fits them; :func:`_fit` predicts the tool error, collects doubts, holds the datum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from ..errors import CalibrationError, HexapodError, ModelError
from ..machine.arrays import rms
from ..machine.load import Payload
from ..machine.model import MachineModel, ModelOrigin
from ..machine.model_file import check_possible
from ..machine.surroundings import load_row
from ..machine.temperatures import PARTS, REFERENCE_TEMPERATURE
from ..measurements.readings import CHANNELS, FROM_PREVIOUS, KINDS, MeasurementSet, refuse_unmoved, si_unit
from ..pose import Pose
from .assumptions import ASSUMED
from .blocks import WAVES
from .blocks.block import DIGITS
from .blocks.load import measured_loads, refuse_half_stated, stated_load
from .datum import HeldDatum, hold, refuse_unreachable, unseen_part
from .estimator import (
    ROUNDS,
    SETTLED,
    Estimation,
    LinearProblem,
    NotSettled,
    Posterior,
    Solution,
    influence,
    iterate,
    physical_covariance,
    solve,
)
from .lead import ScrewLead, detect_lead
from .mixups import SWAPPED, mixups
from .parameters import FitSettings, ParameterSpace
from .posterior import (
    FittedParameters,
    Observability,
    ToolError,
    UnseenError,
    about_other_loads,
    box_errors,
    expected_error,
    listed,
    observe,
    without_trace,
)
from .promise import Unexplained
from .selection import Decision, select
from .thermal import ThermalEvidence, TimeConstant, estimate_time_constants, with_courses
from .trust import (
    FIELDS,
    TILT,
    ChiSquare,
    Residuals,
    chi_squares,
    held_by_priors,
    note_on_unstated,
    unexplained,
    with_drift,
)

WARM = 0.2  # K; further from 20 °C a note reports that no expansion is fitted: 0.5 m of steel grows by 1 µm
NEGLIGIBLE = 1e-5  # models are not averaged if some omitted block is present with a smaller probability
FEWEST_NEGATIVE = 4  # struts with negative backlash; so many show that forward and backward are swapped
MOST_LEFT_OUT = 3  # largest number of runs that are left out so that a fit converges


class ChannelFit(NamedTuple):
    kind: str  # one of KINDS
    readings: int
    stated: float  # standard deviation of a reading: stated (RMS), or the default
    found: float  # standard deviation of a reading: estimated
    chi_square: float  # Σ (residual / stated)² / degrees of freedom
    held_out: float  # RMS of (mean reading − its prediction by a fit without its line or pose)
    unit: str  # m or rad


class Outlier(NamedTuple):
    source: str  # file and line
    run: str
    channel: str
    residual: float
    sigmas: float  # residual / estimated standard deviation of a reading
    unit: str  # m or rad


@dataclass(frozen=True)
class ModelFit:
    """The result of a fit with ``--scheme joint``: the model, its uncertainty, and warnings about it."""

    model: MachineModel  # the fitted machine, moved as a whole to hold the datum
    measurements: MeasurementSet
    space: ParameterSpace
    solution: Solution
    decisions: tuple[Decision, ...]  # on each block
    channels: tuple[ChannelFit, ...]  # for each kind of channel
    observability: Observability
    unseen_errors: tuple[UnseenError, ...]  # machine errors that the readings do not show
    level: ToolError | None  # expected tool error with this model, level tool; None: no place of the box is reachable
    tilted: ToolError | None  # the same, tool tilted by :data:`~.trust.TILT`
    unexplained: Unexplained  # errors beyond the parameters' covariance
    chi_squares: tuple[ChiSquare, ...]  # of each kind of channel, by family of lines and by direction of motion
    chi_squares_of_runs: tuple[ChiSquare, ...]  # of each kind of channel, by run; the largest first
    refusals: tuple[str, ...]  # reasons why the model is written only with --force
    doubts: tuple[str, ...]  # further reasons to doubt the model
    notes: tuple[str, ...]
    outliers: tuple[Outlier, ...]  # the largest first
    held: HeldDatum
    warming: ThermalEvidence
    lead: ScrewLead | None  # None: not searched for
    held_out: np.ndarray  # (C,): (mean reading − its prediction by a fit without its line or pose) / stated σ

    @property
    def misfit(self) -> str:
        """The reasons to refuse the model, as one text."""
        return "; ".join(self.refusals)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (size, size) of the parameters, SI, times the square of the factor from the jackknife."""
        return self.unexplained.factor**2 * physical_covariance(self.space, self.solution.posterior)

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors (size,) of the parameters, SI."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def parameters(self) -> FittedParameters:
        """The parameters with their covariance, for the posterior file."""
        p = self.solution.posterior
        return FittedParameters(self.space, self.solution.x, self.covariance, p.tolerances, p.noise, self.held)

    def under(self, payload: Payload, gravity: Sequence[float] | None = None) -> ToolError | None:
        """Return the expected error of a level tool with `payload`, provided that the compensator knows the payload."""
        load = load_row(payload) if gravity is None else load_row(payload, gravity)
        covariance = physical_covariance(self.space, self.solution.posterior)
        return expected_error(box_errors(self.space, self.solution.x, load=load), covariance, beyond=self.unexplained)


def fit_model(
    measurements: MeasurementSet,
    settings: FitSettings | None = None,
    progress: Callable[[str], object] = lambda text: None,
    datum: Pose | None = None,
) -> ModelFit:
    """Return the fit of structure, struts and error field to all readings at once.

    Parameters
    ----------
    measurements : MeasurementSet
        Readings of any kind.
    settings : FitSettings, optional
        Blocks, stated values and options.
    progress : callable
        Called with a text for each step.
    datum : Pose, optional
        ``pose_platform_in_base`` at which the model has no tool error in directions that the readings do not show; home
        by default.

    Raises
    ------
    CalibrationError
        If the machine cannot reach the datum, the readings are too few or all zero, the fit does not converge, or
        forward and backward are swapped. The error's message lists mix-ups that would explain the readings better.
    """
    datum = measurements.geometry.home if datum is None else datum
    refuse_unreachable(measurements.geometry, datum)
    refuse_half_stated(measurements)
    begun = _begin(measurements, settings or FitSettings(), progress)
    try:
        try:
            return _fit(measurements, begun, progress, datum)
        except NotSettled as error:
            return _fit_without_influential_runs(measurements, begun, error, progress, datum)
    except HexapodError as error:
        space = begun.everything.space
        named = mixups(begun.everything, [block.name for block in space.blocks], progress)
        nominal = solve(space, begun.problem, space.start_tolerances(), np.ones(len(KINDS)))
        if len(_negative_backlash(space, nominal)) >= FEWEST_NEGATIVE:
            named.append(SWAPPED)
        if named:
            error.with_lines("\n".join(f"  {cause}" for cause in named))
        raise


def _fit_without_influential_runs(
    measurements: MeasurementSet,
    begun: _Begun,
    unsettled: NotSettled,
    progress: Callable[[str], object],
    datum: Pose,
) -> ModelFit:
    """Leave out one run after the other, each time the most influential one, until a fit converges; return this fit.

    If the fit still does not converge without MOST_LEFT_OUT runs, return the fit to all runs, with a refusal.
    """
    kept, names, error = measurements, list[str](), unsettled
    while len(names) < MOST_LEFT_OUT and len(np.unique(kept.run)) > 1:
        run_of_mean = kept.run[Estimation(kept, begun.everything.space, check_count=False).means.first]
        worst = int(np.unique(run_of_mean)[influence(run_of_mean, error.solution).argmax()])
        names.append(kept.runs[worst].name)
        progress(f"the fit does not converge: trying without run {names[-1]}, which changes the parameters most")
        kept = kept.select(kept.run != worst)
        try:
            fit = _fit(kept, _begin(kept, begun.everything.space.settings, progress), progress, datum)
        except NotSettled as again:
            error = again
            continue
        except HexapodError:
            break
        doubt = f"left out because the fit does not converge otherwise: run {', run '.join(names)}"
        return replace(fit, doubts=(doubt, *fit.doubts))
    fit = _fit(measurements, begun, progress, datum, must_converge=False)
    influential = f"; it also fails without the runs that influence it most: {', '.join(names)}" if names else ""
    return replace(fit, refusals=(unsettled.problem + influential, *fit.refusals))


def mixed_up(measurements: MeasurementSet, settings: FitSettings) -> list[str]:
    """Return the mix-ups that would make the readings more probable, the most probable first, without a full fit."""
    begun = _begin(measurements, settings, lambda text: None)
    decisions = select(begun.everything.space, begun.problem, np.ones(len(KINDS)), lambda text: None)[0]
    return mixups(begun.everything, [d.block for d in decisions if d.kept])


class _Begun(NamedTuple):
    everything: Estimation  # with all blocks that the settings allow
    problem: LinearProblem  # linearised at the nominal machine
    lead: ScrewLead | None  # None: not searched for
    constants: tuple[TimeConstant, ...]


def _begin(measurements: MeasurementSet, settings: FitSettings, progress: Callable[[str], object]) -> _Begun:
    """Smooth temperatures; estimate time constants and, if waves are allowed and all screws have one lead, the lead."""
    measurements = with_courses(measurements)
    constants = estimate_time_constants(measurements, ParameterSpace(measurements, settings), progress)
    if constants:
        settings = replace(settings, time_constants=tuple(constant.value for constant in constants))
    everything = Estimation(measurements, ParameterSpace(measurements, settings))
    nominal, trust = np.zeros(everything.space.size), np.ones(len(measurements))
    problem, residuals = everything.linearise(nominal, trust)
    refuse_unmoved(measurements, residuals)
    known = everything.space.periods[np.isfinite(everything.space.periods)]
    if not set(settings.blocks) & set(WAVES) or len(np.unique(known)) > 1:
        return _Begun(everything, problem, None, constants)
    progress("searching for the screws' lead")
    lead = detect_lead(everything, problem)
    if lead.given is None and lead.used is not None:
        everything = Estimation(measurements, ParameterSpace(measurements, replace(settings, lead=lead.used)))
        problem, _ = everything.linearise(np.zeros(everything.space.size), trust)
    return _Begun(everything, problem, lead, constants)


def _fit(
    measurements: MeasurementSet,
    begun: _Begun,
    progress: Callable[[str], object],
    datum: Pose,
    must_converge: bool = True,
) -> ModelFit:
    """Select blocks, fit them, evaluate the fit; with `must_converge`, raise NotSettled if it does not converge."""
    everything, nominal, lead, constants = begun
    settings = everything.space.settings
    decisions, possible, estimation, solution = _choose(everything, nominal, progress, must_converge)
    residuals, space = with_drift(estimation, solution), estimation.space
    solution, posterior = residuals.solution, residuals.solution.posterior
    channels = tuple(_channels(residuals))
    backlash = list(_check_backlash(space, solution))
    progress("evaluating the fit")
    mixed = mixups(everything, [d.block for d in decisions if d.kept], progress)

    beyond = unexplained(residuals, settings, _averaged(residuals, everything.space, possible, decisions))
    covariance = physical_covariance(space, posterior)
    # A field that was fitted to readings with a level tool does not describe errors of a tilted tool
    level_only = space.block(FIELDS[0]) is not None and measurements.tilt() < 0.5 * TILT
    boxes = residuals.level, None if level_only else box_errors(space, solution.x, TILT)
    level, tilted = (expected_error(errors, covariance, beyond=beyond) for errors in boxes)
    unseen = unseen_errors(everything, nominal)
    if rolls := [error for error in unseen if error.name.startswith("roll")]:
        level, tilted = (
            error and replace(error, rotation_low=None, rotation_high=None, rotation_unknown=listed(rolls))
            for error in (level, tilted)
        )

    noise = {KINDS.index(c.kind): c.found for c in channels}
    far_off, doubtful = (measurements.misfit(noise, n) for n in ASSUMED.misfit[:0:-1])
    widening, widened = beyond.findings()
    refusals, doubts = [far_off], ["" if far_off else doubtful, *widening]
    if solution.change >= SETTLED:
        moved = f"a parameter still changes by {solution.change:.2g} standard deviations per step"
        doubts.append(f"the fit has not converged: after {solution.steps} steps {moved}")
    if level is not None and np.hypot(level.after, beyond.scatters[0].lack) > level.before:
        problem = "the tool error expected with the model is larger than the tool error without it"
        refusals.append(f"{problem}: the readings show too little")
    if held_by_priors(residuals):
        many = f"{len(measurements)} readings do not determine the {space.size} parameters"
        refusals.append(f"{many}: the expected tool error comes from the priors")
    loads = measured_loads(stated_load(space.settings), space.geometry, measurements.stations)
    elsewhere = about_other_loads(space, solution.x, covariance, beyond) if loads else ""
    notes = [*measurements.notes, *_about_inputs(measurements, space, lead, loads, elsewhere), *backlash]
    noisy = [f"{c.kind} {c.found / c.stated:.1f} times" for c in channels if c.found > ASSUMED.misfit[0] * c.stated]
    if noisy:
        problem = f"readings scatter by more than their stated σ ({', '.join(noisy)})"
        cause = "the model lacks an error of the machine or of an instrument"
        if (measurements.direction == FROM_PREVIOUS).any():
            cause += ", or poses of a sequence were not reached straight from the pose in the row before"
        notes.append(f"{problem}: {cause}; the expected tool error includes it")
    notes += [*widened, note_on_unstated(measurements)]
    if level_only:
        notes.append("a field was fitted to readings with a level tool only: no error is predicted for a tilted tool")

    kept = ", ".join(block.name for block in space.blocks)
    note = f"scheme joint, {len(measurements)} readings, blocks {kept} (of {len(decisions) + 1} tried)"
    if level is not None:
        note += f", expected tool error {level.after * 1e6:.3f} µm RMS, up to {level.high * 1e6:.3f} (95 %)"
    lengths = [c.held_out for c in channels if c.unit == "m"]
    left = rms(lengths) if lengths else None
    origin = ModelOrigin(date.today().isoformat(), measurements.files, left, note, loads=loads)
    as_solved = replace(space.model(solution.x.round(DIGITS)), origin=origin)
    part = unseen_part(everything, nominal, posterior.tolerances[0], posterior.noise, datum)
    model, held = hold(measurements.geometry, as_solved, datum, part)
    try:
        check_possible(model)
    except ModelError as error:
        refusals.append(f"the fit reached parameters that no machine can have ({error})")
    families, runs = chi_squares(residuals)
    return ModelFit(
        model=model,
        measurements=measurements,
        space=space,
        solution=solution,
        decisions=tuple(decisions),
        channels=channels,
        observability=observe(space, solution.problem, posterior, measurements.tilt()),
        unseen_errors=unseen,
        level=level,
        tilted=tilted,
        unexplained=beyond,
        chi_squares=families,
        chi_squares_of_runs=runs,
        refusals=tuple(filter(None, [*refusals, *mixed])),
        doubts=tuple(filter(None, doubts)),
        notes=tuple(filter(None, notes)),
        outliers=tuple(_outliers(estimation, solution)),
        held=held,
        warming=ThermalEvidence.of(measurements, estimation, solution, constants, beyond.factor),
        lead=lead,
        held_out=residuals.held_out,
    )


Start = tuple[ParameterSpace, np.ndarray, np.ndarray, np.ndarray]
"""Starting values of a fit: parameter space, x, tolerances and noise factors of an earlier solution."""


def _choose(
    everything: Estimation, problem: LinearProblem, progress: Callable[[str], object], must_converge: bool
) -> tuple[list[Decision], Posterior, Estimation, Solution]:
    """Choose blocks and fit them; return the decisions, the posterior of all blocks, and the fit of the kept blocks."""
    space, trust = everything.space, np.ones(len(everything.measurements))

    def fitted(start: Start) -> tuple[Estimation, Solution]:
        settings = replace(space.settings, blocks=tuple(d.block for d in decisions if d.kept))
        estimation = Estimation(everything.measurements, ParameterSpace(everything.measurements, settings))
        try:
            return estimation, iterate(estimation, *_carried_over(start, estimation.space), progress)
        except NotSettled as error:
            if must_converge:
                raise
            return estimation, error.solution

    if {"lost motion", "friction"} & {block.name for block in space.blocks}:
        for _ in range(2):  # effects of forces are nonlinear: linearise near the solution
            first = solve(space, problem, space.start_tolerances(), np.ones(len(KINDS)), ROUNDS)
            problem, _ = everything.linearise(space.physical(first.every(space.size)), trust)
    decisions, possible, kept = select(space, problem, np.ones(len(KINDS)), progress)
    start = space, space.physical(kept.every(space.size)), kept.tolerances, kept.noise
    if not any(d.kept for d in decisions):  # start from the nominal machine
        start = space, np.zeros(space.size), space.start_tolerances(), np.ones(len(KINDS))
    estimation, solution = fitted(start)
    if solution.weights.min() < ASSUMED.huber / ASSUMED.outlier:  # outliers: select again, with weights
        start = estimation.space, solution.x, solution.posterior.tolerances, solution.posterior.noise
        x, _, noise = _carried_over(start, space)
        problem, _ = everything.linearise(x, solution.weights)
        before = [d.kept for d in decisions]
        decisions, possible, _ = select(space, problem, noise, progress)
        if [d.kept for d in decisions] != before:
            estimation, solution = fitted(start)
    return decisions, possible, estimation, solution


def _carried_over(start: Start, space: ParameterSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    earlier, x, tolerances, noise = start
    return *space.carried_over(earlier, x, tolerances), noise


def _averaged(r: Residuals, everything: ParameterSpace, possible: Posterior, decisions: Sequence[Decision]) -> float:
    """Return the factor ≥ 1 by which Bayesian model averaging increases the RMS tool error: √(p · (a / b)² + 1 − p).

    a is the expected RMS error of the compensated tool if the machine has the errors of all blocks, b if it has those
    of the kept blocks. p is the probability, at even prior odds, that the machine has an error of a dropped block.
    """
    present = 1.0 - float(np.prod([expit(-d.evidence) for d in decisions if not d.kept]))
    if present < NEGLIGIBLE or not r.expected > 0.0:
        return 1.0
    p = r.solution.posterior
    x, _, _ = _carried_over((r.estimation.space, r.solution.x, p.tolerances, p.noise), everything)
    errors = box_errors(everything, x)
    if errors is None:
        return 1.0
    metric, shift = errors.mean_squares[0], everything.physical(possible.every(everything.size)) - x
    square = np.vdot(metric, physical_covariance(everything, possible)) + shift @ metric @ shift
    return float(np.sqrt(max(1.0, 1.0 + present * (float(square) / r.expected - 1.0))))


def unseen_errors(estimation: Estimation, problem: LinearProblem) -> tuple[UnseenError, ...]:
    settings = replace(estimation.space.settings, blocks=FIELDS)
    return without_trace(ParameterSpace(estimation.measurements, settings), estimation, problem)


def _negative_backlash(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the indices of struts whose fitted backlash is more than ASSUMED.surely standard errors below zero."""
    block = space.block("backlash")
    if block is None:
        return np.zeros(0, dtype=int)
    below = posterior.y < -ASSUMED.surely * np.sqrt(np.diag(posterior.covariance))
    return posterior.used[posterior.within(block.part) & below] - block.part.start


def _check_backlash(space: ParameterSpace, solution: Solution) -> list[str]:
    """Return notes on struts with negative backlash; raise CalibrationError if there are FEWEST_NEGATIVE or more."""
    negative, block = _negative_backlash(space, solution.posterior), space.block("backlash")
    values = [] if block is None else [f"{value * 1e6:.2f}" for value in solution.x[block.part]]
    if len(negative) >= FEWEST_NEGATIVE:
        problem = f"{SWAPPED}: the struts would have a backlash of {', '.join(values)} µm"
        raise CalibrationError("direction", problem)
    return [f"strut_{i + 1}: backlash was estimated as {values[i]} µm; the model has 0" for i in negative]


def _about_inputs(
    measurements: MeasurementSet,
    space: ParameterSpace,
    lead: ScrewLead | None,
    loads: Sequence[Sequence[float]],
    elsewhere: str,
) -> Iterator[str]:
    """Yield notes on loads, lead, temperatures and humidity that are stated, missing or inconsistent."""
    if loads:
        rows = np.array(loads)
        low, high = rows[:, 0].min(), rows[:, 0].max()
        masses = f"a tool of {low:g} kg" if low == high else f"tools of {low:g} to {high:g} kg"
        directions = len(np.unique(rows[:, 4:], axis=0))
        gravity = "one direction of gravity" if directions == 1 else f"{directions} directions of gravity"
        others = f"; {elsewhere}" if elsewhere else " alone, because no struts' stiffness is stated (--load)"
        if len(rows) > 1 and not elsewhere:
            others += "; deflections that differ between these loads appear as other errors"
        where = f"the readings were taken with {masses} and {gravity}"
        yield f"{where}: the predicted tool error is valid for these loads{others}"
    if lead is not None and lead.given is not None and lead.shown is not None and not lead.agrees:
        problem = f"by the readings, the screws' errors repeat every {lead.shown * 1e3:.4g} mm"
        yield f"{problem}: is the given lead of {lead.given * 1e3:.6g} mm right?"
    if lead is not None and lead.used is None:
        problem = "the screws' lead is not known, and the readings show no periodic error of the screws"
        yield f"{problem}: such errors are not fitted"
    warmth = np.abs(measurements.stations.temperatures - REFERENCE_TEMPERATURE).max()
    if warmth > WARM and space.block("expansion") is None and not space.stated_expansion.any():
        problem = f"the readings were taken at up to {warmth:.1f} K from 20 °C"
        yield f"{problem}, but no thermal expansion is stated or fitted: thermal growth appears as other errors"
    read = measurements.stations.thermometers
    cold = [name for name in PARTS if name not in read]
    if 0 < len(cold) < len(PARTS) and not space.settings.thermometer:
        what = f"no thermometer on {', '.join(cold)}: {REFERENCE_TEMPERATURE:g} °C is assumed there"
        yield f"{what}; add a column for each part without one (or temperature_degC for all), or use --thermometer"
    damp = 100.0 * measurements.stations.humidity[np.isfinite(measurements.stations.humidity)]
    if not space.swells and damp.size and np.ptp(damp) >= 100.0 * ASSUMED.least_damping:
        ends = f"humidity changed from {damp.min():.0f} to {damp.max():.0f} %"
        yield f"{ends}: without --moisture-ppm, swelling of struts of carbon fibre appears as other errors"
    if space.swells and not np.isfinite(measurements.stations.humidity).all():
        yield "the struts swell, but some readings have no humidity_percent: 50 % is assumed for them"


def _channels(residuals: Residuals) -> Iterator[ChannelFit]:
    m, means = residuals.estimation.measurements, residuals.estimation.means
    readings_of_mean = np.bincount(means.of_reading, minlength=len(means.kind))
    for k in np.unique(m.kind):
        members, stated = means.kind == k, m.stated_of(k)
        mean_square = float((residuals.held_out[members] ** 2 / readings_of_mean[members]).mean())
        factor = float(residuals.solution.posterior.noise[k])
        yield ChannelFit(
            kind=KINDS[k],
            readings=int((m.kind == k).sum()),
            stated=stated,
            found=factor * stated,
            chi_square=factor**2,
            held_out=stated * float(np.sqrt(mean_square)),
            unit=si_unit(KINDS[k]),
        )


def _outliers(estimation: Estimation, solution: Solution) -> Iterator[Outlier]:
    """Yield the readings whose |residual| exceeds ASSUMED.outlier σ, the largest |residual| / σ first."""
    m = estimation.measurements
    sigmas = solution.residuals / (solution.problem.uncertainty * solution.posterior.noise[m.kind])
    worst = np.argsort(-np.abs(sigmas))
    for i in worst[np.abs(sigmas[worst]) > ASSUMED.outlier]:
        channel, residual = CHANNELS[m.channel[i]], float(solution.residuals[i])
        yield Outlier(str(m.sources[i]), m.runs[m.run[i]].name, channel, residual, float(sigmas[i]), si_unit(channel))
