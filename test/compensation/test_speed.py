"""The compensator's limits of speed and acceleration: by stamps, by receipt, by publication.

The truth is the limit itself: over any 20 ms between two publications no strut may have been told to go further than
1.05 times what the limit allows, whatever comes. The ideal machine moves straight up, so that lengths are closed form.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.errors import HexapodError, LimitError, TooEarlyError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel

PAPER = load_geometry(config_file("paper.yaml"))
SPEED = 0.25
"""Its largest strut speed, m/s."""

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
RISE = 1e-3 / 0.789
"""So far, m, the tool rises from home while a strut lengthens by about 1 mm; lengths are 507 mm, height 400 mm."""


def ideal(**limits: float) -> Compensator:
    return Compensator(replace(PAPER, limits=replace(PAPER.limits, **limits)), MachineModel("paper"))


def at(rise: float) -> tuple[float, ...]:
    return (0.0, 0.0, 0.4 + rise, *UPRIGHT)


def test_a_stream_at_the_limit_passes_by_its_stamps():
    """4 ms apart and 1 ms apart, at 0.999 of the limit; at 1.02 it ends when 5 ms of motion are used up."""
    for period, count in ((4e-3, 300), (1e-3, 600)):
        for share, ends in ((0.999, False), (1.02, True)):
            compensator, told = ideal(), list[float]()
            with pytest.raises(LimitError, match="by the stamps, allowed 250 mm/s") if ends else nullcontext():
                for n in range(count):
                    told.append(compensator.step(at(rise_of(share * SPEED * period * n)), period * n)[0])
            ahead = len(told) * period * 0.02
            assert (len(told) == count) != ends
            assert not ends or ahead == pytest.approx(5e-3, abs=2 * period * 0.02), "5 ms of motion"


def rise_of(lengthening: float) -> float:
    """Return how far the tool rises from home while the struts lengthen: Pythagoras."""
    start = float(np.linalg.norm(PAPER.base_joints[0] - (PAPER.platform_joints[0] + [0.0, 0.0, 0.4])))
    flat = start**2 - 0.4**2
    return math.sqrt((start + lengthening) ** 2 - flat) - 0.4


def test_a_clock_that_is_set_back_or_stands_tells_no_speed():
    """A stamp earlier than the last one's, or none at all: the time of receipt is left."""
    compensator = ideal()
    compensator.step(at(0.0), 100.0, None, 7.0)
    compensator.step(at(RISE), 50.0, None, 7.01)
    compensator.step(at(2.0 * RISE), math.nan, None, 7.02)
    with pytest.raises(TooEarlyError):
        compensator.step(at(3.5 * RISE), math.nan, None, 7.021)
    compensator.step(at(3.5 * RISE), math.nan, None, 7.03)


def test_too_early_a_command_says_how_long_it_must_wait_and_nothing_has_changed():
    compensator = ideal()
    compensator.step(at(0.0), math.nan, None, 0.0)
    compensator.published(0.0)
    before = compensator.snapshot()
    with pytest.raises(TooEarlyError, match=r"strut_\d cannot be there yet: .* ms too early for 250 mm/s") as caught:
        compensator.step(at(rise_of(1.5e-3)), math.nan, None, 1e-3)
    assert caught.value.wait == pytest.approx(6e-3 - 1e-3 - 8e-4, abs=1e-6), "1.5 mm take 6 ms"
    assert caught.value.reason == "speed"
    np.testing.assert_equal(compensator.snapshot(), before)
    compensator.step(at(rise_of(1.5e-3)), math.nan, None, 1e-3 + caught.value.wait + 1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_nothing_that_comes_makes_the_struts_faster_than_the_limit(seed):
    """Commands at random times, in bunches, with resets, some published late: over 20 ms never above 1.05.

    Publications are at random up to 30 ms late, as by a processor that was away; resets go to measured struts.
    """
    rng = np.random.default_rng(seed)
    compensator, published = ideal(), list[tuple[float, np.ndarray]]()
    now, rise, direction = 0.0, 0.0, 1.0
    for _ in range(6000):
        now += float(rng.choice([1e-5, 2e-4, 1e-3, 5e-3, 0.1], p=[0.6, 0.2, 0.15, 0.04, 0.01]))
        if published and rng.uniform() < 0.01:
            compensator.reset(published[-1][1])
        direction = -direction if abs(rise + 0.02 * direction) > 0.05 else direction
        wanted = rise + direction * rng.uniform(-2e-4, 2e-3)
        try:
            lengths = compensator.step(at(wanted), math.nan if rng.uniform() < 0.5 else now * 3.0, None, now)
        except HexapodError:
            continue
        rise = wanted
        published.append((now + (rng.uniform(0.0, 0.03) if rng.uniform() < 0.02 else 1e-4), lengths.copy()))
        now = published[-1][0]
        compensator.published(now)
    times = np.array([at for at, _ in published])
    lengths = np.array([lengths for _, lengths in published])
    assert len(times) > 500
    begins = np.searchsorted(times, times - 0.02, side="right") - 1
    ends = np.flatnonzero(begins >= 0)
    speeds = np.abs(lengths[ends] - lengths[begins[ends]]).max(axis=1) / (times[ends] - times[begins[ends]])
    assert 0.8 * SPEED < speeds.max() <= 1.05 * SPEED


def test_a_constant_acceleration_passes_as_what_it_is():
    """2 m/s² are allowed: 1.99 pass at 1 kHz and at 250 Hz, 2.05 do not, and a jump of the speed by 50 mm/s neither."""
    for period in (1e-3, 4e-3):
        for acceleration, ends in ((1.99, False), (2.05, True)):
            compensator = ideal(acceleration=2.0)
            with pytest.raises(LimitError, match="acceleration") if ends else nullcontext():
                for n in range(int(0.1 / period)):
                    compensator.step(at(rise_of(0.5 * acceleration * (period * n) ** 2)), period * n)
        compensator = ideal(acceleration=2.0)
        compensator.step(at(0.0), 0.0)
        compensator.step(at(0.0), period)
        with pytest.raises(LimitError, match=r"strut_\d: acceleration .* mm/s² by the stamps, allowed 2000 mm/s²"):
            compensator.step(at(rise_of(0.05 * period)), 2.0 * period)


def test_compensation_is_switched_on_and_a_model_is_taken_while_struts_move():
    """What they move with is no acceleration of the correction; the C core had refused both."""
    compensator = ideal(acceleration=2.0)
    for n in range(40):
        compensator.step(at(rise_of(0.5 * 1.9 * (1e-3 * n) ** 2)), 1e-3 * n)
    compensator.enable(False)
    compensator.enable(True)
    compensator.set_model(compensator.model)
    assert compensator.enabled
