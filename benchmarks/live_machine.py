"""A machine with hidden errors that collect moves and watches, without ROS: what it is told is what it does at once."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.measurements.collect import Observation, RunSetUp
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.instruments import TRACKER, LiveInstrument

SAMPLES = 9  # Readings of which an observation is the median


class LiveMachine:
    """Struts told nominal lengths, each with its direction of motion; an instrument reads where the tool really is."""

    def __init__(self, geometry: HexapodGeometry, truth: MachineModel, instrument: LiveInstrument) -> None:
        self.geometry, self.instrument, self._machine = geometry, instrument, RealMachine(geometry, truth)
        self._platform, self._sense = geometry.home, np.zeros(9)
        self.moves, self.observed = 0, 0
        self.broken: set[int] = set()  # observations before which the beam was broken, by number
        self.silent: set[int] = set()  # observations that read nothing

    def set_up(self, run: RunSetUp) -> Collection[str]:
        if self.instrument.kind == TRACKER:
            return ()
        self.instrument.set_up(run.place)
        return self.instrument.channels

    def move(self, pose: Pose) -> None:
        target = self.geometry.work @ pose @ self.geometry.tool.inverse()
        lengths = [strut_lengths(self.geometry, p) for p in (self._platform, target)]
        way = np.concatenate([target.position - self._platform.position, lengths[1] - lengths[0]])
        self._sense = np.where(np.abs(way) > 1e-9, np.sign(way), self._sense)
        self._platform, self._lengths = target, lengths[1]
        self.moves += 1

    @property
    def tool(self) -> Pose:
        """Where the tool really is, in base."""
        return self._machine.pose_for(self._lengths, self._sense, self._platform)[0] @ self.geometry.tool

    def observe(self) -> Observation | None:
        self.observed += 1
        if self.observed - 1 in self.silent:
            return None
        lost = self.observed - 1 in self.broken
        if lost:
            self.instrument.zero()
        tool, sigma = self.tool, self.instrument.flaws.length_noise or 1e-9
        struts, time = tuple(self._lengths.tolist()), float(self.observed)
        if self.instrument.kind == TRACKER:
            return Observation(self.instrument.pose(tool), np.full(6, sigma), struts, None, time)
        many = [self.instrument.read(tool) for _ in range(SAMPLES)]
        channels = {c: (float(np.median([one[c] for one in many])), sigma / math.sqrt(SAMPLES)) for c in many[0]}
        return Observation(None, np.full(6, math.nan), struts, None, time, channels, lost)
