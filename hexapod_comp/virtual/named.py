"""Models by name: a file, ``ideal``, or ``random:SEED`` for a virtual machine with random errors."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ModelError
from ..machine.geometry import USUAL_LEAD, HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import IDEAL, load_model
from .imperfections import ImperfectionBounds, draw_model

RANDOM = "random"  # drawn with the bounds :data:`USUAL`; ``random:7`` with seed 7
RANDOM_SEED = 1  # seed of ``random`` without a number
# Shipped files of true errors by machine; all other machines get random errors
SHIPPED_TRUTH = {"paper": "paper_machine.yaml"}
USUAL: dict[str, Any] = {
    "joint": 50e-6,
    "strut_offset": 50e-6,
    "pitch": 50e-6,
    "wave": (1e-6, 3e-6),
    "backlash": (2e-6, 4e-6),
    "length_map": 1e-6,
}
"""Typical bounds of an uncalibrated machine that was built carefully; pitch in m per m, all others in m."""


def usual_bounds(geometry: HexapodGeometry, **given: Any) -> ImperfectionBounds:
    """Return :data:`USUAL` with the `given` bounds in place of the usual ones."""
    leads = np.abs(geometry.screw_lead)
    usual = {**USUAL, "wave_period": float(leads.max()) if leads.any() else USUAL_LEAD}
    return ImperfectionBounds(**{**usual, **given})


def imagine(
    geometry: HexapodGeometry, seed: int, bounds: ImperfectionBounds | None = None, name: str = ""
) -> MachineModel:
    """Return random hidden errors of a virtual machine as a model with today's date (a model file needs a date)."""
    model = draw_model(geometry, usual_bounds(geometry) if bounds is None else bounds, seed, name)
    return replace(model, origin=replace(model.origin, date=date.today().isoformat()))


def truth_name(name: str | None, geometry: HexapodGeometry) -> str:
    """Return `name` if given; else the shipped file of this machine's true errors or, without a file, ``random``."""
    return SHIPPED_TRUTH.get(geometry.name, RANDOM) if name is None else name


def find_model(name: str | Path, geometry: HexapodGeometry) -> MachineModel:
    """Return the model that a path, the name of a shipped file, ``ideal`` or ``random:SEED`` names."""
    if not is_random(name):
        return load_model(name, geometry)
    _, colon, seed = str(name).partition(":")
    if colon and not re.fullmatch("[0-9]{1,12}", seed):
        raise ModelError(str(name), "must be random:SEED with a whole number, 0 or above, as random:7")
    return imagine(geometry, int(seed) if colon else RANDOM_SEED)


def is_random(name: str | Path) -> bool:
    return str(name).partition(":")[0] == RANDOM


def is_word(name: str | Path) -> bool:
    """Whether a name is ``ideal``, ``random`` or ``random:SEED``, not a file."""
    return name == IDEAL or is_random(name)
