"""Waves as imperfections: are they as large, as long and as smooth as asked, and nothing else?

What is looked at is what the machine does with them (the core's strut error, its field's values), not the
arrays that were drawn. A sum of plane waves of one length λ obeys f'' = −(2π/λ)²·f on a strut and Helmholtz'
equation ∇²f = −(2π/λ)²·f in space; a sum of several lengths has its spectrum between the shortest and the
longest. Neither needs the phases, directions or sizes that were drawn.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache

import numpy as np
import pytest
from strategies import paper_geometry, random_model

from benchmarks.smooth_imperfections import with_wavy_field
from hexapod_comp.core import batch
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.virtual.imperfections import with_length_map

PAPER = paper_geometry()
PLAIN = MachineModel("paper")
BOX = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]])

STROKE = (0.33, 0.88)
"""Of the paper's struts, config/paper.yaml, m."""

COMMANDS = np.linspace(*STROKE, 2201)

FORWARD, BACKWARD = np.ones(3), -np.ones(3)


def strut_errors(model: MachineModel) -> np.ndarray:
    """Return what the machine's struts do with :data:`COMMANDS`, shape (6, n), m."""
    machine = RealMachine(PAPER, model)
    return np.array([batch.strut_errors(machine.state, strut, 0.0, COMMANDS)[0] for strut in range(6)])


def field_errors(model: MachineModel, points: np.ndarray, sense: np.ndarray = FORWARD) -> np.ndarray:
    """Return the field at points (…, 3), shape (…, 6), m and rad."""
    return np.apply_along_axis(lambda point: model.field.evaluate(point, sense)[0], -1, points)


@lru_cache
def wavy(seed: int) -> MachineModel:
    """Return a machine with a wavy field of 5 µm and 30 µrad and nothing else."""
    return with_wavy_field(PLAIN, BOX, seed)


def rms(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=axis))


# Length maps.


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_every_struts_map_is_as_large_as_asked(seed: int) -> None:
    """Over the whole stroke; knots and these commands sample the waves differently: 1 %."""
    np.testing.assert_allclose(rms(strut_errors(with_length_map(PLAIN, PAPER, seed)), 1), 5e-6, rtol=0.01)
    tenfold = with_length_map(PLAIN, PAPER, seed, rms=50e-6)
    np.testing.assert_allclose(rms(strut_errors(tenfold), 1), 50e-6, rtol=0.01)


@pytest.mark.parametrize(("seed", "waves"), [(0, (0.06, 0.2)), (3, (0.06, 0.2)), (3, (0.1, 0.12))])
def test_all_power_lies_between_the_longest_and_the_shortest_wave(seed: int, waves: tuple[float, float]) -> None:
    """Spectrum of all six struts over a stroke of 0.55 m under a Hann window, which smears a line over two bins
    of 1/0.55 m each way, and with its side lobes a little over three; measured outside: 5e-5 and less."""
    values = strut_errors(with_length_map(PLAIN, PAPER, seed, waves=waves))[:, :-1] * np.hanning(len(COMMANDS) - 1)
    frequency = np.fft.rfftfreq(values.shape[1], COMMANDS[1] - COMMANDS[0])
    power = np.abs(np.fft.rfft(values, axis=1)) ** 2
    bins = 3.0 / (STROKE[1] - STROKE[0])
    outside = (frequency < 1.0 / waves[1] - bins) | (frequency > 1.0 / waves[0] + bins)
    assert (power[:, outside].sum(axis=1) < 1e-3 * power.sum(axis=1)).all()


