"""The stations of a set of readings: a machine's real errors at them, and strut commands compensated with a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ..machine.model import MachineModel, RealMachine
from ..machine.trial import drive, model_commands
from .readings import MeasurementSet


def station_errors(
    measurements: MeasurementSet, truth: RealMachine, advance: Callable[[int], object] = lambda stations: None
) -> np.ndarray:
    """Return the real error of the measured point at each station, shape (M, 6), m and rad along ``base``.

    The error is the displacement of the point and the rotation of the platform, actual minus commanded. The error
    depends on the station's strut commands, directions of motion, temperatures and humidity.
    """
    stations, name_of = measurements.stations, partial(_station_name, measurements)
    machines = stations.machines(truth)
    commanded = stations.positions, stations.rotations
    driven = drive(machines, commanded, stations.sense, stations.commands, name_of, advance)
    return driven.errors(commanded, measurements.probe).as_array()


def compensated(template: MeasurementSet, model: MachineModel) -> MeasurementSet:
    """Return a copy of a template whose strut commands are compensated with the model."""
    stations = template.stations
    machines = stations.machines(RealMachine(template.geometry, model))
    targets, name_of = (stations.positions, stations.rotations), partial(_station_name, template)
    commands, _ = model_commands(machines, targets, stations.sense, name_of)
    return replace(template, stations=replace(stations, commands=commands))


def _station_name(measurements: MeasurementSet, station: int) -> str:
    """Return a station's name for messages: its run, the number of its first reading, and the platform's position."""
    reading = int((measurements.station == station).argmax())
    position = (measurements.stations.positions[station] * 1e3).round(3).tolist()
    run = measurements.runs[measurements.run[reading]].name
    return f"run {run}, reading {reading + 1}, platform at {position} mm in base"
