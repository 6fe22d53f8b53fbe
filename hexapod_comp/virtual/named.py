"""Models by name: a file, ``ideal``, or ``random:SEED`` for a virtual machine with random errors.

All verbs and simulated machines load models, and the true errors of virtual machines, through :func:`find_model`.
"""

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

RANDOM = "random"  # A machine drawn with :data:`USUAL` bounds and seed 1; ``random:7`` has seed 7
RANDOM_SEED = 1
# Shipped file of a machine's hidden errors, by the machine's name; the errors of all other machines are drawn
SHIPPED_TRUTH = {"paper": "paper_machine.yaml"}
USUAL: dict[str, Any] = {
    "joint": 50e-6,
    "strut_offset": 50e-6,
    "pitch": 50e-6,
    "wave": (1e-6, 3e-6),
    "backlash": (2e-6, 4e-6),
    "length_map": 1e-6,
}
"""Typical bounds for a carefully built machine that has not been calibrated, m and m per m."""


def usual_bounds(geometry: HexapodGeometry, **given: Any) -> ImperfectionBounds:
    """Return the :data:`USUAL` bounds for a machine; bounds that are given replace the usual ones."""
    leads = np.abs(geometry.screw_lead)
    usual = {**USUAL, "wave_period": float(leads.max()) if leads.any() else USUAL_LEAD}
    return ImperfectionBounds(**{**usual, **given})


def imagine(
    geometry: HexapodGeometry, seed: int, bounds: ImperfectionBounds | None = None, name: str = ""
) -> MachineModel:
    """Draw a virtual machine's hidden errors. The model's date is today, since a model file requires a date."""
    model = draw_model(geometry, usual_bounds(geometry) if bounds is None else bounds, seed, name)
    return replace(model, origin=replace(model.origin, date=date.today().isoformat()))


def truth_name(name: str | None, geometry: HexapodGeometry) -> str:
    """Return the name of the true errors: `name` if given, else the shipped file of this machine, else ``random``."""
    return SHIPPED_TRUTH.get(geometry.name, RANDOM) if name is None else name


def find_model(name: str | Path, geometry: HexapodGeometry) -> MachineModel:
    """Return the model of a file, of a shipped file, of ``ideal`` or of ``random:SEED``."""
    if not is_random(name):
        return load_model(name, geometry)
    _, colon, seed = str(name).partition(":")
    if colon and not re.fullmatch("[0-9]{1,12}", seed):
        raise ModelError(str(name), "must be random:SEED with a whole number, 0 or above, as random:7")
    return imagine(geometry, int(seed) if colon else RANDOM_SEED)


def is_random(name: str | Path) -> bool:
    """Return whether a name is ``random`` or ``random:SEED``."""
    return str(name).partition(":")[0] == RANDOM


def is_word(name: str | Path) -> bool:
    """Return whether a name is ``ideal``, ``random`` or ``random:SEED``, not a file."""
    return name == IDEAL or is_random(name)
