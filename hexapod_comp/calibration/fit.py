"""Fit a machine model to measurements with scheme ``joint``, and judge the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from ..measurements.readings import ANGULAR_KINDS, KINDS, FileLine, MeasurementSet, refuse_unmoved
from ..pose import Pose
from .assumptions import ASSUMED
from .blocks import WAVES
from .blocks.block import DIGITS
from .blocks.load import measured_loads, refuse_half_stated, stated_load
from .datum import HeldDatum, hold, refuse_unreachable, unseen_part
from .estimator import (
    ROUNDS,
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
from .selection import Decision, select
from .thermal import ThermalEvidence, TimeConstants, estimate_time_constants, with_courses
from .trust import LeftOut, Residuals, Verdict, judge, with_drift

# Readings further than this from the reference temperature, K, need an expansion: 1 µm on half a metre
WARM = 0.2
NEGLIGIBLE = 1e-5  # probability of blocks that were left out, whatever they would do to the tool
MOST_STRUTS = 4  # struts with a negative backlash mean that the directions are swapped
MOST_LEFT_OUT = 3  # runs left out of a fit that does not converge; more are a bad campaign


@dataclass(frozen=True)
class ChannelFit:
    """Result for one kind of channel."""

    kind: str  # of KINDS
    readings: int
    stated: float  # standard deviation of a reading, as the file or the default says (root mean square)
    estimated: float  # the same as fitted
    chi_square: float  # squared residuals over the stated variance, per degree of freedom
    held_out: float  # RMS error at readings whose line or pose was left out, their noise included, m or rad


@dataclass(frozen=True)
class Outlier:
    """A reading that disagrees with all others."""

    source: FileLine  # Where it stands
    channel: int  # Index of its channel
    residual: float  # m or rad
    sigmas: float  # The same in standard deviations
    run: str  # Its run


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
    verdict: Verdict  # predicted tool error, and doubts
    outliers: tuple[Outlier, ...]  # largest first
    notes: tuple[str, ...]  # for the reader
    held: HeldDatum  # where the tool is held: the model is the solution's machine, shifted and turned as a whole
    warming: ThermalEvidence  # evidence on heat
    lead: ScrewLead | None  # the screws' lead; None if it was not searched for
    held_out: np.ndarray  # (C,): leave-one-out errors of the cells, over their stated standard deviation

    @property
    def misfit(self) -> str:
        """Why the model is not to be trusted; empty if it is."""
        return "; ".join(self.verdict.refusals)

    @property
    def level(self) -> ToolError | None:
        """The expected tool error with this model, for a level tool."""
        return self.verdict.level

    @property
    def tilted(self) -> ToolError | None:
        """The same for a tool tilted by :data:`~.trust.TILT`; None if nothing can be predicted."""
        return self.verdict.tilted

    def under(self, payload: Payload, gravity: Sequence[float] | None = None) -> ToolError | None:
        """Return the expected tool error with this model where it is told another load, for a level tool."""
        load = load_row(payload) if gravity is None else load_row(payload, gravity)
        covariance = physical_covariance(self.space, self.solution.posterior)
        errors = box_errors(self.space, self.solution.x, load=load)
        return expected_error(errors, covariance, beyond=self.verdict.unexplained)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the parameters, shape (size, size), SI, widened by :attr:`Unexplained.factor`."""
        return self.verdict.unexplained.factor**2 * physical_covariance(self.space, self.solution.posterior)

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors of the parameters, shape (size,), SI."""
        return np.sqrt(np.diag(self.covariance))


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
    settings = settings or FitSettings()
    begun = _begin(measurements, settings, progress)
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
        return replace(fit, verdict=replace(fit.verdict, doubts=(doubt, *fit.verdict.doubts)))
    problem = f"{unsettled.problem}; the runs that pull most: {', '.join(names)}"
    fit = _fit(measurements, begun, progress, datum, settles=False)
    return replace(fit, verdict=replace(fit.verdict, refusals=(problem, *fit.verdict.refusals)))


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
    constants: TimeConstants


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
    space = estimation.space
    residuals = with_drift(estimation, solution)
    solution = residuals.solution
    channels = tuple(_channels(residuals))
    notes = [
        *_about_lead(lead),
        *_ignored(measurements, space),
        *_check_backlash(space, solution),
    ]
    notes += _check_noise(channels)
    progress("judging the result")
    noise = {KINDS.index(c.kind): c.estimated for c in channels}
    mixed = mixups(everything, [d.block for d in decisions if d.kept], progress)
    left_out = _averaged(space, solution, everything.space, possible, decisions)
    verdict = judge(residuals, settings, noise, mixed, left_out)
    no_trace = unseen_errors(measurements, settings)
    if rolls := [error for error in no_trace if error.name.startswith("roll")]:
        verdict = verdict.without_rotation(listed(rolls))
    notes = [*_about_loads(measurements, space, solution, verdict), *notes]
    as_solved = _named(space, solution, measurements, channels, len(decisions), verdict.level)
    unseen = unseen_part(estimation, solution.posterior.tolerances[0], solution.posterior.noise, datum)
    model, held = hold(measurements.geometry, as_solved, datum, unseen)
    return ModelFit(
        model=model,
        measurements=measurements,
        space=space,
        solution=solution,
        decisions=tuple(decisions),
        channels=channels,
        observability=observe(space, solution.problem, solution.posterior, measurements.tilt()),
        unseen_errors=no_trace,
        verdict=verdict,
        outliers=tuple(_outliers(estimation, solution)),
        notes=(*measurements.notes, *notes, *verdict.remarks),
        held=held,
        warming=ThermalEvidence.of(measurements, estimation, solution, constants, verdict.unexplained.factor),
        lead=lead,
        held_out=residuals.held_out,
    )


def _begin(measurements: MeasurementSet, settings: FitSettings, progress: Callable[[str], object]) -> _Begun:
    """Return the starting point of a fit; the lead is not searched for if no screw wave is fitted or screws differ."""
    measurements = with_courses(measurements)
    constants = estimate_time_constants(measurements, ParameterSpace(measurements, settings), progress)
    if constants.values:
        settings = replace(settings, time_constants=constants.values)
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


Start = tuple[ParameterSpace, np.ndarray, np.ndarray, np.ndarray]
"""An answer from which a fit with other blocks starts: its space, parameters, tolerances and noise."""


def _choose(
    everything: Estimation, problem: LinearProblem, progress: Callable[[str], object], settles: bool
) -> tuple[list[Decision], Posterior, Estimation, Solution]:
    """Return the decisions on blocks, the posterior with all blocks, and the fit with those kept."""
    space, trust = everything.space, np.ones(len(everything.measurements))
    if {"lost motion", "friction"} & {block.name for block in space.blocks}:  # what forces do depends on them
        for _ in range(2):
            first = solve(space, problem, space.start_tolerances(), np.ones(len(KINDS)), ROUNDS)
            y = np.zeros(space.size)
            y[first.used] = first.y
            problem, _ = everything.linearise(space.physical(y), trust)
    decisions, possible, kept = select(space, problem, np.ones(len(KINDS)), progress)
    y = np.zeros(space.size)
    y[kept.used] = kept.y
    start = space, space.physical(y), kept.tolerances, kept.noise
    if not any(d.kept for d in decisions):  # too few runs to leave one out, or none with information: from the start
        start = space, 0.0 * y, space.start_tolerances(), np.ones(len(KINDS))
    estimation, solution = _solve(everything, decisions, start, progress, settles)
    if solution.weights.min() < ASSUMED.huber / ASSUMED.outlier:  # it was made with readings that are wrong
        start = estimation.space, solution.x, solution.posterior.tolerances, solution.posterior.noise
        x, _, noise = _carried_over(start, space)
        problem, _ = everything.linearise(x, solution.weights)
        again, possible, _ = select(space, problem, noise, progress)
        if [d.kept for d in again] != [d.kept for d in decisions]:
            estimation, solution = _solve(everything, again, start, progress, settles)
        decisions = again
    return decisions, possible, estimation, solution


def _solve(
    everything: Estimation,
    decisions: list[Decision],
    start: Start,
    progress: Callable[[str], object],
    settles: bool,
) -> tuple[Estimation, Solution]:
    """Return a converged fit with the selected blocks; if none `settles`, the result of the last step."""
    settings = replace(everything.space.settings, blocks=tuple(d.block for d in decisions if d.kept))
    estimation = Estimation(everything.measurements, ParameterSpace(everything.measurements, settings))
    try:
        return estimation, iterate(estimation, *_carried_over(start, estimation.space), progress)
    except NotSettled as error:
        if settles:
            raise
        return estimation, error.solution


def _carried_over(start: Start, space: ParameterSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return parameters, tolerances and noise of a start in another space; missing parameters are zero, missing
    tolerances the first guess."""
    old, given, sizes, noise = start
    x, tolerances = np.zeros(space.size), space.start_tolerances()
    for n, block in enumerate(space.blocks):
        for m, same in enumerate(old.blocks):
            if same.name == block.name:
                x[block.part], tolerances[n] = given[same.part], sizes[m]
    return x, tolerances, noise


