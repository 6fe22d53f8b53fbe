"""Imperfections drawn within bounds; length maps drawn as waves, evaluated by the core on a machine."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import assert_defaults
from strategies import paper_geometry

from hexapod_comp.cli.verbs import BOUNDED
from hexapod_comp.core import batch
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.virtual.imperfections import (
    STREAMS,
    ImperfectionBounds,
    draw_model,
    largest_errors,
    seeded,
    with_length_map,
)
from hexapod_comp.virtual.named import usual_bounds
from hexapod_comp.virtual.warm_up import growing

COMMANDS = np.linspace(0.33, 0.88, 2201)  # the stroke of the paper's struts in config/paper.yaml, m


def strut_errors(seed: int, **options: object) -> np.ndarray:
    """Return the strut errors, (6, n), m, at :data:`COMMANDS` of a machine with a length map."""
    geometry = paper_geometry()
    machine = RealMachine(geometry, with_length_map(MachineModel("paper"), geometry, seed, **options))  # type: ignore[arg-type]
    return np.array([batch.strut_errors(machine.state, strut, 0.0, COMMANDS)[0] for strut in range(6)])


def test_length_maps_are_as_large_and_as_long_as_asked() -> None:
    """The size differs a little, since knots and commands sample the waves differently; a wave crosses zero twice."""
    values = strut_errors(3, waves=(0.05, 0.07), rms=50e-6)
    np.testing.assert_allclose(np.sqrt((values**2).mean(axis=1)), 50e-6, rtol=0.02)
    np.testing.assert_allclose(strut_errors(3, waves=(0.05, 0.07)), 0.1 * values, atol=1e-12, err_msg="the same waves")
    crossings = (np.diff(np.sign(values), axis=1) != 0).sum(axis=1)
    assert (np.abs(crossings - 2.0 * 0.55 / 0.06) < 6).all()


def test_length_maps_that_cannot_be_are_refused() -> None:
    with pytest.raises(ModelError, match="seed: must be a whole number, 0 or above"):
        strut_errors(-1)
    with pytest.raises(ModelError, match="length error changes by"):  # too steep
        strut_errors(0, rms=5e-3)


def test_usual_machines_fill_their_bounds() -> None:
    """Of the 240 or more values of forty machines the extremes are within 5 % of the bounds; seeds draw them again."""
    geometry = paper_geometry()
    models = [draw_model(geometry, usual_bounds(geometry, length_map=0.0), seed) for seed in range(40)]
    struts = [model.struts for model in models]
    drawn = {
        (-50e-6, 50e-6): [np.array([model.base_deviation for model in models]),
                          np.array([model.platform_deviation for model in models]),
                          np.array([one.offset for one in struts]), np.array([one.pitch for one in struts])],
        (1e-6, 3e-6): [np.array([np.hypot(one.cosine[:, 0], one.sine[:, 0]) for one in struts])],
        (2e-6, 4e-6): [np.array([one.backlash for one in struts])],
    }  # fmt: skip
    for (low, high), kinds in drawn.items():
        for values in kinds:
            assert low <= values.min() < low + 0.05 * (high - low)
            assert high >= values.max() > high - 0.05 * (high - low)
    np.testing.assert_array_equal(models[7].platform_deviation[0], models[7].platform_deviation[1])
    again = draw_model(geometry, usual_bounds(geometry), 7).struts
    assert np.sqrt((again.map_values**2).mean()) == pytest.approx(1e-6, rel=1e-9)
    np.testing.assert_array_equal(again.offset, struts[7].offset)
    # Wavelengths are 10 to 35 % of the stroke, here 5 m, or 60 and 200 mm if that is more
    long = replace(geometry, limits=replace(geometry.limits, stroke=np.tile([0.3, 5.3], (6, 1))))
    for machine, waves in ((geometry, (0.06, 0.2)), (long, (0.5, 1.75))):
        drawn, bounds = MachineModel("paper"), ImperfectionBounds(length_map=1e-6)
        wanted = with_length_map(drawn, machine, 7, 1e-6, waves).struts
        np.testing.assert_allclose(draw_model(machine, bounds, 7).struts.map_values, wanted.map_values, atol=1e-15)


def test_fields_worn_screws_and_expansions_have_the_size_of_their_bounds() -> None:
    """A field takes its bounds somewhere in its box; other errors change neither the joints nor each other."""
    geometry, box = paper_geometry(), np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.5]])
    bounds = ImperfectionBounds(
        field_displacement=4e-6, field_rotation=7e-6, field_box=box, strut_expansion=(10e-6, 12e-6),
        body_expansion=(8e-6, 9e-6), harmonics=(1e-6, 2e-6), wear=5e-6)  # fmt: skip
    model, low = draw_model(geometry, bounds, 3), geometry.limits.stroke[0, 0]
    np.testing.assert_allclose(largest_errors(model.field), [4e-6] * 3 + [7e-6] * 3, rtol=1e-9)
    harmonics = np.hypot(model.struts.cosine[:, 1:], model.struts.sine[:, 1:])
    assert ((harmonics >= 1e-6) & (harmonics <= 2e-6)).all()
    bodies = np.array([model.base_expansion, model.platform_expansion])
    assert ((bodies >= 8e-6) & (bodies <= 9e-6)).all()
    assert ((model.struts.expansion >= 10e-6) & (model.struts.expansion <= 12e-6)).all()
    worn = model.struts.map_backlash
    middles = (model.struts.map_knots[worn.argmax(axis=1)] - low) / np.ptp(geometry.limits.stroke[0])
    assert ((middles > 0.29) & (middles < 0.71)).all()
    # The logarithm of a bell curve is a parabola of the second derivative −1/width²
    worn = [draw_model(geometry, ImperfectionBounds(wear=5e-6), seed).struts for seed in range(40)]
    step = worn[0].map_knots[1] - worn[0].map_knots[0]
    widths = [step / np.sqrt(-np.diff(np.log(one.map_backlash), 2, axis=1)).mean(axis=1) for one in worn]
    for values, low, high in ((np.array(widths) / np.ptp(geometry.limits.stroke[0]), 0.1, 0.3),
                              (np.array([one.map_backlash.max(axis=1) for one in worn]), 2.5e-6, 5e-6)):  # fmt: skip
        assert 0.98 * low < values.min() < 1.05 * low
        assert 0.97 * high < values.max() <= high * (1.0 + 1e-9)
    plain = draw_model(geometry, ImperfectionBounds(), 3)
    np.testing.assert_array_equal(plain.base_deviation, model.base_deviation)
    assert len({seeded(3, name).random() for name in STREAMS}) == len(STREAMS)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"joint": -1e-6}, "joint: must be finite and not negative"),
        ({"wave": (2e-6, 1e-6)}, "wave: must be two numbers, 0 ≤ lowest ≤ highest, m"),
        ({"strut_expansion": (0.0, np.inf)}, "strut_expansion: must be two numbers, 0 ≤ lowest ≤ highest, 1/K"),
        ({"wave_period": 0.0}, "wave_period: must be above zero, m"),
        ({"field_reversal": 1.1}, "field_reversal: must be at most 1"),
        ({"field_rotation": 1e-6}, "field_box: must be two finite corners, the lower first, m, if a field is drawn"),
        ({"field_displacement": 1e-6, "field_box": np.zeros((2, 3))}, "field_box: must be two finite corners"),
    ],
)
def test_wrong_bounds(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(ModelError, match=re.escape(f"bounds.{problem}")):
        ImperfectionBounds(**given)


def test_the_help_of_imagine_states_the_bounds_that_apply_without_options() -> None:
    bounds = usual_bounds(replace(paper_geometry(), screw_lead=np.zeros(6)))
    for name, _, size, bound, text in BOUNDED:
        stated, usual = re.search(r"\(default\D* ([\d,]+)\)", text), np.ravel(getattr(bounds, bound))
        assert stated, name
        numbers = size * np.array(stated[1].split(","), dtype=float)
        assert usual == pytest.approx(np.resize(numbers, usual.shape)), name


def test_a_model_with_an_expansion_keeps_it() -> None:
    grown = growing(MachineModel("paper"), np.array([1e-6, 2e-6, 3e-6]))
    assert grown.struts.expansion.tolist() == [1e-6] * 6
    assert (grown.base_expansion, grown.platform_expansion) == (2e-6, 3e-6)
    for own in (replace(MachineModel("paper"), base_expansion=5e-6), MachineModel("paper", platform_expansion=5e-6),
                replace(grown, base_expansion=0.0, platform_expansion=0.0)):  # fmt: skip
        assert growing(own, np.array([1e-6, 2e-6, 3e-6])) is own


def test_defaults():
    assert_defaults(__file__)
