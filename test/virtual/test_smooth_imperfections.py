"""Waves as imperfections: are they as large, as long and as smooth as asked, and nothing else?

What is judged is what the machine does with them (the core's strut error, its field's values), not the arrays that
were drawn. A sum of plane waves of one length λ obeys Helmholtz' equation ∇²f = −(2π/λ)²·f; a sum of several lengths
has its spectrum between the shortest and the longest. Neither needs the phases, directions or sizes that were drawn.
"""

from __future__ import annotations

import numpy as np
import pytest
from strategies import paper_geometry

from benchmarks.smooth_imperfections import with_wavy_field
from hexapod_comp.core import batch
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.virtual.imperfections import with_length_map

PAPER = paper_geometry()
PLAIN = MachineModel("paper")
BOX = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]])
STROKE = (0.33, 0.88)  # of the paper's struts, config/paper.yaml, m
COMMANDS = np.linspace(*STROKE, 2201)


def strut_errors(seed: int, **options: object) -> np.ndarray:
    """Return what the struts of a machine with a length map do with :data:`COMMANDS`, shape (6, n), m."""
    machine = RealMachine(PAPER, with_length_map(PLAIN, PAPER, seed, **options))  # type: ignore[arg-type]
    return np.array([batch.strut_errors(machine.state, strut, 0.0, COMMANDS)[0] for strut in range(6)])


def field_errors(model: MachineModel, *places: np.ndarray, sense: float = 1.0) -> np.ndarray:
    """Return the field on a grid of places, shape (…, 6), m and rad."""
    points = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1)
    return np.apply_along_axis(lambda point: model.field.evaluate(point, np.full(3, sense))[0], -1, points)


def rms(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=axis))


@pytest.mark.parametrize(("seed", "waves"), [(0, (0.06, 0.2)), (3, (0.1, 0.12))])
def test_length_maps_are_of_the_size_and_within_the_lengths_asked(seed: int, waves: tuple[float, float]) -> None:
    """Size: knots and these commands sample the waves differently, 1 %, 2 % of waves that beat.

    Spectrum of all six struts over a stroke of 0.55 m under a Hann window, which smears a line over two bins of
    1/0.55 m each way, and with its side lobes a little over three; measured outside: 5e-5 and less.
    """
    values = strut_errors(seed, waves=waves, rms=50e-6)
    np.testing.assert_allclose(rms(values, 1), 50e-6, rtol=0.01 if waves[0] < 0.1 else 0.02)
    np.testing.assert_allclose(strut_errors(seed, waves=waves), 0.1 * values, atol=1e-12, err_msg="the same waves")
    values = values[:, :-1] * np.hanning(len(COMMANDS) - 1)
    frequency = np.fft.rfftfreq(values.shape[1], COMMANDS[1] - COMMANDS[0])
    power = np.abs(np.fft.rfft(values, axis=1)) ** 2
    bins = 3.0 / (STROKE[1] - STROKE[0])
    outside = (frequency < 1.0 / waves[1] - bins) | (frequency > 1.0 / waves[0] + bins)
    assert (power[:, outside].sum(axis=1) < 1e-3 * power.sum(axis=1)).all()


def test_a_field_is_of_the_size_asked_and_smooth_between_its_lines() -> None:
    """Size: 512 even points, 3 %, and 1 % of bilinear: 5 %. Lines stand 25 and 13 mm apart: h²/8·(2π/λ)² of a wave's
    height is cut off at mid cell, for λ = 400 mm 2 % and 0.5 %, 1 % RMS over waves of all lengths and directions.
    At mid cell the truth is Lagrange's polynomial through six nodes."""
    model = with_wavy_field(PLAIN, BOX, 0)
    even = BOX[0] + (np.arange(8)[:, None] + 0.5) / 8.0 * (BOX[1] - BOX[0])
    found = field_errors(model, *even.T)
    np.testing.assert_allclose(rms(found, (0, 1, 2)), np.repeat([5e-6, 30e-6], 3), rtol=0.05)
    np.testing.assert_array_equal(field_errors(model, *even.T, sense=-1.0), found, err_msg="there and back alike")
    x, y, z = np.linspace(BOX[0, 0], BOX[1, 0], 9), *model.field.grid[1:]
    values = field_errors(model, x, y, z)
    weights = np.array([3.0, -25.0, 150.0, 150.0, -25.0, 3.0]) / 256.0
    for axis, nodes in ((1, y), (2, z)):
        middle = (0.5 * (nodes[1:] + nodes[:-1]))[2:-2]
        between = np.moveaxis(field_errors(model, *((x, middle, z) if axis == 1 else (x, y, middle))), axis, 0)
        moved = np.moveaxis(values, axis, 0)
        wanted = np.sum([w * moved[n : len(moved) - 5 + n] for n, w in enumerate(weights)], axis=0)
        assert (rms(between - wanted, (0, 1, 2)) < 0.01 * rms(values, (0, 1, 2))).all()


@pytest.mark.parametrize("seed", [-1, 1.0, True])
def test_a_seed_that_is_none_is_refused(seed: object) -> None:
    for make in (lambda: with_length_map(PLAIN, PAPER, seed), lambda: with_wavy_field(PLAIN, BOX, seed)):  # type: ignore[arg-type]
        with pytest.raises(ModelError, match="seed: must be a whole number, 0 or above"):
            make()
    with pytest.raises(ModelError, match="strut error changes by"):  # so steep that no strut could follow
        with_length_map(PLAIN, PAPER, 0, rms=5e-3)
