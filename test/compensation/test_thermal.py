"""Temperatures and humidity: the filter, plausible readings, late parts, and struts that swell.

Sums of a few readings of about 20 °C are rounded to 1e-12 °C; nothing physical is below 1e-6. A strut that has grown by
g is L = (1 + g)·c long at command c, so c = L/(1 + g)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from hypothesis import given
from hypothesis import strategies as st
from strategies import fixed, paper_geometry

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.thermal import Plausibility, TemperatureFilter, Thermometers
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import LateGrowth

ROUNDING = 1e-10
"""Rounding of temperatures, °C."""


def taken(low_pass: TemperatureFilter, values: np.ndarray, times: np.ndarray, name: str = "base") -> np.ndarray:
    return np.array([low_pass.update(name, value, time) for value, time in zip(values, times, strict=True)])


@fixed
@given(st.lists(st.tuples(st.floats(-40.0, 120.0), st.floats(0.0, 300.0)), min_size=1, max_size=30))
def test_it_is_the_mean_weighted_by_age(readings: list[tuple[float, float]]) -> None:
    """The truth is NumPy's weighted mean, at any times in any order: a one-pole low pass."""
    values, times = np.array(readings).T
    expected = np.average(values, weights=np.exp((times - times.max()) / 30.0))
    assert taken(TemperatureFilter(30.0), values, times)[-1] == pytest.approx(expected, abs=ROUNDING)


@pytest.mark.parametrize(
    ("name", "value", "time", "text"),
    [
        ("spindle", 20.0, 1.0, "temperature: the measured part must be one of strut_1"),
        ("base", math.nan, 1.0, "temperature of base: must lie within -40…120 °C"),
        ("base", 20.0, math.nan, "time of the temperature of base: must be finite"),
        ("base", 20.0, math.inf, "time of the temperature of base: must be finite"),
    ],
)
def test_what_is_refused_leaves_no_trace(name: str, value: float, time: float, text: str) -> None:
    for wrong in (-time, math.inf):
        with pytest.raises(ModelError, match="temperature_time_constant: must be finite and not negative"):
            TemperatureFilter(wrong)
    low_pass = TemperatureFilter(30.0)
    low_pass.update("base", 20.0, 0.0)
    with pytest.raises(ModelError, match=text):
        low_pass.update(name, value, time)
    assert low_pass.update("base", 21.0, 0.0) == 20.5


# ---- plausible readings ----


def thermometers(rate: float = 0.2, spread: float = 40.0, timeout: float = 60.0) -> Thermometers:
    return Thermometers(Plausibility(rate, spread, timeout), time_constant=0.0)


@pytest.mark.parametrize(
    ("value", "seconds", "refusal"),
    [
        (21.9, 0.0, ""),
        (22.1, 0.0, "22.10 °C in 0.0 s, allowed 1 K"),
        (22.9, 5.0, ""),
        (23.1, 5.0, "23.10 °C in 5.0 s, allowed 2 K"),
        (18.1, 5.0, "18.10 °C in 5.0 s, allowed 2 K"),
        (40.0, 95.0, ""),
    ],
)
def test_a_part_warms_no_faster_than_its_rate(value: float, seconds: float, refusal: str) -> None:
    """After 20.9 °C a change of 1 K is allowed at once, and 0.2 K more per second."""
    made = thermometers()
    made.update("base", 20.9, 100.0)
    if not refusal:
        assert made.update("base", value, 100.0 + seconds) == value
        return
    with pytest.raises(ModelError, match=f"^temperature of base: has jumped from 20.90 to {refusal}$"):
        made.update("base", value, 100.0 + seconds)
    assert made.update("base", 20.9, 100.0 + seconds) == 20.9, "what is refused shuts nothing out"


def test_a_part_is_judged_by_the_median_of_the_others() -> None:
    """The median of 70, 22 and 23 °C is 23 °C, with 83 °C besides it is 46.5 °C; 60 K are allowed."""
    made = thermometers(rate=0.0, spread=60.0)
    for part, value in (("base", 70.0), ("strut_1", 22.0), ("strut_2", 23.0)):
        made.update(part, value, 0.0)
    assert made.update("strut_3", 83.0, 1.0) == 83.0
    with pytest.raises(ModelError, match=r"63\.5 K from the other parts' 46\.50 °C; allowed 60 K"):
        made.update("strut_4", 110.0, 1.0)


def test_what_is_stale_is_no_measure_for_others() -> None:
    """A reading of 0 °C is the reference for other parts for 60 s; after that the reference of 20 °C counts again."""
    made = thermometers(rate=0.0)
    made.update("base", 0.0, 0.0)
    with pytest.raises(ModelError, match=r"the other parts' 0\.00 °C"):
        made.update("platform", 45.0, 59.0)
    assert made.stale(60.0) == ()
    assert made.stale(61.0) == ("base",)
    assert made.update("platform", 45.0, 61.0) == 45.0
    never = thermometers(timeout=0.0)
    never.update("base", 20.0, 0.0)
    assert never.stale(1e9) == ()


