"""Tool errors of a virtual machine, and compensated strut commands, at the stations of a set of readings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ..machine.model import MachineModel, RealMachine
from ..machine.passes import at
from ..machine.trial import drive, model_commands
from .readings import MeasurementSet


def station_errors(
    measurements: MeasurementSet, truth: RealMachine, advance: Callable[[int], object] = lambda stations: None
) -> np.ndarray:
    """Return the true tool error, actual minus commanded, at each station, shape (M, 6), m and rad along ``base``.

    The error is the displacement of the measured point and the rotation of the platform.
    """
    stations, name_of = measurements.stations, partial(_station_name, measurements)
    machines = stations.machines(truth)
    commanded = stations.positions, stations.rotations
    driven = drive(machines, commanded, stations.sense, stations.commands, name_of, advance)
    return driven.errors(commanded, measurements.probe).as_array()


def compensated(template: MeasurementSet, model: MachineModel) -> MeasurementSet:
    """Return a copy of `template` whose strut commands are compensated with the model."""
    stations = template.stations
    machines = stations.machines(RealMachine(template.geometry, model))
    targets, name_of = (stations.positions, stations.rotations), partial(_station_name, template)
    commands, _ = model_commands(machines, targets, stations.sense, name_of)
    return replace(template, stations=replace(stations, commands=commands))


def _station_name(measurements: MeasurementSet, station: int) -> str:
    reading = int((measurements.station == station).argmax())
    pose = measurements.stations.positions[station], measurements.stations.rotations[station]
    run = measurements.runs[measurements.run[reading]].name
    return f"run {run}, reading {reading + 1}, {at(measurements.geometry, *pose)}"
