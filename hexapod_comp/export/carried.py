"""Which terms of a model an export knows: one that it does not know is refused, never dropped in silence.

Every exporter names the terms that it carries or reports as not carried. A term that somebody adds to the model is in
none of these lists, so a model that has it is refused until the exporter's author has decided.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..errors import ModelError
from ..machine.model import MachineModel

PROVENANCE = ("machine", "name", "origin", "region")  # Fields that move no tool
CARRIED = frozenset(
    {
        *("base_deviation", "platform_deviation", "base_axes_turn", "reversal_threshold"),
        *(f"struts.{name}" for name in ("offset", "pitch", "reference_length", "cosine", "sine", "period", "backlash")),
        *(f"struts.{name}" for name in ("map_knots", "map_values", "map_backlash", "expansion", "moisture")),
        *(f"field.{name}" for name in ("grid", "lines", "probe", "outside", "reversal_threshold")),
        *("base_expansion", "platform_expansion"),
        *(f"late_growth.{name}" for name in ("time_constants", "expansion", "thermometer")),
        *(f"load.{name}" for name in ("stiffness", "lost_motion", "friction", "take_up", "mass", "centre", "gravity")),
    }
)
"""What the C core holds. LinuxCNC's files and the table hold it or report it: field or tilt, growth, swelling."""


def refuse_unknown(model: MachineModel, export: str, without: str = "-") -> None:
    """Refuse a model with a term that an export does not know, or with one whose name begins with `without`."""
    for name, value in terms(model):
        if name not in CARRIED or name.startswith(without):
            problem = f"cannot be exported: {export} does not know it. Leave it out, or let the compensator run it"
            raise ModelError(name, problem, np.asarray(value).tolist())


def terms(model: MachineModel) -> Iterator[tuple[str, Any]]:
    """Yield the terms in which a model differs from an ideal machine, with their values: ``struts.pitch``, …"""
    for name, value in _differences(model, MachineModel(model.machine)):
        if name.partition(".")[0] not in PROVENANCE:
            yield name, value


def _differences(value: Any, ideal: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if not dataclasses.is_dataclass(value):
        if not _same(value, ideal):
            yield path, value
        return
    for entry in dataclasses.fields(value):
        made = entry.default if entry.default_factory is dataclasses.MISSING else entry.default_factory()
        here = f"{path}.{entry.name}" if path else entry.name
        yield from _differences(getattr(value, entry.name), getattr(ideal, entry.name, made), here)


def _same(value: Any, ideal: Any) -> bool:
    if isinstance(value, tuple) and isinstance(ideal, tuple):
        return len(value) == len(ideal) and all(map(_same, value, ideal))
    return np.array_equal(value, ideal)