def late_model() -> MachineModel:
    """Return a model whose struts follow the base's thermometer with a time constant of 600 s."""
    struts = StrutErrors(expansion=np.full(6, 12e-6))
    late_growth = LateGrowth((600.0,), np.array([[12e-6]] * 6 + [[0.0]] * 2), "base")
    return MachineModel("paper", "late", struts=struts, late_growth=late_growth)


def test_a_compensator_follows_late_and_a_restored_one_goes_on_bit_for_bit():
    """Struts of 12 ppm/K follow a step of 3 K: after one time constant by 1 − 1/e, for any times of the readings."""
    geometry = load_geometry("paper.yaml")
    one, other = (Compensator(geometry, late_model()) for _ in range(2))
    one.set_temperature("base", 20.0, 100.0)
    one.set_temperature("base", 23.0, 100.0)
    for second in range(101, 401):
        one.set_temperature("base", 23.0, float(second))
    other.restore(one.snapshot())
    for second in range(401, 701):
        for compensator in (one, other):
            compensator.set_temperature("base", 23.0, float(second))
    growth = one.machine.growth
    np.testing.assert_allclose(growth, 12e-6 * 3.0 * -math.expm1(-1.0), rtol=1e-12)
    assert growth.tobytes() == other.machine.growth.tobytes()
    assert one.snapshot()["lags"] == other.snapshot()["lags"]


def test_a_compensator_with_late_parts_needs_the_time_of_a_temperature():
    compensator = Compensator(load_geometry("paper.yaml"), late_model())
    with pytest.raises(ModelError, match="time constants"):
        compensator.set_temperature("base", 21.0)
    assert compensator.temperatures.values == {}


def test_lags_begin_anew_with_a_model_of_other_time_constants():
    geometry, model = load_geometry("paper.yaml"), late_model()
    compensator = Compensator(geometry, model)
    compensator.set_temperature("base", 20.0, 0.0)
    compensator.set_temperature("base", 22.0, 60.0)
    compensator.set_model(replace(model, late_growth=replace(model.late_growth, time_constants=(900.0,))))
    assert compensator.snapshot()["lags"] == {}
    np.testing.assert_allclose(compensator.machine.growth, 24e-6)  # 2 K · 12 ppm/K, without delay
    with pytest.raises(ModelError, match=r"snapshot\.lags\.base"):
        compensator.restore(compensator.snapshot() | {"lags": {"base": [0.0, 1.0]}})


# ---- humidity ----


PPM_PER_PERCENT = 1e-4
"""1 ppm per % of relative humidity as a number: 1e-6 / 0.01."""

EPSILON = 2e-16


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
    np.testing.assert_allclose(damp.command, damp.nominal / (1.0 + growth), rtol=4.0 * EPSILON, atol=0.0)
    assert damp.temperatures == {"humidity": 0.7}


@pytest.mark.parametrize("value", [45.0, 0.0045, 0.0, -0.1, 1.0001, math.nan, math.inf])
def test_percent_for_a_fraction_and_other_nonsense_are_refused(value: float) -> None:
    compensator = Compensator(paper_geometry(), swelling(paper_geometry()))
    with pytest.raises(ModelError, match=r"humidity: must lie within 0\.01…1, as a fraction"):
        compensator.set_humidity(value)
    assert compensator.temperatures.values == {}


def test_a_jump_is_refused_until_it_may_have_come() -> None:
    """A change by 0.35 is allowed after 15 s: 0.05 at once, and 0.02 more per second."""
    sensors = thermometers()
    assert sensors.update("humidity", 0.45, 0.0) == 0.45
    with pytest.raises(ModelError, match=r"humidity: has jumped from 0\.45 to 0\.80 in 14\.9 s, allowed 0\.348"):
        sensors.update("humidity", 0.80, 14.9)
    assert sensors.update("humidity", 0.80, 15.1) == 0.80


def test_humidity_is_smoothed_goes_stale_and_judges_no_temperature() -> None:
    """Two readings at one time are averaged; humidity is not among the temperatures that are compared."""
    sensors = Thermometers(Plausibility(rate=0.0, spread=41.0, timeout=60.0, humidity_rate=0.0))
    sensors.update("humidity", 0.4, 0.0)
    assert sensors.update("humidity", 0.6, 0.0) == pytest.approx(0.5, abs=1e-15)
    assert sensors.update("base", 60.0, 0.0) == 60.0
    assert sensors.stale(60.5) == ("base", "humidity")
