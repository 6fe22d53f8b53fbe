"""Fit a machine model to measurements with scheme ``joint``, and judge the result.

Readings → linear problem at the nominal machine (courses of temperatures, time constants, the screws' lead) → blocks
with evidence → Gauss–Newton with these → drift, discrepancy and jackknife → predicted error, doubts and mix-ups → the
model with its datum held. :class:`ModelFit` is all that is known then; reports, JSON, pictures and files show it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from ..errors import CalibrationError, HexapodError
from ..machine.arrays import rms
from ..machine.load import Payload
from ..machine.model import MachineModel, ModelOrigin
from ..machine.surroundings import load_row
from ..machine.temperatures import REFERENCE_TEMPERATURE
from ..measurements.readings import ANGULAR_KINDS, CHANNELS, KINDS, MeasurementSet, refuse_unmoved
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
from .trust import FIELDS, TILT, ChiSquare, Residuals, chi_squares, held_by_priors, unexplained, unstated, with_drift

# Readings further than this from the reference temperature, K, need an expansion: 1 µm on half a metre
WARM = 0.2
NEGLIGIBLE = 1e-5  # probability of blocks that were left out, whatever they would do to the tool
MOST_STRUTS = 4  # struts with a negative backlash mean that the directions are swapped
MOST_LEFT_OUT = 3  # runs left out of a fit that does not converge; more are a bad campaign


class ChannelFit(NamedTuple):
    """Result for one kind of channel, in its unit."""

    kind: str  # of KINDS
    readings: int
    stated: float  # standard deviation of a reading, as the file or the default says (root mean square)
    found: float  # the same as fitted
    chi_square: float  # squared residuals over the stated variance, per degree of freedom
    held_out: float  # RMS error at readings whose line or pose was left out, their noise included
    unit: str  # m or rad


class Outlier(NamedTuple):
    """A reading that disagrees with all others."""

    source: str  # where it stands
    run: str
    channel: str
    residual: float
    sigmas: float  # the same in standard deviations
    unit: str  # m or rad


@dataclass(frozen=True)
class ModelFit:
    """A model with everything that is known about it."""

    model: MachineModel  # the machine as fitted
    measurements: MeasurementSet  # its readings
    space: ParameterSpace  # names, blocks and priors of the parameters
    solution: Solution  # parameters, covariance, residuals
    decisions: tuple[Decision, ...]  # which blocks stay, and why
    channels: tuple[ChannelFit, ...]  # χ² and held-out error of each kind of channel
    observability: Observability  # what the data determine
    unseen_errors: tuple[UnseenError, ...]  # machine errors that the readings do not show (posterior.MACHINE_ERRORS)
    level: ToolError | None  # expected tool error with this model, for a level tool; None: nothing can be predicted
    tilted: ToolError | None  # the same for a tool tilted by :data:`~.trust.TILT`
    unexplained: Unexplained  # errors shown by readings that no parameter describes
    chi_squares: tuple[ChiSquare, ...]  # by kind of channel, of families of lines and of directions
    chi_squares_of_runs: tuple[ChiSquare, ...]  # the worst first
    refusals: tuple[str, ...]  # why the model must not be written without force
    doubts: tuple[str, ...]  # what else is wrong
    notes: tuple[str, ...]  # for the reader
    outliers: tuple[Outlier, ...]  # largest first
    held: HeldDatum  # where the tool is held: the model is the solution's machine, shifted and turned as a whole
    warming: ThermalEvidence  # evidence on heat
    lead: ScrewLead | None  # the screws' lead; None if it was not searched for
    held_out: np.ndarray  # (C,): leave-one-out errors of the cells, over their stated standard deviation

    @property
    def misfit(self) -> str:
        """Why the model is not to be trusted; empty if it is."""
        return "; ".join(self.refusals)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the parameters, shape (size, size), SI, widened by :attr:`Unexplained.factor`."""
        return self.unexplained.factor**2 * physical_covariance(self.space, self.solution.posterior)

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors of the parameters, shape (size,), SI."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def parameters(self) -> FittedParameters:
        """What the fit knows of its parameters: what stands in a file beside the model, and checks go by."""
        p = self.solution.posterior
        return FittedParameters(self.space, self.solution.x, self.covariance, p.tolerances, p.noise, self.held)

    def under(self, payload: Payload, gravity: Sequence[float] | None = None) -> ToolError | None:
        """Return the expected tool error with this model where it is told another load, for a level tool."""
        load = load_row(payload) if gravity is None else load_row(payload, gravity)
        covariance = physical_covariance(self.space, self.solution.posterior)
        return expected_error(box_errors(self.space, self.solution.x, load=load), covariance, beyond=self.unexplained)


