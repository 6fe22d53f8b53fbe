"""Magnitudes that no machine's errors have: in a model file they are an error of units, or a fit gone astray."""

from __future__ import annotations

import math

import numpy as np

from ..errors import ModelError
from .field import COMPONENTS
from .model import LARGEST_DEVIATION, MachineModel

STRUT_LENGTH = 0.1
"""Largest error of a strut's length, m: an encoder's zero is found within a hand's breadth."""

EXPANSION = 1e-3
"""Largest expansion, 1/K: five times that of soft plastics."""

MOISTURE = 0.1
"""Largest growth from dry air to damp: three times that of nylon; carbon fibre in resin has some hundred ppm."""

ROTATION = 0.1
"""Largest rotation of a field, rad: its three rotations count as small. Displacements are as those of the joints."""

LOOKED_AT = 33
"""Points along each line of a field at which its polynomials are looked at."""


def check_magnitudes(model: MachineModel) -> None:
    """Check the sizes of a model's numbers."""
    for name in ("offset", "cosine", "sine", "backlash", "map_values", "map_backlash"):
        _check(f"struts.{name}", getattr(model.struts, name), STRUT_LENGTH, f"{STRUT_LENGTH * 1e3:g} mm")
    expansions = {f"thermal.{name}": getattr(model, name) for name in ("base_expansion", "platform_expansion")}
    expansions["thermal.late"] = model.late_growth.expansion
    for name, value in {"struts.expansion": model.struts.expansion, **expansions}.items():
        _check(name, np.asarray(value), EXPANSION, f"{EXPANSION * 1e6:g} ppm per K")
    _check("struts.moisture", model.struts.moisture, MOISTURE, f"{MOISTURE * 1e4:g} ppm per % of relative humidity")
    for axis, family in zip("xyz", model.field.lines, strict=True):
        for component, largest in zip(COMPONENTS, _largest(family), strict=True):
            length = component.startswith("d")
            allowed, unit = (LARGEST_DEVIATION, "mm") if length else (ROTATION, "mrad")
            _check(f"field.lines_{axis}.{component}", largest, allowed, f"{allowed * 1e3:g} {unit} along every line")


def _check(key: str, values: np.ndarray, allowed: float, bound: str) -> None:
    largest = float(np.abs(values).max(initial=0.0))
    if not largest <= allowed:
        raise ModelError(key, f"must stay within ±{bound}; is the unit right?", largest)


def _largest(family: np.ndarray) -> np.ndarray:
    """Return the largest magnitude of each component on any line of a family, shape (6,)."""
    largest = np.zeros(6)
    with np.errstate(over="ignore", invalid="ignore"):
        for u in np.linspace(-1.0, 1.0, LOOKED_AT):
            value = np.zeros(family.shape[:4])
            for power in reversed(range(family.shape[4])):
                value = value * u + family[..., power]
            largest = np.maximum(largest, np.nan_to_num(np.abs(value), nan=math.inf).max(axis=(0, 1, 2)))
    return largest
