"""Virtual instruments: what lasers and trackers would read on a machine whose errors are known.

The other side of calibration: a campaign's template is filled in from the truth, so that the whole way from
measuring to compensating can be tried, and judged, without a laser.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from ..machine.arrays import different_rows
from ..machine.model import MachineModel, MachinesByTemperature, RealMachine
from ..machine.trial import drive, model_commands
from ..measurements.campaign import Campaign
from ..measurements.readings import (
    ABSOLUTE_KINDS,
    AXES,
    CHANNELS,
    KINDS,
    LEAST_NOISE,
    LENGTH,
    MeasurementSet,
)

VISITS, SLOPES, NOISE, CENTRES = range(4)
"""Streams of random numbers, one per cause: changing one leaves the others' draws alone."""


def measure(
    template: MeasurementSet,
    campaign: Campaign,
    truth: RealMachine,
    seed: int,
    advance: Callable[[int], object] = lambda stations: None,
) -> MeasurementSet:
    """Return a template's readings as instruments would take them on the real machine.

    value = w · (e + where the machine happened to stop) − the same at the run's first reading of that channel
    + slope of the straightness beam × way along the line + noise of the instrument. Positions and attitudes are
    absolute: nothing is subtracted; nor from lengths whose zero is known. Lengths are distances, from centres whose
    body stands beside its place in the file. Each reading states its instrument's noise as its uncertainty, at least
    :data:`~hexapod_comp.measurements.readings.LEAST_NOISE`; an instrument without noise states nothing.
    """
    errors = station_errors(template, truth, advance)[template.station]
    errors[:, :3] += _stopping(template, campaign.repeatability, np.random.default_rng([seed, VISITS]))
    value = (template.directions() * errors).sum(axis=1)
    lengths = np.flatnonzero(template.channel == LENGTH)
    centres = _centres(template, lengths, campaign.centre_off, np.random.default_rng([seed, CENTRES]))
    points = template.points()[template.station[lengths]]
    commanded = np.linalg.norm(points - template.centre[lengths], axis=1)
    value[lengths] = np.linalg.norm(points + errors[lengths, :3] - centres, axis=1) - commanded
    value -= _zeros(template, value)
    value += campaign.beam_slope * _beams(template, np.random.default_rng([seed, SLOPES]))
    sigma = np.array(campaign.noise)[template.kind]
    value += sigma * np.random.default_rng([seed, NOISE]).standard_normal(len(value))
    return replace(template, value=value, uncertainty=np.where(sigma > 0.0, np.maximum(sigma, LEAST_NOISE), np.nan))


def station_errors(
    measurements: MeasurementSet, truth: RealMachine, advance: Callable[[int], object] = lambda stations: None
) -> np.ndarray:
    """Return the real error of the measured point at each station, shape (M, 6), m and rad along ``base``.

    Displacement of the point and rotation of the platform, actual minus commanded, under the stations'
    commands, directions of motion, temperatures and humidity.
    """
    stations, name_of = measurements.stations, partial(_station_name, measurements)
    machines = MachinesByTemperature(truth.geometry, truth.model, truth).at_each(
        stations.temperatures, stations.times, stations.humidity, stations.loads
    )
    commanded = stations.positions, stations.rotations
    driven = drive(machines, commanded, stations.sense, stations.commands, name_of, advance)
    return driven.errors(commanded, measurements.probe).as_array()


def compensated(template: MeasurementSet, model: MachineModel) -> MeasurementSet:
    """Return a template whose machine is told what a model's compensation tells it."""
    stations = template.stations
    machines = MachinesByTemperature(template.geometry, model).at_each(
        stations.temperatures, stations.times, stations.humidity, stations.loads
    )
    targets, name_of = (stations.positions, stations.rotations), partial(_station_name, template)
    commands, _ = model_commands(machines, targets, stations.sense, name_of)
    return replace(template, stations=replace(stations, commands=commands))


def _station_name(measurements: MeasurementSet, station: int) -> str:
    """Return at which reading a station comes first."""
    reading = int((measurements.station == station).argmax())
    position = (measurements.stations.positions[station] * 1e3).round(3).tolist()
    run = measurements.runs[measurements.run[reading]].name
    return f"run {run}, reading {reading + 1}, platform at {position} mm in base"


def _stopping(template: MeasurementSet, repeatability: float, rng: np.random.Generator) -> np.ndarray:
    """Return where the machine stopped beside its usual place, shape (N, 3), m; one draw per visit."""
    visits = np.stack([template.station, template.cycle], axis=1)
    _, visit = different_rows(visits)
    return repeatability * rng.standard_normal((visit.max() + 1, 3))[visit]


def _groups(template: MeasurementSet) -> np.ndarray:
    """Return a number for each run and channel, shape (N,)."""
    return template.run * len(CHANNELS) + template.channel


def _centres(template: MeasurementSet, lengths: np.ndarray, off: float, rng: np.random.Generator) -> np.ndarray:
    """Return where the centres of some readings really are, shape (n, 3), m in ``base``: one draw per run.

    A body of several centres is shifted, and turned about their mean so that the furthest moves as far.
    """
    centres = template.centre[lengths].copy()
    drawn = off * rng.standard_normal((len(template.runs), 2, 3))
    for run in np.unique(template.run[lengths]):
        members = template.run[lengths] == run
        mean = centres[members].mean(axis=0)
        arms = centres[members] - mean
        shift, turn = drawn[run]
        size = np.linalg.norm(arms, axis=1).max()
        turned = Rotation.from_rotvec(turn / size).apply(arms) if size > off else arms
        centres[members] = mean + shift + turned
    return centres


def _zeros(template: MeasurementSet, value: np.ndarray) -> np.ndarray:
    """Return what each reading's instrument showed when it was zeroed, at the first reading, shape (N,)."""
    _, first, group = np.unique(_groups(template), return_index=True, return_inverse=True)
    absolute = np.isin(np.array(KINDS)[template.kind], ABSOLUTE_KINDS)
    absolute |= np.array([run.known_zero for run in template.runs])[template.run]
    return np.where(absolute, 0.0, value[first][group.ravel()])


def _beams(template: MeasurementSet, rng: np.random.Generator) -> np.ndarray:
    """Return what beams that lie off their lines, each by a draw, add to straightness, per rad, shape (N,), m.

    A square is turned by one draw about each axis of the work frame, for all runs that share its slope.
    """
    drawn = rng.standard_normal((len(template.runs), len(AXES)))
    straightness = np.flatnonzero(template.kind == KINDS.index("straightness"))
    run, axis = template.run[straightness], template.channel[straightness] - CHANNELS.index("straightness_x")
    slopes, names = drawn[run, axis], np.array([r.slope for r in template.runs])
    levers, about = template.square_levers()
    shared = np.flatnonzero(names[run] != "")
    first = np.array([int((names == name).argmax()) for name in names])
    result = np.zeros(len(template))
    result[straightness] = slopes * template.along()[straightness]
    chosen = straightness[shared]
    result[chosen] = drawn[first[run[shared]], about[chosen]] * levers[chosen]
    return result