def fit_model(
    measurements: MeasurementSet,
    settings: FitSettings | None = None,
    progress: Callable[[str], object] = lambda text: None,
    datum: Pose | None = None,
) -> ModelFit:
    """Fit structure, struts and field to all readings at once.

    Parameters
    ----------
    measurements : MeasurementSet
        Readings of any kind.
    settings : FitSettings, optional
        What else is known.
    progress : callable
        Told what goes on.
    datum : Pose, optional
        ``pose_platform_in_base`` at which the model moves the tool by nothing, as far as the readings do not show where
        the machine stands as a whole; home by default.

    Raises
    ------
    CalibrationError
        A datum that the machine does not reach, too few readings, or such that show nothing, a fit that does not
        settle, forward and backward swapped; with what would explain the readings better, where something does.
    """
    datum = measurements.geometry.home if datum is None else datum
    refuse_unreachable(measurements.geometry, datum)
    refuse_half_stated(measurements)
    begun = _begin(measurements, settings or FitSettings(), progress)
    try:
        try:
            return _fit(measurements, begun, progress, datum)
        except NotSettled as error:
            return _drop_outlier_runs(measurements, begun, error, progress, datum)
    except HexapodError as error:
        space = begun.everything.space
        named = mixups(begun.everything, [block.name for block in space.blocks], progress)
        nominal = solve(space, begun.problem, space.start_tolerances(), np.ones(len(KINDS)))
        if len(_negative_backlash(space, nominal)) >= MOST_STRUTS:
            named.append(SWAPPED)
        if named:
            error.with_lines("\n".join(f"  {cause}" for cause in named))
        raise


def _drop_outlier_runs(
    measurements: MeasurementSet,
    begun: _Begun,
    unsettled: NotSettled,
    progress: Callable[[str], object],
    datum: Pose,
) -> ModelFit:
    """Return the fit without the most influential runs, left out one by one, until it converges; else the last step,
    refused."""
    kept, names, error = measurements, list[str](), unsettled
    while len(names) < MOST_LEFT_OUT and len(np.unique(kept.run)) > 1:
        of_cell = kept.run[Estimation(kept, begun.everything.space, alone=False).cells.first]
        worst = int(influence(of_cell, error.solution).argmax())
        names.append(kept.runs[worst].name)
        progress(f"does not settle: trying without run {names[-1]}, which has the largest influence")
        kept = kept.select(kept.run != worst)
        try:
            fit = _fit(kept, _begin(kept, begun.everything.space.settings, progress), progress, datum)
        except NotSettled as again:
            error = again
            continue
        except HexapodError:
            break
        doubt = f"with run {', '.join(names)} the fit does not converge: left out, as it changes the parameters most"
        return replace(fit, doubts=(doubt, *fit.doubts))
    fit = _fit(measurements, begun, progress, datum, settles=False)
    problem = f"{unsettled.problem}; the runs that pull most: {', '.join(names)}"
    return replace(fit, refusals=(problem, *fit.refusals))


