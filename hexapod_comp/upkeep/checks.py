"""Check readings: their places, and whether a model's error there is no larger than its fit has predicted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from ..calibration.assumptions import ASSUMED
from ..calibration.parameters import ParameterSpace
from ..calibration.posterior import FittedParameters
from ..calibration.sensitivity import predict
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..measurements.campaign import Campaign, CampaignRun
from ..measurements.readings import CHANNELS, KINDS, MeasurementSet

PLACES = 16  # of a check: each shows six numbers, and a strut's backlash in the direction in which it was reached
CLEAR = max(ASSUMED.worn_backlash)  # A strut that has come further since it turned back has a direction, m
SAMPLES, TRIES = 101, 32  # of a way at which struts are looked at; places that are tried, before the best is used
BEYOND = 0.01  # A promise is broken where readings of a model that keeps it err so much in this share of checks
DISPLACEMENTS = ("linear", "straightness", "position")


def check_run(geometry: HexapodGeometry, box: np.ndarray, level: np.ndarray, seed: int, name: str) -> CampaignRun:
    """Return check readings of a box: the tool's pose at random places, each reached from the one before.

    So every strut is read in both directions of its motion, on ways off a campaign's lines. Before each place every
    strut moves further than its backlash without reversing; otherwise it would have no direction of motion there.
    """
    rng, places = np.random.default_rng([seed, 30]), list[np.ndarray]()
    while len(places) < PLACES:
        drawn = rng.uniform(box[0], box[1], (TRIES, 3)).round(6)
        clear = [_since_turning(geometry, places[-1], place, level) for place in drawn] if places else [np.inf]
        places.append(drawn[next((n for n, way in enumerate(clear) if way >= CLEAR), int(np.argmax(clear)))])
    return CampaignRun(name, "tracker_6d", np.array(places), np.tile(level, (PLACES, 1, 1)))


def _since_turning(geometry: HexapodGeometry, start: np.ndarray, end: np.ndarray, level: np.ndarray) -> float:
    """Return the least distance that a strut has moved on a straight way since its last reversal, m."""
    way = np.linspace(start, end, SAMPLES)
    lengths = strut_lengths_batch(
        Structure.of(geometry), *geometry.platform_poses(way, np.tile(level, (SAMPLES, 1, 1))), threads=1
    )
    outwards = lengths[-1] > lengths[-2]
    return float(np.where(outwards, lengths[-1] - lengths.min(axis=0), lengths.max(axis=0) - lengths[-1]).min())


def check_campaign(
    geometry: HexapodGeometry, box: np.ndarray, level: np.ndarray, seed: int, name: str = "check"
) -> Campaign:
    """Return the campaign that has check readings alone."""
    side = float(np.ptp(box, axis=0).min())
    runs = (check_run(geometry, box, level, seed, name),)
    return Campaign(box, side, side, instrument=None, diagonals=0, level=level, runs=runs)


@dataclass(frozen=True)
class Judgement:
    """The verdict of readings that were not used in a fit on the error that it has predicted."""

    promised: float  # upper end of the tool error that was promised, RMS of the displacement, m
    found: float  # the same as the readings have it, their noise taken off, m; 0 where noise explains them
    excess: float  # squared differences over the largest to expect of a promise that is kept; above 1: it is broken

    @property
    def kept(self) -> bool:
        """Whether the readings confirm the promise."""
        return self.excess <= 1.0


def judge_promise(fitted: FittedParameters, readings: MeasurementSet, promised: float) -> Judgement:
    """Return whether readings not used in a fit deviate from its model by no more than its promised error, m.

    What a promise does not include is left free: where the machine stands as a whole, the zero of a displacement read
    along a line, the slope of a straightness. What is left after these has variance promised²/3 + noise² where the
    promise is just kept: its sum has a χ² distribution.
    """
    chosen, directions, left, noise = _differences(fitted, readings, DISPLACEMENTS)
    absolute, along, squares, freedom, expected = _of_kind(chosen, "position"), chosen.along(), 0.0, 0, 0.0
    group = np.where(absolute, -1, len(CHANNELS) * chosen.run + chosen.channel)
    for number in np.unique(group):
        members = group == number
        if number < 0:
            unknown = _rigid(fitted.space, chosen, directions)[members]
        else:
            slope = KINDS[int(chosen.kind[members][0])] == "straightness"
            unknown = np.vander(along[members], 1 + slope, increasing=True)
        rest = left[members] - unknown @ np.linalg.lstsq(unknown, left[members], rcond=None)[0]
        free = max(int(members.sum()) - unknown.shape[1], 0)
        squares += float(rest @ rest)
        expected += free * float(np.mean(noise[members] ** 2))
        freedom += free
    allowed = (freedom * promised**2 / 3.0 + expected) / max(freedom, 1)
    most = float(chdtri(max(freedom, 1), BEYOND)) * allowed
    found = np.sqrt(max(3.0 * (squares - expected) / max(freedom, 1), 0.0))
    return Judgement(promised, float(found), squares / most)


@dataclass(frozen=True)
class Whole:
    """The place of base, workpiece and instrument relative to each other, by check readings."""

    motion: np.ndarray  # (6,): of everything beside the model, m; turns by how far they move the farthest corner
    error: float  # standard error of each, m

    def moved(self, before: Whole) -> float:
        """Return by how much everything has moved as a whole since other readings, m; 0 where noise explains it."""
        way, error = float(np.linalg.norm(self.motion - before.motion)), np.hypot(self.error, before.error)
        return way if way > ASSUMED.surely * np.sqrt(len(self.motion)) * error else 0.0


def stands(fitted: FittedParameters, readings: MeasurementSet) -> Whole | None:
    """Return the shift and turn of everything, which no model of the machine contains; None if no position was read."""
    chosen, directions, left, noise = _differences(fitted, readings, ("position",))
    if not len(left):
        return None
    unknown = _rigid(fitted.space, chosen, directions)
    unknown[:, 3:] /= 0.5 * float(np.linalg.norm(np.ptp(fitted.space.work_box, axis=0)))
    motion, *_ = np.linalg.lstsq(unknown, left, rcond=None)
    variance = max(float(np.mean(noise**2)), float(np.mean((left - unknown @ motion) ** 2)))
    return Whole(motion, float(np.sqrt(variance * np.linalg.inv(unknown.T @ unknown).diagonal().max())))


def _of_kind(readings: MeasurementSet, *kinds: str) -> np.ndarray:
    return np.isin(np.array(KINDS)[readings.kind], kinds)


def _differences(
    fitted: FittedParameters, readings: MeasurementSet, kinds: tuple[str, ...]
) -> tuple[MeasurementSet, np.ndarray, np.ndarray, np.ndarray]:
    """Return the readings of some kinds, their directions, their differences from the fit, and their noise."""
    chosen = readings.select(_of_kind(readings, *kinds))
    errors, directions = predict(fitted.space, fitted.x, chosen.stations).errors[chosen.station], chosen.directions()
    return (
        chosen,
        directions,
        chosen.value - (directions * errors).sum(axis=1),
        chosen.stated * fitted.noise[chosen.kind],
    )


def _rigid(space: ParameterSpace, readings: MeasurementSet, directions: np.ndarray) -> np.ndarray:
    """Return the derivatives of some readings by a shift, m, and a turn about the box's centre, rad, (n, 6)."""
    arms = readings.points()[readings.station] - space.places(space.work_box.mean(axis=0))
    return np.concatenate([directions[:, :3], np.cross(arms, directions[:, :3])], axis=1)
