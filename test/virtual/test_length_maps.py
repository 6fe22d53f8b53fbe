"""Length maps drawn as waves: as large and as long as asked, by what the core makes of them on the machine."""

from __future__ import annotations

import numpy as np
import pytest
from strategies import paper_geometry

from hexapod_comp.core import batch
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.virtual.imperfections import with_length_map

PLAIN = MachineModel("paper")
STROKE = (0.33, 0.88)  # of the paper's struts, config/paper.yaml, m
COMMANDS = np.linspace(*STROKE, 2201)


def strut_errors(seed: int, **options: object) -> np.ndarray:
    """Return what the struts of a machine with a length map do with :data:`COMMANDS`, shape (6, n), m."""
    machine = RealMachine(paper_geometry(), with_length_map(PLAIN, paper_geometry(), seed, **options))  # type: ignore[arg-type]
    return np.array([batch.strut_errors(machine.state, strut, 0.0, COMMANDS)[0] for strut in range(6)])


@pytest.mark.parametrize(("seed", "waves"), [(0, (0.06, 0.2)), (3, (0.1, 0.12))])
def test_length_maps_are_of_the_size_and_within_the_lengths_asked(seed: int, waves: tuple[float, float]) -> None:
    """Size: knots and these commands sample the waves differently, 1 %, 2 % of waves that beat.

    Spectrum of all six struts over a stroke of 0.55 m under a Hann window, which smears a line over two bins of
    1/0.55 m each way, and with its side lobes a little over three; measured outside: 5e-5 and less.
    """
    values = strut_errors(seed, waves=waves, rms=50e-6)
    np.testing.assert_allclose(np.sqrt((values**2).mean(axis=1)), 50e-6, rtol=0.01 if waves[0] < 0.1 else 0.02)
    np.testing.assert_allclose(strut_errors(seed, waves=waves), 0.1 * values, atol=1e-12, err_msg="the same waves")
    values = values[:, :-1] * np.hanning(len(COMMANDS) - 1)
    frequency = np.fft.rfftfreq(values.shape[1], COMMANDS[1] - COMMANDS[0])
    power = np.abs(np.fft.rfft(values, axis=1)) ** 2
    bins = 3.0 / (STROKE[1] - STROKE[0])
    outside = (frequency < 1.0 / waves[1] - bins) | (frequency > 1.0 / waves[0] + bins)
    assert (power[:, outside].sum(axis=1) < 1e-3 * power.sum(axis=1)).all()


def test_length_maps_that_cannot_be_are_refused() -> None:
    with pytest.raises(ModelError, match="seed: must be a whole number, 0 or above"):
        strut_errors(-1)
    with pytest.raises(ModelError, match="strut error changes by"):  # so steep that no strut could follow
        strut_errors(0, rms=5e-3)