def mixed_up(measurements: MeasurementSet, settings: FitSettings) -> list[str]:
    """Return the mix-ups that would make the readings more probable, by name, the best first; nothing is fitted."""
    begun = _begin(measurements, settings, lambda text: None)
    decisions = select(begun.everything.space, begun.problem, np.ones(len(KINDS)), lambda text: None)[0]
    return mixups(begun.everything, [d.block for d in decisions if d.kept])


class _Begun(NamedTuple):
    """All parameters in use, the problem at the nominal machine, the screws' lead, and time constants."""

    everything: Estimation
    problem: LinearProblem
    lead: ScrewLead | None
    constants: tuple[TimeConstant, ...]


def _begin(measurements: MeasurementSet, settings: FitSettings, progress: Callable[[str], object]) -> _Begun:
    """Return the starting point of a fit; the lead is not searched for if no screw wave is fitted or screws differ."""
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
    progress("looking for the screws' lead")
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
    settles: bool = True,
) -> ModelFit:
    """Select blocks, fit them, and judge the result."""
    everything, nominal, lead, constants = begun
    settings = everything.space.settings
    decisions, possible, estimation, solution = _choose(everything, nominal, progress, settles)
    residuals, space = with_drift(estimation, solution), estimation.space
    solution, posterior = residuals.solution, residuals.solution.posterior
    channels = tuple(_channels(residuals))
    backlash = list(_check_backlash(space, solution))
    progress("judging the result")
    mixed = mixups(everything, [d.block for d in decisions if d.kept], progress)

    beyond = unexplained(residuals, settings, _averaged(residuals, everything.space, possible, decisions))
    covariance = physical_covariance(space, posterior)
    # A field that was measured with a level tool has no information on a tilted one.
    level_only = space.block(FIELDS[0]) is not None and measurements.tilt() < 0.5 * TILT
    boxes = residuals.level, None if level_only else box_errors(space, solution.x, TILT)
    level, tilted = (expected_error(errors, covariance, beyond=beyond) for errors in boxes)
    unseen = unseen_errors(measurements, settings)
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
        moved = f"a parameter still moves by {solution.change:.2g} standard deviations"
        doubts.append(f"the fit has not settled: after {solution.steps} steps {moved}")
    if level is not None and level.after > level.before:
        refusals.append("the model is not expected to help: the readings determine too little of this machine")
    if held_by_priors(residuals):
        many = f"{len(measurements)} readings do not determine the {space.size} parameters"
        refusals.append(f"{many}: what they say of the tool comes from the priors")
    loads = measured_loads(stated_load(space.settings), space.geometry, measurements.stations)
    elsewhere = about_other_loads(space, solution.x, covariance, beyond) if loads else ""
    notes = [*measurements.notes, *_about_inputs(measurements, space, lead, loads, elsewhere), *backlash]
    noisy = [f"{c.kind} {c.found / c.stated:.1f} times" for c in channels if c.found > ASSUMED.misfit[0] * c.stated]
    if noisy:
        problem = (
            "readings scatter more than stated: something of the machine, or of an instrument, is not in the model"
        )
        notes.append(f"{problem} ({', '.join(noisy)}); the expected tool error allows for it")
    notes += [*widened, unstated(measurements)]
    if level_only:
        notes.append("a field was needed, and measured with a level tool alone: nothing is promised for a tilted one")

    kept = ", ".join(block.name for block in space.blocks)
    note = f"scheme joint, {len(measurements)} readings, blocks {kept} (of {len(decisions) + 1} tried)"
    if level is not None:
        note += f", expected tool error {level.after * 1e6:.3f} µm RMS, up to {level.high * 1e6:.3f} (95 %)"
    lengths = [c.held_out for c in channels if c.kind not in ANGULAR_KINDS]
    left = rms(lengths) if lengths else None
    origin = ModelOrigin(date.today().isoformat(), measurements.files, left, note, loads=loads)
    as_solved = replace(space.model(solution.x.round(DIGITS)), origin=origin)
    part = unseen_part(estimation, posterior.tolerances[0], posterior.noise, datum)
    model, held = hold(measurements.geometry, as_solved, datum, part)
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
"""An answer from which a fit with other blocks starts: its space, parameters, tolerances and noise."""


