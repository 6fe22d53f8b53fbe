"""A term that an export does not know is refused. Truth: fields added here, of which no exporter can know anything."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import pytest
from strategies import paper_geometry, random_model

from hexapod_comp.errors import ModelError
from hexapod_comp.export.c_code import model_header
from hexapod_comp.export.carried import CARRIED, PROVENANCE, refuse_unknown
from hexapod_comp.export.linuxcnc import make_genhexkins
from hexapod_comp.export.table import make_table
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors

PAPER = paper_geometry()
BOX = np.array([[-0.02, -0.02, 0.40], [0.02, 0.02, 0.42]])


@dataclass(frozen=True)
class ModelWithSag(MachineModel):
    sag: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class StrutsWithWind(StrutErrors):
    wind: np.ndarray = field(default_factory=lambda: np.zeros(6))


def linuxcnc(model: MachineModel) -> object:
    return make_genhexkins(RealMachine(PAPER, model), BOX)


def table(model: MachineModel) -> object:
    return make_table(PAPER, model, BOX, 0.02)


def c_core(model: MachineModel) -> object:
    return model_header(PAPER, model, ("", ""))


EXPORTERS = pytest.mark.parametrize("export", [linuxcnc, table, c_core])


def widened(model: MachineModel, kind: type, **more: Any) -> Any:
    return kind(**{entry.name: getattr(model, entry.name) for entry in fields(MachineModel)} | more)


@EXPORTERS
def test_an_unknown_term_is_refused_and_zero_passes(export: Callable[[MachineModel], object]):
    known = random_model(np.random.default_rng(1), "paper")
    assert export(widened(known, ModelWithSag))
    with pytest.raises(ModelError, match=r"^sag: cannot be exported: .* does not know it.*\[0\.0, 0\.0, 1e-06\]"):
        export(widened(known, ModelWithSag, sag=np.array([0.0, 0.0, 1e-6])))


@EXPORTERS
def test_an_unknown_term_of_a_block_is_refused(export: Callable[[MachineModel], object]):
    assert export(MachineModel("paper", struts=StrutsWithWind()))
    with pytest.raises(ModelError, match=r"^struts\.wind: .*1e-09"):
        export(MachineModel("paper", struts=StrutsWithWind(wind=np.full(6, 1e-9))))


def test_the_lists_hold_todays_terms_and_no_others():
    """Who adds a field decides here, for each export."""
    blocks = {
        "struts": StrutErrors,
        "field": type(MachineModel("m").field),
        "late_growth": type(MachineModel("m").late_growth),
        "load": Load,
    }
    today = {
        name
        for entry in fields(MachineModel)
        if entry.name not in PROVENANCE
        for name in (
            [f"{entry.name}.{one.name}" for one in fields(blocks[entry.name])] if entry.name in blocks else [entry.name]
        )
    }
    assert today - CARRIED == {"outside"}  # no controller is told the numbers that it needs
    assert today >= CARRIED


def test_genhexkins_has_no_term_for_a_load():
    """The table and the C core carry it."""
    model = MachineModel("paper", load=Load(stiffness=np.full(6, 20e6), mass=30.0))
    refuse_unknown(model, "the C core")
    with pytest.raises(ModelError, match=r"^load\.stiffness: cannot be exported: genhexkins does not know it"):
        refuse_unknown(model, "genhexkins", without="load.")
