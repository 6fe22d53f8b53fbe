"""Check readings of ``adapt`` at random places, and a test whether the tool's RMS error exceeds the fit's limit."""

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

PLACES = 16  # number of places of a check
CLEAR = max(ASSUMED.worn_backlash)  # a strut that travels this far after a reversal has taken up its backlash, m
SAMPLES, TRIES = 101, 32  # number of points on a path; number of random candidates for each place
BEYOND = 0.01  # significance level: share of checks that fail although the tool error only equals the fit's limit
LEAST_READ = 8  # smallest number of places at which a check must have read the tool's pose


def check_run(geometry: HexapodGeometry, box: np.ndarray, level: np.ndarray, seed: int, name: str) -> CampaignRun:
    """Return a run of check readings at random places of a box, each reached in a straight line from the one before.

    The struts reach the places in both directions, on other paths than in a campaign. Each place is the first of TRIES
    random ones at which every strut has travelled CLEAR since it reversed, and so has taken up its backlash; if
    there is none, it is the one at which the shortest of the struts' travels is longest.
    """
    rng, places = np.random.default_rng([seed, 30]), list[np.ndarray]()
    while len(places) < PLACES:
        drawn, travel = rng.uniform(box[0], box[1], (TRIES, 3)).round(6), -np.inf
        for place in drawn:
            moved = _since_reversal(geometry, places[-1], place, level) if places else np.inf
            if moved > travel:
                best, travel = place, moved
            if travel >= CLEAR:
                break
        places.append(best)
    return CampaignRun(name, "tracker_6d", np.array(places), np.tile(level, (PLACES, 1, 1)))


def _since_reversal(geometry: HexapodGeometry, start: np.ndarray, end: np.ndarray, level: np.ndarray) -> float:
    """Return how far, m, the struts move on a straight path after their last reversal; the smallest of the six."""
    path = np.linspace(start, end, SAMPLES)
    lengths = strut_lengths_batch(
        Structure.of(geometry), *geometry.platform_poses(path, np.tile(level, (SAMPLES, 1, 1))), threads=1
    )
    outwards = lengths[-1] > lengths[-2]
    return float(np.where(outwards, lengths[-1] - lengths.min(axis=0), lengths.max(axis=0) - lengths[-1]).min())


@dataclass(frozen=True)
class RigidMotion:
    """Rigid motion that best maps predicted to measured tool positions; if large, base or instrument has moved."""

    motion: np.ndarray  # (6,), m: shift, then rotation vector × distance of the box's corners from its centre
    error: float  # largest standard error of a component of `motion`, m

    def moved(self, before: RigidMotion) -> float:
        """Return by how much, m, this motion differs from the motion `before`; 0 if noise explains the difference."""
        change, error = float(np.linalg.norm(self.motion - before.motion)), np.hypot(self.error, before.error)
        return change if change > ASSUMED.surely * np.sqrt(len(self.motion)) * error else 0.0


def compare(
    fitted: FittedParameters, readings: MeasurementSet, promised: float, as_run: bool = False
) -> tuple[float, bool, RigidMotion]:
    """Return the tool's RMS position error, m, whether the fit's limit `promised`, m, holds, and the rigid motion.

    The error is what compensation by the fitted model would leave; if `as_run`, the error is measured minus commanded
    position, whichever model the compensator ran.

    The rigid motion is subtracted from the errors, because `promised` limits the error after best-fit alignment. The
    test: if the tool's true RMS error equals `promised`, each coordinate of a residual has the variance
    promised²/3 + noise², and the sum of the squared coordinates divided by this variance is χ²-distributed.
    """
    chosen, space = readings.select(np.array(KINDS)[readings.kind] == "position"), fitted.space
    off, directions = chosen.value, chosen.directions()
    if not as_run:
        off = off - (directions * predict(space, fitted.x, chosen.stations).errors[chosen.station]).sum(axis=1)
    noise = float(np.mean((chosen.stated * fitted.noise[chosen.kind]) ** 2))
    arms = chosen.points()[chosen.station] - space.places(space.work_box.mean(axis=0))
    farthest = 0.5 * float(np.linalg.norm(np.ptp(space.work_box, axis=0)))
    rigid = np.concatenate([directions[:, :3], np.cross(arms, directions[:, :3]) / farthest], axis=1)
    motion, *_ = np.linalg.lstsq(rigid, off, rcond=None)
    residuals, freedom = off - rigid @ motion, len(off) - len(motion)
    found = np.sqrt(max(3.0 * (residuals @ residuals / freedom - noise), 0.0))
    limit = float(chdtri(freedom, BEYOND)) * (promised**2 / 3.0 + noise)
    variance = max(noise, float(np.mean(residuals**2)))
    error = np.sqrt(variance * np.linalg.inv(rigid.T @ rigid).diagonal().max())
    return float(found), bool(residuals @ residuals <= limit), RigidMotion(motion, float(error))