def _choose(
    everything: Estimation, problem: LinearProblem, progress: Callable[[str], object], settles: bool
) -> tuple[list[Decision], Posterior, Estimation, Solution]:
    """Return the decisions on blocks, the posterior with all blocks, and the fit with those kept; if none `settles`,
    that of the last step."""
    space, trust = everything.space, np.ones(len(everything.measurements))

    def fitted(start: Start) -> tuple[Estimation, Solution]:
        settings = replace(space.settings, blocks=tuple(d.block for d in decisions if d.kept))
        estimation = Estimation(everything.measurements, ParameterSpace(everything.measurements, settings))
        try:
            return estimation, iterate(estimation, *_carried_over(start, estimation.space), progress)
        except NotSettled as error:
            if settles:
                raise
            return estimation, error.solution

    if {"lost motion", "friction"} & {block.name for block in space.blocks}:  # what forces do depends on them
        for _ in range(2):
            first = solve(space, problem, space.start_tolerances(), np.ones(len(KINDS)), ROUNDS)
            problem, _ = everything.linearise(space.physical(first.every(space.size)), trust)
    decisions, possible, kept = select(space, problem, np.ones(len(KINDS)), progress)
    start = space, space.physical(kept.every(space.size)), kept.tolerances, kept.noise
    if not any(d.kept for d in decisions):  # too few runs to leave one out, or none with information: from the start
        start = space, np.zeros(space.size), space.start_tolerances(), np.ones(len(KINDS))
    estimation, solution = fitted(start)
    if solution.weights.min() < ASSUMED.huber / ASSUMED.outlier:  # it was made with readings that are wrong
        start = estimation.space, solution.x, solution.posterior.tolerances, solution.posterior.noise
        x, _, noise = _carried_over(start, space)
        problem, _ = everything.linearise(x, solution.weights)
        before = [d.kept for d in decisions]
        decisions, possible, _ = select(space, problem, noise, progress)
        if [d.kept for d in decisions] != before:
            estimation, solution = fitted(start)
    return decisions, possible, estimation, solution