def _averaged(
    space: ParameterSpace,
    solution: Solution,
    everything: ParameterSpace,
    possible: Posterior,
    decisions: Sequence[Decision],
) -> LeftOut:
    """Return the probability that a block was left out although present, and the tool's error with all blocks.

    It is computed from the blocks' Bayes factors with even prior odds, at the same solution.
    """
    present = 1.0 - float(np.prod([expit(-d.evidence) for d in decisions if not d.kept]))
    if present < NEGLIGIBLE:
        return LeftOut()
    x, _, _ = _carried_over((space, solution.x, solution.posterior.tolerances, solution.posterior.noise), everything)
    errors, y = box_errors(everything, x), np.zeros(everything.size)
    if errors is None:
        return LeftOut()
    y[possible.used] = possible.y
    metric, shift = errors.mean_squares[0], everything.physical(y) - x
    square = np.vdot(metric, physical_covariance(everything, possible)) + shift @ metric @ shift
    return LeftOut(present, float(square))


def unseen_errors(measurements: MeasurementSet, settings: FitSettings) -> tuple[UnseenError, ...]:
    """Return the machine errors that the readings do not show, for any allowed blocks."""
    space = ParameterSpace(measurements, replace(settings, blocks=("field displacement", "field rotation")))
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


def _about_lead(lead: ScrewLead | None) -> list[str]:
    """Return notes on a lead that is not known, or differs from the given one."""
    if lead is None:
        return []
    if not lead.agrees:
        problem = f"the screws' errors repeat every {lead.shown * 1e3:.4g} mm by the readings"  # type: ignore[operator]
        return [f"{problem}, not with the given lead of {lead.given * 1e3:.6g} mm: is it right?"]  # type: ignore[operator]
    if lead.used is None:
        problem = "the screws' lead is not known, and the readings do not show it"
        return [f"{problem}: a periodic error of the screws, if they have one, is not fitted"]
    return []


