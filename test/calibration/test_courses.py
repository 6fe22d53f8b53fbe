"""The courses behind what sensors read.

Truth: first-order lags in closed form, and readings that nobody has disturbed.
"""

from __future__ import annotations

from dataclasses import replace

import calibration_helpers as small
import numpy as np
import pytest

from hexapod_comp.calibration.thermal import with_courses
from hexapod_comp.measurements.campaign import template
from hexapod_comp.measurements.readings import MeasurementSet

NOISE = 0.0065  # What the compensator's filter of 30 s leaves of 0.05 K, K

PLAN = template(small.campaign("1-D"), small.paper())
COUNT = len(PLAN.stations)
# Fifty stations every ten minutes, one in four seconds
BURSTS = 600.0 * (np.arange(COUNT) // 50) + 4.0 * (np.arange(COUNT) % 50)


def warmed(times: np.ndarray, wait: float = 0.0) -> np.ndarray:
    """Return a temperature that goes up by 3 K, °C."""
    return 20.0 - 3.0 * np.expm1(-np.maximum(times - wait, 0.0) / 1500.0)


def read(times: np.ndarray, temperatures: np.ndarray, humidity: float = np.nan) -> MeasurementSet:
    """Return a plan whose stations have these times, s, and all parts' temperatures (COUNT, 8), °C."""
    state = {"times": times, "temperatures": temperatures, "humidity": np.full(COUNT, humidity)}
    return replace(PLAN, stations=replace(PLAN.stations, **state))


def noise() -> np.ndarray:
    """Return what sensors of which the filter has made 30 s alike read beside, (COUNT, 8), K."""
    white = np.random.default_rng(7).standard_normal((COUNT + 30, 8))
    alike = np.array([white[n : n + 8].mean(axis=0) for n in range(COUNT)])
    return NOISE * alike / alike.std(axis=0)


def test_what_sensors_add_within_a_burst_is_taken_off() -> None:
    """Of fifty readings of which eight are alike, six are independent; a level and a slope are two of them. What is
    left changes from reading to reading by no more than a slope that is known from half of the noise over a minute."""
    true = np.tile(warmed(BURSTS)[:, None], 8)
    course = with_courses(read(BURSTS, true + noise())).stations.temperatures
    assert ((course - true).std(axis=0) < NOISE * np.sqrt(2.0 / 6.0) * 1.3).all()
    jitter = np.diff(course, axis=0)[np.diff(BURSTS) < 5.0] - np.diff(true, axis=0)[np.diff(BURSTS) < 5.0]
    assert np.abs(jitter).max() < 4.0 * 0.5 * NOISE / 60.0 * 4.0


def test_what_warms_smoothly_stays_as_it_is() -> None:
    """A course that bends by 3 K/(1500 s)² is a straight line in a burst of 196 s to b·T²/12 = 4.3 mK; humidity that
    is not known stays so."""
    true = np.tile(warmed(BURSTS)[:, None], 8)
    stations = with_courses(read(BURSTS, true)).stations
    np.testing.assert_allclose(stations.temperatures, true, atol=4.3e-3)
    assert np.isnan(stations.humidity).all()


def test_power_switched_on_while_it_is_read_shows() -> None:
    """The bend is a minute wide: 60 s of 2 mK/s at most, and the mean of a corner's bin lies within half of that."""
    times = 4.0 * np.arange(COUNT)
    true = np.tile(warmed(times, wait=2.0 * COUNT)[:, None], 8)
    course = with_courses(read(times, true + noise())).stations.temperatures
    assert np.abs(course - true).max() < 0.06 + 3.0 * NOISE
    assert np.sqrt(((course - true) ** 2).mean()) < NOISE


@pytest.mark.parametrize("step", [0.1, 0.5])
@pytest.mark.parametrize(("every", "share"), [(200.0, 0.4), (600.0, 0.8)])
def test_what_is_rounded_is_no_staircase(step: float, every: float, share: float) -> None:
    """Without pauses, and in bursts. As read, a temperature stays still and then jumps by a step, within a burst too;
    a course takes most of that off, and less where two thirds of it are pauses, in which it may do anything."""
    times = every * (np.arange(COUNT) // 50) + 4.0 * (np.arange(COUNT) % 50)
    true = warmed(times)[:, None] + 0.01 * np.arange(8)
    rounded = np.round(true / step) * step
    course = with_courses(read(times, rounded)).stations.temperatures
    whole, within = ([], [])
    for values in (rounded, course):
        whole.append(np.sqrt(((values - true) ** 2).mean()))
        bursts = np.array_split(values - true, COUNT // 50)
        within.append(np.sqrt(np.mean([(burst[-1] - burst[0]) ** 2 for burst in bursts])))
    assert whole[1] < share * whole[0]
    assert within[1] < share * within[0]


def test_without_times_each_run_has_a_course() -> None:
    """A step from run to run, as of one temperature written beside each, is no slope within them."""
    run = np.zeros(COUNT, dtype=int)
    run[PLAN.station] = PLAN.run
    steps = np.tile(20.0 + 0.5 * (run[:, None] % 3), 8)
    unknown = np.full(COUNT, np.nan)
    np.testing.assert_allclose(with_courses(read(unknown, steps)).stations.temperatures, steps, atol=1e-9)