def _carried_over(start: Start, space: ParameterSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a start's parameters, tolerances and noise, arranged for another set of blocks.

    Blocks that the start does not have begin with zero parameters and the first guess of their tolerances.
    """
    old, given, sizes, noise = start
    x, tolerances = np.zeros(space.size), space.start_tolerances()
    for n, block in enumerate(space.blocks):
        for m, same in enumerate(old.blocks):
            if same.name == block.name:
                x[block.part], tolerances[n] = given[same.part], sizes[m]
    return x, tolerances, noise


def _averaged(r: Residuals, everything: ParameterSpace, possible: Posterior, decisions: Sequence[Decision]) -> float:
    """Return the factor on the tool's error by Bayesian model averaging, 1 or more.

    With the probability that one of the blocks left out is present, by their Bayes factors at even prior odds, the
    tool's error is that with all blocks.
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


def unseen_errors(measurements: MeasurementSet, settings: FitSettings) -> tuple[UnseenError, ...]:
    """Return the machine errors that the readings do not show, for any allowed blocks."""
    space = ParameterSpace(measurements, replace(settings, blocks=FIELDS))
    return without_trace(Estimation(measurements, space))


def _negative_backlash(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the struts whose backlash is clearly below zero: no nut leads its screw."""
    block = space.block("backlash")
    if block is None:
        return np.zeros(0, dtype=int)
    members = np.isin(posterior.used, np.arange(space.size)[block.part])
    below = posterior.y < -ASSUMED.surely * np.sqrt(np.diag(posterior.covariance))
    return posterior.used[members & below] - block.part.start


def _check_backlash(space: ParameterSpace, solution: Solution) -> list[str]:
    """Return notes on negative backlash; refuse the fit if most struts have it."""
    negative, block = _negative_backlash(space, solution.posterior), space.block("backlash")
    values = [] if block is None else [f"{value * 1e6:.2f}" for value in solution.x[block.part]]
    if len(negative) >= MOST_STRUTS:
        problem = f"{SWAPPED}: the struts would have a backlash of {', '.join(values)} µm"
        raise CalibrationError("direction", problem)
    return [f"strut_{i + 1}: backlash of {values[i]} µm found, taken as none" for i in negative]


def _about_inputs(
    measurements: MeasurementSet,
    space: ParameterSpace,
    lead: ScrewLead | None,
    loads: Sequence[Sequence[float]],
    elsewhere: str,
) -> Iterator[str]:
    """Yield notes on loads, lead, temperatures and humidity, as stated or missing: what the fit made of them.

    `loads` are those of the readings, `elsewhere` is the error predicted under others.
    """
    if loads:
        rows = np.array(loads)
        low, high = rows[:, 0].min(), rows[:, 0].max()
        masses = f"a tool of {low:g} kg" if low == high else f"tools of {low:g} to {high:g} kg"
        directions = len(np.unique(rows[:, 4:], axis=0))
        gravity = "one direction of gravity" if directions == 1 else f"{directions} directions of gravity"
        others = f"; {elsewhere}" if elsewhere else ", for no struts' stiffness is stated (--load)"
        yield f"read with {masses} and {gravity}: the promise holds for these{others}"
    if lead is not None and lead.given is not None and lead.shown is not None and not lead.agrees:
        problem = f"the screws' errors repeat every {lead.shown * 1e3:.4g} mm by the readings"
        yield f"{problem}, not with the given lead of {lead.given * 1e3:.6g} mm: is it right?"
    if lead is not None and lead.used is None:
        problem = "the screws' lead is not known, and the readings do not show it"
        yield f"{problem}: a periodic error of the screws, if they have one, is not fitted"
    warmth = np.abs(measurements.stations.temperatures - REFERENCE_TEMPERATURE).max()
    if warmth > WARM and space.block("expansion") is None and not space.stated_expansion.any():
        yield f"read up to {warmth:.1f} K from 20 °C, but no expansion is given: growth is taken for an error"
    if space.swells and not np.isfinite(measurements.stations.humidity).all():
        yield "the struts swell, but not every reading has its humidity (humidity_percent): 50 % is taken there"


def _channels(residuals: Residuals) -> Iterator[ChannelFit]:
    """Yield the residuals of each kind of channel."""
    m, cells = residuals.estimation.measurements, residuals.estimation.cells
    readings_of_cell = np.bincount(cells.of_reading, minlength=len(cells.kind))
    for k in np.unique(m.kind):
        members, stated = cells.kind == k, m.stated_of(k)
        mean_square = float((residuals.held_out[members] ** 2 / readings_of_cell[members]).mean())
        factor = float(residuals.solution.posterior.noise[k])
        yield ChannelFit(
            kind=KINDS[k],
            readings=int((m.kind == k).sum()),
            stated=stated,
            found=factor * stated,
            chi_square=factor**2,
            held_out=stated * float(np.sqrt(mean_square)),
            unit="rad" if KINDS[k] in ANGULAR_KINDS else "m",
        )


def _outliers(estimation: Estimation, solution: Solution) -> Iterator[Outlier]:
    """Yield the readings that are too far off to be noise, the worst first."""
    m = estimation.measurements
    sigmas = solution.residuals / (estimation.uncertainty * solution.posterior.noise[m.kind])
    worst = np.argsort(-np.abs(sigmas))
    for i in worst[np.abs(sigmas[worst]) > ASSUMED.outlier]:
        unit = "rad" if KINDS[m.kind[i]] in ANGULAR_KINDS else "m"
        channel, residual = CHANNELS[m.channel[i]], float(solution.residuals[i])
        yield Outlier(str(m.sources[i]), m.runs[m.run[i]].name, channel, residual, float(sigmas[i]), unit)
