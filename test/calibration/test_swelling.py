"""Struts that swell by humidity, fitted from repeated lines, on a machine whose growth is known.

Machines are virtual, so the truth is known exactly; the lines are those of the warm-up tests, on a 6-6 machine with
turned frames. What a fit leaves is judged by its own stated deviations.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines

from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.sensitivity import derivatives, predict
from hexapod_comp.calibration.thermal import warming_json, warming_text
from hexapod_comp.errors import InputFileError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.measurements.campaign import Campaign, CampaignRun, template
from hexapod_comp.measurements.readings import KINDS, MeasurementSet
from hexapod_comp.measurements.tidy import read_tidy, write_measurements
from hexapod_comp.virtual.instruments import measure

MOISTURE = 3e-4  # 3 ppm per %, m/m

SETTINGS = FitSettings(blocks=("moisture",), strut_moisture=1e-4)


@pytest.fixture(scope="module")
def geometry(tmp_path_factory: pytest.TempPathFactory) -> HexapodGeometry:
    return load_geometry(machines()["framed"].write(tmp_path_factory.mktemp("machine") / "framed.yaml"))


def read(geometry: HexapodGeometry, rise: float = 0.25) -> MeasurementSet:
    """Return x, y and z lines read in four rounds, while the air goes from 40 % up by a `rise`."""
    box, runs = machines()["framed"].box, []
    for number in range(4):
        for axis in range(3):
            positions = np.tile(box.mean(axis=0), (5, 1))
            positions[:, axis] = np.linspace(*box[:, axis], 5)
            runs.append(CampaignRun(f"{axis} {number}", "5-D", positions, np.tile(np.eye(3), (5, 1, 1))))
    side = float(np.ptp(box, axis=0).min())
    plan = Campaign(box, side, side, None, 0, runs=tuple(runs), noise=(2e-7,) * len(KINDS))
    planned = template(plan, geometry)
    humidity = 0.4 + rise * np.linspace(0.0, 1.0, len(planned.stations))
    planned = replace(planned, stations=replace(planned.stations, humidity=humidity.round(6)))
    model = MachineModel(geometry.name, struts=StrutErrors(moisture=np.full(6, MOISTURE)))
    return measure(planned, plan, RealMachine(geometry, model), seed=5)


@pytest.fixture(scope="module")
def fitted(geometry: HexapodGeometry) -> ModelFit:
    return fit_model(read(geometry), SETTINGS)


def test_the_coefficient_comes_back(fitted: ModelFit) -> None:
    swelling = fitted.warming.swelling
    assert swelling is not None
    assert swelling.change == pytest.approx(0.25)
    assert abs(swelling.moisture - MOISTURE) < 3.0 * swelling.deviation < 0.3 * MOISTURE
    assert swelling.determined > 0.9
    np.testing.assert_allclose(fitted.model.struts.moisture, swelling.moisture, atol=1e-11)  # files have 11 digits
    assert "humidity; changed by 25.0 %: struts grow by " in warming_text(fitted.warming)
    assert warming_json(fitted.warming)["swelling"]["stated"] == 1e-4


def test_a_machine_of_which_nobody_says_that_it_swells_pays_nothing(geometry: HexapodGeometry) -> None:
    settings = replace(SETTINGS, blocks=("pitch", "moisture"), strut_moisture=None)
    space = ParameterSpace(read(geometry), settings)
    assert space.block("moisture") is None
    assert not space.model(np.zeros(space.size)).struts.moisture.any()


def test_missing_humidity_is_said_and_counts_as_50_percent(geometry: HexapodGeometry) -> None:
    dry = read(geometry)
    dry = replace(dry, stations=replace(dry.stations, humidity=np.full(len(dry.stations), np.nan)))
    unknown = fit_model(dry, SETTINGS)
    assert any("not every reading has its humidity" in note for note in unknown.notes)
    assert unknown.warming.swelling is not None
    assert unknown.warming.swelling.change == 0.0


def test_derivative_against_finite_differences(geometry: HexapodGeometry) -> None:
    """The derivative is by first order in the growth, 1e-4 · 0.15 = 1.5e-5 at most: so far off it may be."""
    measured = read(geometry)
    space = ParameterSpace(measured, SETTINGS)
    at, step = space.block("moisture").part.start, 1e-6
    x, away = np.zeros(space.size), np.eye(space.size)[at] * step
    rows = derivatives(space, predict(space, x, measured.stations), measured.stations)[:, :, at]
    ends = [predict(space, x + way * away, measured.stations).errors for way in (-1.0, 1.0)]
    np.testing.assert_allclose(rows, (ends[1] - ends[0]) / (2.0 * step), atol=2e-5 * np.abs(rows).max())


def test_files_carry_humidity_to_the_last_bit(geometry: HexapodGeometry, tmp_path: Path) -> None:
    measured, path = read(geometry), tmp_path / "damp.csv"
    write_measurements(measured, path)
    text = path.read_text(encoding="utf-8")
    assert "humidity_percent" in text.splitlines()[0]
    np.testing.assert_array_equal(read_tidy(path, geometry).stations.humidity, measured.stations.humidity)
    (tmp_path / "wrong.csv").write_text(text.replace(",40\n", ",140\n"), encoding="utf-8")
    with pytest.raises(InputFileError, match=r"column humidity_percent: must be within 0…1"):
        read_tidy(tmp_path / "wrong.csv", geometry)