def _about_loads(
    measurements: MeasurementSet, space: ParameterSpace, solution: Solution, verdict: Verdict
) -> list[str]:
    """Return the loads for which the predicted error holds, if any is stated, and what it is under others."""
    load = stated_load(space.settings)
    loads = np.array(measured_loads(load, space.geometry, measurements.stations))
    if not len(loads):
        return []
    low, high = loads[:, 0].min(), loads[:, 0].max()
    masses = f"a tool of {low:g} kg" if low == high else f"tools of {low:g} to {high:g} kg"
    directions = len(np.unique(loads[:, 4:], axis=0))
    gravity = "one direction of gravity" if directions == 1 else f"{directions} directions of gravity"
    text = f"read with {masses} and {gravity}: the promise holds for these"
    covariance = physical_covariance(space, solution.posterior)
    elsewhere = about_other_loads(space, solution.x, covariance, verdict.unexplained)
    return [f"{text}; {elsewhere}" if elsewhere else f"{text}, for no struts' stiffness is stated (--load)"]


def _ignored(measurements: MeasurementSet, space: ParameterSpace) -> list[str]:
    """Return notes on missing inputs, whose effects the fit attributes to other errors."""
    notes = []
    warmth = np.abs(measurements.stations.temperatures - REFERENCE_TEMPERATURE).max()
    if warmth > WARM and space.block("expansion") is None and not space.stated_expansion.any():
        notes.append(f"read up to {warmth:.1f} K from 20 °C, but no expansion is given: growth is taken for an error")
    if space.swells and not np.isfinite(measurements.stations.humidity).all():
        notes.append("the struts swell, but not every reading has its humidity (humidity_percent): 50 % is taken there")
    return notes


