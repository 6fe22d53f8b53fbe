"""What a calibration leaves, and what one more measurement would: against a fit that has that measurement.

And against the textbook: inverses of information, conditional covariances.
"""

from __future__ import annotations

from dataclasses import replace

import calibration_helpers as small
import numpy as np
import pytest

from hexapod_comp.calibration.design import information
from hexapod_comp.calibration.posterior import POINTS, ErrorPredictor, FittedParameters
from hexapod_comp.calibration.remaining import Remaining, measurable, remaining
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.passes import Poses
from hexapod_comp.measurements.campaign import template
from hexapod_comp.pose import rotation_from_angles

Known = tuple[RealMachine, FittedParameters]

TRACKER = "tracker, 20 poses, tilted up to 10°"


def tilted() -> Poses:
    """Return poses in the measured box, tilted up to 10°."""
    rng = np.random.default_rng(8)
    angles = np.radians(np.append(rng.uniform(-10.0, 10.0, (200, 2)), np.zeros((200, 1)), axis=1))
    return rng.uniform(*small.BOX, (200, 3)), rotation_from_angles(angles)


def fitted(poses: int = 0) -> Known:
    """Return a machine fitted to a 5-D laser's lines, with so many of a tracker's poses."""
    of_lines = small.fitted(poses)
    return RealMachine(small.paper(), of_lines.model), of_lines.known


@pytest.fixture(scope="module")
def lines() -> Known:
    return fitted()


@pytest.fixture(scope="module")
def result(lines: Known) -> Remaining:
    return remaining(*lines, tilted(), "tilted")


def test_the_measurement_that_is_recommended_does_what_is_foretold(result: Remaining) -> None:
    """Lines of a level tool leave its tilting open; a tracker sees it. Fitted with its poses, that much is left.

    Noise and tolerances are found anew, and other poses of the same number are drawn: a quarter is allowed.
    """
    shares = {share.name: share for share in result.measurements}
    assert TRACKER in [share.name for share in result.measurements[:2]]
    foretold, now = shares[TRACKER].left[1], result.left[1].rms[0]
    assert foretold < 0.75 * now
    again = remaining(*fitted(20), tilted(), "tilted")
    assert again.left[1].rms[0] == pytest.approx(foretold, rel=0.25)


def test_what_is_left_is_what_the_prediction_knows(lines: Known, result: Remaining) -> None:
    """Standard deviations that :mod:`test_prediction` draws; RMS over poses. A drawn machine's worst is beyond."""
    poses = tilted()
    standing, aligned = ErrorPredictor(*lines).predict(poses)
    assert aligned is not None
    for found, expected in ((result.left[1].rms[0], aligned), (result.left[1].standing, standing)):
        assert expected.deviations is not None
        assert found == pytest.approx(np.sqrt((expected.deviations[:, :3] ** 2).sum(axis=1).mean()), rel=1e-6)
    assert [part.poses for part in result.left] == [POINTS, 200]
    for part in result.left:
        assert part.rms[0] < part.worst < part.most < 10.0 * part.worst


def test_known_and_measured_are_the_textbooks(lines: Known, result: Remaining) -> None:
    """Known: the conditional covariance. Measured: the inverse of the sum of both informations. In SI units."""
    machine, parameters = lines
    sigma = parameters.covariance
    _, _, slopes, _ = ErrorPredictor(machine, parameters).slopes(tilted())

    def rms(covariance: np.ndarray) -> float:
        return float(np.sqrt(np.einsum("ncp,pq,ncq->", slopes[:, :3], covariance, slopes[:, :3]) / len(slopes)))

    for block, share in zip(parameters.space.blocks, result.blocks, strict=True):
        part = block.part
        known = sigma - sigma[:, part] @ np.linalg.solve(sigma[part, part], sigma[part])
        assert share.left[1] == pytest.approx(rms(known), rel=1e-3), block.name
        assert share.count == len(block.labels)
    shares = {share.name: share.left[1] for share in result.measurements}
    scale = np.sqrt(np.diag(sigma))
    information = np.linalg.inv(sigma / np.outer(scale, scale))
    for name, _, rows in measurable(parameters):
        both = information + scale[:, None] * (rows.T @ rows) * scale
        assert shares[name] == pytest.approx(rms(scale[:, None] * np.linalg.inv(both) * scale), rel=1e-3), name


def test_nothing_that_is_measured_makes_it_worse(result: Remaining) -> None:
    now = np.array([part.rms[0] for part in result.left])
    for share in (*result.measurements, *result.blocks):
        assert (share.left <= now * (1 + 1e-9)).all()
        assert (share.left >= 0.0).all()
    assert len({share.name for share in result.measurements}) == len(result.measurements) == 3 * 4 + 1 + 2


def test_readings_lose_what_their_instrument_does_not_know(lines: Known) -> None:
    """A laser's zero: an offset that is the same on all of a line's readings is not seen, so the rows' sum is zero."""
    readings = template(replace(small.campaign("1-D", 0), cycles=1), small.paper())
    parameters = lines[1]
    rows, cells = information(parameters.space, readings, parameters.x)
    for run in range(len(readings.runs)):
        of_run = rows[np.unique(cells.of_reading[readings.run == run])]
        assert np.abs(of_run.sum(axis=0)).max() < 1e-6 * np.abs(of_run).sum()
