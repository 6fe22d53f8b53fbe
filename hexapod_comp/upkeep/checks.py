"""Check readings: where they are taken, and whether a model keeps on them what its fit has promised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ..calibration.posterior import FittedParameters
from ..calibration.sensitivity import predict
from ..measurements.campaign import Campaign, CampaignRun, line_run
from ..measurements.readings import AXES, KINDS, MeasurementSet

POINTS = 3  # of a check line: two for what changes along it, a third for what bends
INWARDS = 0.1  # Check lines lie inwards by a share of the box's sides up to this: no middle is where a strut turns back
BEYOND = 0.01  # A promise is broken where readings of a model that keeps it err so much in this share of checks
DISPLACEMENTS = ("linear", "straightness", "position")


def check_campaign(box: np.ndarray, level: np.ndarray, seed: int, lines: int = 1, name: str = "check") -> Campaign:
    """Return the check readings of a box: lines along x, y and z through random places of it, and its body diagonals.

    Each line along an axis is read in six channels, a diagonal in its length; both ways, so that backlash is known.
    """
    rng, low, size = np.random.default_rng([seed, 30]), box[0], np.ptp(box, axis=0)
    runs: list[CampaignRun] = []
    for axis, number in np.ndindex(3, lines):
        place = low + size * rng.uniform(0.0, 1.0, 3)
        ends = np.tile(place, (2, 1))
        ends[:, axis] = low[axis] + size[axis] * np.array([0.0, 1.0] + rng.uniform(0.0, INWARDS, 2) * (1.0, -1.0))
        runs.append(line_run(f"{name}: {AXES[axis]} line {number + 1}", "6-D", ends.round(6), POINTS, level))
    for number, (x, y) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1)), start=1):
        corner = np.array([x, y, 0])
        ends = low + size * np.array([corner, 1 - corner])
        runs.append(line_run(f"{name}: diagonal {number}", "linear", ends.round(6), 2, level))
    side = float(size.min())
    return Campaign(box, side, side, instrument=None, diagonals=0, level=level, runs=tuple(runs))


@dataclass(frozen=True)
class Judgement:
    """What held-out readings say of a promise."""

    promised: float  # upper end of the tool error that was promised, RMS of the displacement, m
    found: float  # the same as the readings have it, their noise taken off, m; 0 where noise explains them
    excess: float  # squared differences over the largest to expect of a promise that is kept; above 1: it is broken

    @property
    def kept(self) -> bool:
        """Whether the readings bear the promise out."""
        return self.excess <= 1.0


def judge_promise(fitted: FittedParameters, readings: MeasurementSet, promised: float) -> Judgement:
    """Return whether readings that a fit has not seen err by no more than it has promised, m, beside its model.

    A displacement read along a line leaves its zero open, straightness its slope too. What is left after these has
    variance promised²/3 + noise² where the promise is just kept: its sum has a χ² distribution.
    """
    kinds = np.array(KINDS)[readings.kind]
    chosen = readings.select(np.isin(kinds, DISPLACEMENTS))
    errors = predict(fitted.space, fitted.x, chosen.stations).errors[chosen.station]
    left = chosen.value - (chosen.directions() * errors).sum(axis=1)
    noise, along, squares, freedom, expected = chosen.stated * fitted.noise[chosen.kind], chosen.along(), 0.0, 0, 0.0
    for run, channel in np.unique(np.column_stack([chosen.run, chosen.channel]), axis=0):
        members = (chosen.run == run) & (chosen.channel == channel)
        kind = KINDS[int(chosen.kind[members][0])]
        unknown = np.zeros((int(members.sum()), 0))
        if kind != "position":
            unknown = np.vander(along[members], 1 + (kind == "straightness"), increasing=True)
        rest = left[members] - unknown @ np.linalg.lstsq(unknown, left[members], rcond=None)[0]
        free = max(int(members.sum()) - unknown.shape[1], 0)
        squares += float(rest @ rest)
        expected += free * float(np.mean(noise[members] ** 2))
        freedom += free
    allowed = (freedom * promised**2 / 3.0 + expected) / max(freedom, 1)
    most = float(chi2.ppf(1.0 - BEYOND, max(freedom, 1))) * allowed
    found = np.sqrt(max(3.0 * (squares - expected) / max(freedom, 1), 0.0))
    return Judgement(promised, float(found), squares / most)