def _check_noise(channels: tuple[ChannelFit, ...]) -> list[str]:
    """Return a note on readings that scatter more than stated."""
    noisy = [
        f"{c.kind} {c.estimated / c.stated:.1f} times" for c in channels if c.estimated > ASSUMED.misfit[0] * c.stated
    ]
    if not noisy:
        return []
    problem = "readings scatter more than stated: something of the machine, or of an instrument, is not in the model"
    return [f"{problem} ({', '.join(noisy)}); the expected tool error allows for it"]


def _channels(residuals: Residuals) -> list[ChannelFit]:
    """Return the residuals of each kind of channel."""
    estimation, problem, posterior = residuals.estimation, residuals.solution.problem, residuals.solution.posterior
    kinds, errors = estimation.measurements.kind, residuals.held_out
    readings_of_cell = np.bincount(estimation.cells.of_reading, minlength=len(problem.kind))
    result = []
    for k in np.unique(kinds):
        members = problem.kind == k
        stated = estimation.measurements.stated_of(k)
        mean_square = float((errors[members] ** 2 / readings_of_cell[members]).mean())
        factor = float(posterior.noise[k])
        result.append(
            ChannelFit(
                kind=KINDS[k],
                readings=int((kinds == k).sum()),
                stated=stated,
                estimated=factor * stated,
                chi_square=factor**2,
                held_out=stated * float(np.sqrt(mean_square)),
            )
        )
    return result


def _outliers(estimation: Estimation, solution: Solution) -> list[Outlier]:
    """Return the readings that are too far off to be noise, the worst first."""
    m = estimation.measurements
    sigmas = solution.residuals / (estimation.uncertainty * solution.posterior.noise[m.kind])
    worst = np.argsort(-np.abs(sigmas))
    far = worst[np.abs(sigmas[worst]) > ASSUMED.outlier]
    return [
        Outlier(m.sources[i], int(m.channel[i]), float(solution.residuals[i]), float(sigmas[i]), m.runs[m.run[i]].name)
        for i in far
    ]


def _named(
    space: ParameterSpace,
    solution: Solution,
    measurements: MeasurementSet,
    channels: tuple[ChannelFit, ...],
    tried: int,
    level: ToolError | None,
) -> MachineModel:
    """Return the fitted model with its origin, and its predicted error."""
    kept = ", ".join(block.name for block in space.blocks)
    lengths = [c.held_out for c in channels if c.kind not in ANGULAR_KINDS]
    note = f"scheme joint, {len(measurements)} readings, blocks {kept} (of {tried + 1} tried)"
    if level is not None:
        note += f", expected tool error {level.after * 1e6:.3f} µm RMS, up to {level.high * 1e6:.3f} (95 %)"
    residual = rms(lengths) if lengths else None
    loads = measured_loads(stated_load(space.settings), space.geometry, measurements.stations)
    origin = ModelOrigin(date.today().isoformat(), measurements.files, residual, note, loads=loads)
    return replace(space.model(solution.x.round(DIGITS)), origin=origin)
