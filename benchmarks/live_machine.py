"""A virtual machine for tests of ``collect``: hidden errors, ideal drives, and a live instrument."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.measurements.collect import Observation, RunSetUp
from hexapod_comp.virtual.instruments import TRACKER, LiveInstrument
from hexapod_comp.virtual.machine import DriveParameters
from hexapod_comp.virtual.watched import VirtualMachine

SAMPLES = 9  # readings whose median is an observation


class LiveMachine(VirtualMachine):
    """A virtual machine without compensation, whose tool is read by an instrument."""

    instrument: LiveInstrument

    def __init__(self, geometry: HexapodGeometry, truth: MachineModel, instrument: LiveInstrument) -> None:
        super().__init__(geometry, truth, parameters=DriveParameters.ideal())
        self.instrument, self.observed = instrument, 0
        self.broken: set[int] = set()  # observations before which the beam was broken
        self.silent: set[int] = set()  # observations at which the instrument reads nothing

    def set_up(self, run: RunSetUp) -> Collection[str]:
        if self.instrument.kind == TRACKER:
            return ()
        self.instrument.set_up(run.place)
        return self.instrument.channels

    def observe(self) -> Observation | None:
        self.observed += 1
        if self.observed - 1 in self.silent:
            return None
        lost = self.observed - 1 in self.broken
        if lost:
            self.instrument.zero()
        tool, sigma = self.tool, self.instrument.flaws.length_noise or 1e-9
        struts, time = tuple(self._drive.motor_lengths().tolist()), float(self.observed)
        if self.instrument.kind == TRACKER:
            return Observation(self.instrument.pose(tool), np.full(6, sigma), struts, None, time)
        many = [self.instrument.read(tool) for _ in range(SAMPLES)]
        channels = {c: (float(np.median([one[c] for one in many])), sigma / math.sqrt(SAMPLES)) for c in many[0]}
        return Observation(None, np.full(6, math.nan), struts, None, time, channels, lost)
