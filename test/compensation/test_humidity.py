"""Humidity through the compensator: struts that swell, what is refused, journal and replay, and who cannot carry it.

The truth is a strut's own equation: one that has grown by g makes L = (1 + g)·c of its command, so c = L/(1 + g); no
body grows by humidity. On every machine of the zoo alike, whatever its frames and units.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from strategies import paper_geometry

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.thermal import Plausibility, Thermometers
from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin
from hexapod_comp.machine.model_file import model_text, parse_model
from hexapod_comp.machine.struts import StrutErrors

PPM_PER_PERCENT = 1e-4
"""One ppm per % of relative humidity is 1e-6 / 0.01."""

ROUNDING = 2e-16


def swelling(geometry: HexapodGeometry) -> MachineModel:
    struts = StrutErrors(moisture=2.5 * PPM_PER_PERCENT * np.arange(1.0, 7.0))
    return MachineModel(geometry.name, struts=struts, origin=ModelOrigin("2026-11-22"))


@pytest.mark.parametrize("name", machines())
def test_a_strut_that_has_swollen_is_commanded_shorter(name: str, tmp_path: Path) -> None:
    """From 50 to 70 % strut n grows by n · 50 ppm. The ramp ends within 400 commands of 20 ms at 1 mm/s."""
    geometry = load_geometry(machines()[name].write(tmp_path / "machine.yaml"))
    compensator, home = Compensator(geometry, swelling(geometry)), geometry.tool_pose(geometry.home)
    for n in range(2):
        dry = compensator.correct(home, 0.02 * n)
    assert not dry.correction.any(), "50 % is where geometry and model hold"
    compensator.set_humidity(0.7)
    for n in range(2, 400):
        damp = compensator.correct(home, 0.02 * n)
    assert not damp.ramping
    growth = 50e-6 * np.arange(1.0, 7.0)
    np.testing.assert_allclose(damp.command, damp.nominal / (1.0 + growth), rtol=4.0 * ROUNDING, atol=0.0)
    assert damp.temperatures == {"humidity": 0.7}


@pytest.mark.parametrize("value", [45.0, 0.0045, 0.0, -0.1, 1.0001, math.nan, math.inf])
def test_percent_for_a_fraction_and_other_nonsense_are_refused(value: float) -> None:
    compensator = Compensator(paper_geometry(), swelling(paper_geometry()))
    with pytest.raises(ModelError, match=r"humidity: must lie within 0\.01…1, as a fraction"):
        compensator.set_humidity(value)
    assert compensator.temperatures.values == {}


def test_a_jump_is_refused_until_it_may_have_come() -> None:
    """0.45 to 0.80: 0.35, of which 0.05 at once and 0.02 a second."""
    rules = Plausibility(rate=0.2, spread=40.0, timeout=60.0)
    sensors = Thermometers(rules, time_constant=0.0)
    assert sensors.update("humidity", 0.45, 0.0) == 0.45
    with pytest.raises(ModelError, match=r"humidity: has jumped from 0\.45 to 0\.80 in 14\.9 s, allowed 0\.348"):
        sensors.update("humidity", 0.80, 14.9)
    assert sensors.update("humidity", 0.80, 15.1) == 0.80


def test_humidity_is_smoothed_goes_stale_and_judges_no_temperature() -> None:
    """Two readings at one moment count alike. 60 °C is 40 K from 20 °C, and of no concern to the air's 0.5."""
    sensors = Thermometers(Plausibility(rate=0.0, spread=41.0, timeout=60.0, humidity_rate=0.0))
    sensors.update("humidity", 0.4, 0.0)
    assert sensors.update("humidity", 0.6, 0.0) == pytest.approx(0.5, abs=1e-15)
    assert sensors.update("base", 60.0, 0.0) == 60.0
    assert sensors.stale(60.5) == ("base", "humidity")


def test_models_carry_it_and_absurd_ones_are_refused() -> None:
    geometry = paper_geometry()
    text = model_text(swelling(geometry))
    assert "moisture_ppm_per_percent: [2.5, 5" in text
    back = parse_model(text, "paper", "swelling.yaml")
    assert model_text(back) == text
    np.testing.assert_allclose(back.struts.moisture, swelling(geometry).struts.moisture, rtol=4.0 * ROUNDING)
    wrong = text.replace("[2.5,", "[2500.0,")
    with pytest.raises(InputFileError, match="1000 ppm per % of relative humidity; is the unit right"):
        parse_model(wrong, "paper", "swelling.yaml")


def test_export_to_c_carries_it(tmp_path: Path) -> None:
    """The C core grows struts by humidity, as every model runs on it."""
    geometry = load_geometry("paper")
    write_c(tmp_path / "c", geometry, swelling(geometry), ("", ""))
    assert ".moisture = 0.0," not in (tmp_path / "c" / "hexapod_model.h").read_text()