def test_between_the_knots_runs_the_wave_itself() -> None:
    """Waves of 100 mm alone: f'' = −(2π/λ)²·f, second differences over 10 mm taken exactly, since those of a
    wave over ±h are 2·(cos(2πh/λ) − 1)·f. The natural spline's straight ends (5 % of the stroke) are no wave;
    measured 0.2 % of the wave's size between."""
    wave, h = 0.1, 40
    values = strut_errors(with_length_map(PLAIN, PAPER, 3, waves=(wave, wave)))
    step = h * (COMMANDS[1] - COMMANDS[0])
    second = values[:, 2 * h :] - 2.0 * values[:, h:-h] + values[:, : -2 * h]
    wanted = 2.0 * (np.cos(2.0 * np.pi * step / wave) - 1.0) * values[:, h:-h]
    inner = slice(len(COMMANDS) // 20, -len(COMMANDS) // 20)
    assert np.abs(second - wanted)[:, inner].max() < 0.005 * 5e-6


def test_struts_and_seeds_have_maps_of_their_own() -> None:
    """Correlations of eight random waves over six wave lengths of stroke: far from ±1, and none in the mean."""
    maps = np.concatenate([strut_errors(with_length_map(PLAIN, PAPER, seed)) for seed in (0, 1, 2)])
    pairs = np.corrcoef(maps)[np.triu_indices(len(maps), 1)]
    assert np.abs(pairs).max() < 0.9
    assert abs(pairs.mean()) < 0.1  # 153 pairs of some 0.3 each: 0.025, four times that


def test_a_map_changes_nothing_but_the_map() -> None:
    before = random_model(np.random.default_rng(5), "paper")
    after = with_length_map(before, PAPER, 1)
    one, two = asdict(before), asdict(after)
    for name in ("map_knots", "map_values", "map_backlash"):
        assert not np.array_equal(one["struts"].pop(name), two["struts"].pop(name))
    np.testing.assert_equal(two, one)
    assert after.struts.map_knots[[0, -1]] == pytest.approx(STROKE)


# Wavy fields.


def grid_values(model: MachineModel) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return the field on its nodes along y and z and 65 places along x: places and values (65, n, m, 6)."""
    places = (np.linspace(BOX[0, 0], BOX[1, 0], 65), *model.field.grid[1:])
    return places, field_errors(model, np.stack(np.meshgrid(*places, indexing="ij"), axis=-1))


def second_derivative(values: np.ndarray, places: np.ndarray, axis: int) -> np.ndarray:
    """Return the second derivative at all but two places at each end, to fourth order."""
    moved = np.moveaxis(values, axis, 0)
    parts = [weight * moved[n : len(moved) - 4 + n] for n, weight in enumerate((-1.0, 16.0, -30.0, 16.0, -1.0))]
    return np.moveaxis(np.sum(parts, axis=0), 0, axis) / (12.0 * (places[1] - places[0]) ** 2)


def test_waves_in_space_are_as_long_as_asked() -> None:
    """Helmholtz' equation for waves of 500 mm alone. Along x a polynomial stands for them: its second derivative
    is right, too. Differences of fourth order over 25 mm: (2π·25/500)⁴/90 = 1e-4; measured 1e-4."""
    wave = 0.5
    places, values = grid_values(with_wavy_field(PLAIN, BOX, 2, waves=(wave, wave)))
    inner = slice(2, -2)
    laplacian = (
        second_derivative(values, places[0], 0)[:, inner, inner]
        + second_derivative(values, places[1], 1)[inner, :, inner]
        + second_derivative(values, places[2], 2)[inner, inner]
    )
    number = (2.0 * np.pi / wave) ** 2
    left = laplacian + number * values[inner, inner, inner]
    assert (np.abs(left).max(axis=(0, 1, 2)) < 1e-3 * number * rms(values, (0, 1, 2))).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_between_its_lines_the_field_is_as_smooth(seed: int) -> None:
    """Bilinear between lines 25 and 13 mm apart: at most h²/8·(2π/λ)² of a wave's height is cut off at mid
    cell, for λ = 400 mm 2 % and 0.5 %, and 1 % RMS over the cells of waves of all lengths and directions."""
    model = wavy(seed)
    (x, y, z), values = grid_values(model)
    middle_y, middle_z = (0.5 * (nodes[1:] + nodes[:-1]) for nodes in (y, z))
    for axis, places in ((1, (x, middle_y[3:-3], z)), (2, (x, y, middle_z[3:-3]))):
        found = field_errors(model, np.stack(np.meshgrid(*places, indexing="ij"), axis=-1))
        wanted = at_mid_cell(np.moveaxis(values, axis, 0))
        assert (rms(np.moveaxis(found, axis, 0) - wanted, (0, 1, 2)) < 0.01 * rms(values, (0, 1, 2))).all()


def at_mid_cell(values: np.ndarray) -> np.ndarray:
    """Return values half way between all but three nodes at each end, by Lagrange's polynomial through six."""
    weights = np.array([3.0, -25.0, 150.0, 150.0, -25.0, 3.0]) / 256.0
    parts = [w * values[n + 1 : len(values) - 6 + n] for n, w in enumerate(weights)]
    return np.asarray(np.sum(parts, axis=0))


SEEDS = range(4)


def test_field_is_of_the_size_asked_in_the_mean() -> None:
    """Even points in the box, four seeds, displacements and rotations apart: 5 µm and 30 µrad within 10 %."""
    found = rms(np.array([rms(even_values(seed), 0) for seed in SEEDS]).reshape(-1, 2, 3), (0, 2))
    np.testing.assert_allclose(found, [5e-6, 30e-6], rtol=0.1)


def test_every_component_is_of_the_size_asked() -> None:
    """As said: "root mean square of each component in the box". 512 even points: 3 %, bilinear 1 %: 5 %."""
    for seed in SEEDS:
        np.testing.assert_allclose(rms(even_values(seed), 0), np.repeat([5e-6, 30e-6], 3), rtol=0.05)


@lru_cache
def even_values(seed: int) -> np.ndarray:
    """Return the field at the middles of 8 × 8 × 8 equal parts of the box, shape (512, 6)."""
    parts = (np.arange(8) + 0.5) / 8.0
    share = np.stack(np.meshgrid(parts, parts, parts), axis=-1).reshape(-1, 3)
    return field_errors(wavy(seed), BOX[0] + share * (BOX[1] - BOX[0]))


def test_both_directions_feel_the_same_field() -> None:
    points = np.random.default_rng(0).uniform(BOX[0], BOX[1], (50, 3))
    np.testing.assert_array_equal(field_errors(wavy(1), points, FORWARD), field_errors(wavy(1), points, BACKWARD))


def test_a_field_changes_nothing_but_the_field() -> None:
    before = random_model(np.random.default_rng(5), "paper")
    after = with_wavy_field(before, BOX, 1)
    one, two = asdict(before), asdict(after)
    del one["field"], two["field"]
    np.testing.assert_equal(two, one)
    np.testing.assert_array_equal(after.field.box, BOX)
    np.testing.assert_array_equal(after.field.lines[0], wavy(1).field.lines[0])


# Both.


def test_equal_seeds_equal_waves_and_the_order_does_not_matter() -> None:
    one = with_wavy_field(with_length_map(PLAIN, PAPER, 1), BOX, 1)
    two = with_length_map(wavy(1), PAPER, 1)
    np.testing.assert_array_equal(one.struts.map_values, two.struts.map_values)
    np.testing.assert_array_equal(one.field.lines[0], two.field.lines[0])
    other = with_length_map(wavy(2), PAPER, 2)
    assert not np.allclose(other.struts.map_values, one.struts.map_values, atol=1e-7)
    assert not np.allclose(other.field.lines[0], one.field.lines[0], atol=1e-7)


def test_size_and_waves_change_no_draw() -> None:
    """Twice the size is twice the same waves: a study that widens one bound keeps its machines."""
    once, twice = (with_length_map(PLAIN, PAPER, 6, rms=size).struts.map_values for size in (5e-6, 10e-6))
    np.testing.assert_allclose(twice, 2.0 * once, rtol=1e-12)
    once, twice = wavy(0).field.lines[0], with_wavy_field(PLAIN, BOX, 0, displacement=10e-6).field.lines[0]
    np.testing.assert_allclose(twice[..., :3, :], 2.0 * once[..., :3, :], rtol=1e-9, atol=1e-18)
    np.testing.assert_array_equal(twice[..., 3:, :], once[..., 3:, :])


@pytest.mark.parametrize("seed", [-1, 1.0, True, "1", None])
def test_a_seed_that_is_none_is_refused(seed: object) -> None:
    for make in (lambda: with_length_map(PLAIN, PAPER, seed), lambda: with_wavy_field(PLAIN, BOX, seed)):  # type: ignore[arg-type]
        with pytest.raises(ModelError, match="seed: must be a whole number, 0 or above"):
            make()


def test_a_numpy_seed_is_the_same_seed() -> None:
    """Seeds often come from an array."""
    one, two = (with_length_map(PLAIN, PAPER, seed) for seed in (9, np.int64(9)))  # type: ignore[arg-type]
    np.testing.assert_array_equal(one.struts.map_values, two.struts.map_values)


def test_maps_are_what_a_machine_can_be() -> None:
    """Waves so steep that no strut could follow are refused by the model itself, not drawn in silence."""
    with pytest.raises(ModelError, match="strut error changes by"):
        with_length_map(PLAIN, PAPER, 0, rms=5e-3)
