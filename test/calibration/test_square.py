"""A granite square: two runs of straightness share one slope, so that the squareness of two axes shows."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_helpers import FEW, virtual_machine

from hexapod_comp.calibration.estimator import Estimation
from hexapod_comp.calibration.parameters import ParameterSpace
from hexapod_comp.errors import InputFileError
from hexapod_comp.measurements.campaign import Campaign, line_run, template
from hexapod_comp.measurements.readings import MeasurementSet
from hexapod_comp.measurements.tidy import read_tidy, write_measurements
from hexapod_comp.virtual.instruments import measure

BOX = np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.5]])
ENDS = {"x": [[-0.1, 0.0, 0.45], [0.1, 0.0, 0.45]], "y": [[0.0, -0.1, 0.45], [0.0, 0.1, 0.45]]}


def faces(slope: str) -> Campaign:
    """Return straightness along x and along y, from one square where it is named."""
    runs = [line_run(f"face {a}", "straightness", np.array(ends), 9, np.eye(3)) for a, ends in ENDS.items()]
    for run in runs:
        object.__setattr__(run, "slope", slope)
    return Campaign(BOX, 0.1, 0.05, None, 0, runs=tuple(runs), noise=(0.0,) * 7)


def left(m: MeasurementSet, values: np.ndarray) -> float:
    """Return how much of a straightness is left beside the instruments' unknowns, in m."""
    estimation = Estimation(m, ParameterSpace(m, FEW), alone=False)
    cells = estimation.cells
    mean = np.bincount(cells.of_reading, values) / np.bincount(cells.of_reading)
    return (
        float(
            np.abs(estimation.free_of_nuisance(mean[:, None]) / np.sqrt(np.bincount(cells.of_reading))[:, None]).max()
        )
        * 1e-6
    )


@pytest.mark.parametrize(("slope", "seen"), [("square", True), ("", False)])
def test_squareness_shows_where_two_faces_share_a_slope(slope, seen):
    """The square turned by 1 mrad adds x to dy and −y to dx, and leaves nothing.

    Axes that are 1 mrad off square add +x and +y: half of it on either face is the square's, ±0.1 mm at the ends.
    """
    m = template(faces(slope), virtual_machine(3).geometry)
    point = m.points()[m.station]
    dx, dy = (m.directions()[:, a] * 1e-3 for a in (0, 1))
    assert left(m, dy * point[:, 0] - dx * point[:, 1]) < 1e-12
    assert left(m, dy * point[:, 0] + dx * point[:, 1]) == pytest.approx(1e-4 if seen else 0.0, abs=1e-12)


def test_a_virtual_square_lies_askew_as_one():
    """What its turn adds to a nominal machine, no noise: the fit explains all of it by one slope about each axis."""
    truth = virtual_machine(3)
    plan, nominal = faces("square"), template(faces("square"), truth.geometry)
    askew = measure(nominal, plan, truth, 1).value
    straight = measure(nominal, Campaign(**{**vars(plan), "beam_slope": 0.0}), truth, 1).value
    assert np.abs(askew - straight).max() > 1e-6
    assert left(nominal, askew - straight) < 1e-12


def test_a_file_keeps_the_slope(tmp_path):
    m = template(faces("square"), virtual_machine(3).geometry)
    write_measurements(m, tmp_path / "m.csv")
    again = read_tidy(tmp_path / "m.csv", m.geometry)
    assert [run.slope for run in again.runs] == ["square", "square"]
    text = (tmp_path / "m.csv").read_text().replace(",square", ",other", 1)
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputFileError, match="more than one slope"):
        read_tidy(tmp_path / "m.csv", m.geometry)
