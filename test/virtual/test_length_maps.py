"""Length maps drawn as waves, evaluated by the core on a machine."""

from __future__ import annotations

import numpy as np
import pytest
from strategies import paper_geometry

from hexapod_comp.core import batch
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.virtual.imperfections import with_length_map

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
