"""Check readings: their places, and whether a model's error there is no larger than its fit has predicted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from ..calibration.assumptions import ASSUMED
from ..calibration.posterior import FittedParameters
from ..calibration.sensitivity import predict
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..measurements.campaign import CampaignRun
from ..measurements.readings import KINDS, MeasurementSet

PLACES = 16  # of a check: each shows six numbers, and a strut's backlash in the direction in which it was reached
CLEAR = max(ASSUMED.worn_backlash)  # A strut that has come further since it turned back has a direction, m
SAMPLES, TRIES = 101, 32  # of a way at which struts are looked at; places that are tried, before the best is used
BEYOND = 0.01  # A promise is broken where readings of a model that keeps it err so much in this share of checks
LEAST_READ = 8  # Fewer places at which the tool's pose was read are no check


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


@dataclass(frozen=True)
class Whole:
    """The place of base, workpiece and instrument relative to each other, by check readings."""

    motion: np.ndarray  # (6,): of everything beside the model, m; turns by how far they move the farthest corner
    error: float  # standard error of each, m

    def moved(self, before: Whole) -> float:
        """Return by how much everything has moved as a whole since other readings, m; 0 where noise explains it."""
        way, error = float(np.linalg.norm(self.motion - before.motion)), np.hypot(self.error, before.error)
        return way if way > ASSUMED.surely * np.sqrt(len(self.motion)) * error else 0.0


@dataclass(frozen=True)
class Judgement:
    """What held-out readings say of a model, and of a promise."""

    found: float  # tool error, RMS of the displacement, their noise taken off, m; 0 where noise explains them
    excess: float  # squared differences over the largest to expect of a promise that is kept; above 1: it is broken
    whole: Whole


def judge(fitted: FittedParameters, readings: MeasurementSet, promised: float) -> Judgement:
    """Return by how much the tool's measured places differ from a model, where no more than `promised` is left, m.

    What a promise does not include is free: where the machine stands as a whole. What is left after that has variance
    promised²/3 + noise² where the promise is just kept: its sum has a χ² distribution.
    """
    chosen, space = readings.select(np.array(KINDS)[readings.kind] == "position"), fitted.space
    errors, directions = predict(space, fitted.x, chosen.stations).errors[chosen.station], chosen.directions()
    left = chosen.value - (directions * errors).sum(axis=1)
    noise = float(np.mean((chosen.stated * fitted.noise[chosen.kind]) ** 2))
    arms = chosen.points()[chosen.station] - space.places(space.work_box.mean(axis=0))
    farthest = 0.5 * float(np.linalg.norm(np.ptp(space.work_box, axis=0)))
    rigid = np.concatenate([directions[:, :3], np.cross(arms, directions[:, :3]) / farthest], axis=1)
    motion, *_ = np.linalg.lstsq(rigid, left, rcond=None)
    rest, free = left - rigid @ motion, len(left) - len(motion)
    found = np.sqrt(max(3.0 * (rest @ rest / free - noise), 0.0))
    most = float(chdtri(free, BEYOND)) * (promised**2 / 3.0 + noise)
    variance = max(noise, float(np.mean(rest**2)))
    error = np.sqrt(variance * np.linalg.inv(rigid.T @ rigid).diagonal().max())
    return Judgement(float(found), float(rest @ rest) / most, Whole(motion, float(error)))
