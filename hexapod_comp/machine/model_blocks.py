"""The blocks of a model file as they are written: a model's arrays as nested lists, in the file's units."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..formats.schema import in_unit
from .field import COMPONENTS, GridField, no_field
from .model import Datum, MachineModel
from .region import Region
from .struts import WAVE_PARTS, StrutErrors

DIRECTIONS = ("forward", "backward")
"""Order of the directions of motion in a field's arrays."""

STRUT_TERMS = {
    "offset": ("length", "um"),
    "pitch": ("ratio", "ppm"),
    "reference_length": ("length", "mm"),
    "backlash": ("length", "um"),
    "expansion": ("expansion", "ppm_per_K"),
    "moisture": ("moisture", "ppm_per_percent"),
}
"""Per-strut terms: kind of quantity, and the unit in which they are written."""

LATE_PARTS = ("late_struts", "late_base", "late_platform")
"""What follows a thermometer late, in the order of the rows of :class:`~.temperatures.LateGrowth`."""

COMPONENT_UNITS = {name: ("length", "um") if name[0] == "d" else ("angle", "urad") for name in COMPONENTS}


def written(values: Any, kind: str, unit: str) -> Any:
    """Return SI values in a unit, as nested lists of floats that read back to the same values."""
    return in_unit(values, unit)


def _per_strut(values: np.ndarray, kind: str, unit: str) -> Any:
    """Return one number where all six are equal, else the six."""
    return written(values[0] if (values == values[0]).all() else values, kind, unit)


def datum_block(datum: Datum) -> dict[str, Any]:
    """Return where the tool is not moved."""
    position, angles = written(datum.position, "length", "mm"), written(datum.angles, "angle", "deg")
    return {"position_mm": position, "rotation_deg": angles, "held": datum.held}


def region_block(region: Region) -> dict[str, Any]:
    """Return where a model was measured; what is zero is left out."""
    block = {"box_mm": written(region.box, "length", "mm")}
    parts = {"point_mm": ("length", region.point), "position_mm": ("length", region.position)}
    parts["rotation_deg"] = "angle", region.angles
    return block | {key: written(v, kind, key[key.index("_") + 1 :]) for key, (kind, v) in parts.items() if v.any()}


def structure_block(model: MachineModel) -> dict[str, Any]:
    """Return where the real joints are, µm, and how far the base's axes are turned, µrad."""
    given = {"base_deviation": model.base_deviation, "platform_deviation": model.platform_deviation}
    block = {f"{name}_um": written(values, "length", "um") for name, values in given.items() if values.any()}
    if model.base_axes_turn.any():
        block["base_axes_turn_urad"] = written(model.base_axes_turn, "angle", "urad")
    return block


def thermal_block(model: MachineModel) -> dict[str, Any]:
    """Return how much the two bodies grow, ppm/K, and how parts follow their thermometers."""
    given = {"base_expansion": model.base_expansion, "platform_expansion": model.platform_expansion}
    unit, late_growth = "ppm_per_K", model.late_growth
    block = {f"{name}_{unit}": written(value, "expansion", unit) for name, value in given.items() if value}
    if late_growth.thermometer:
        block["thermometer"] = late_growth.thermometer
    if late_growth.time_constants:
        block["time_constants_s"] = list(late_growth.time_constants)
        rows = dict(zip(LATE_PARTS, (late_growth.expansion[:6], *late_growth.expansion[6:]), strict=True))
        block |= {f"{name}_{unit}": written(row, "expansion", unit) for name, row in rows.items() if row.any()}
    return block


def struts_block(struts: StrutErrors) -> dict[str, Any]:
    """Return the struts' own errors, those that are not zero."""
    block = {}
    for name, (kind, unit) in STRUT_TERMS.items():
        if getattr(struts, name).any():
            block[f"{name}_{unit}"] = _per_strut(getattr(struts, name), kind, unit)
    if struts.cosine.any() or struts.sine.any() or (struts.period != StrutErrors().period).any():
        block["wave"] = _wave_block(struts)
    if len(struts.map_knots):
        knots = written(struts.map_knots, "length", "mm")
        block["map"] = {"knots_mm": knots, "values_um": written(struts.map_values, "length", "um")}
        if struts.map_backlash.any():
            block["map"]["backlash_um"] = written(struts.map_backlash, "length", "um")
    return block


def _wave_block(struts: StrutErrors) -> dict[str, Any]:
    """Return the screw waves: the first harmonic, the period, and the others that are not zero."""

    def amplitudes(column: int) -> dict[str, Any]:
        return {f"{name}_um": _per_strut(getattr(struts, name)[:, column], "length", "um") for name in WAVE_PARTS}

    block = {**amplitudes(0), "period_mm": _per_strut(struts.period, "length", "mm")}
    columns = range(1, len(struts.harmonics))
    used = [k for k in columns if struts.cosine[:, k].any() or struts.sine[:, k].any()]
    if used:
        block["harmonics"] = [{"times": k + 1, **amplitudes(k)} for k in used]
    return block


def field_block(field: GridField) -> dict[str, Any]:
    """Return the field, empty where leaving it out brings the same one back."""
    if _is_no_field(field):
        return {}
    block: dict[str, Any] = {}
    for axis, nodes in zip("xyz", field.grid, strict=True):
        block[f"grid_{axis}_mm"] = written(nodes, "length", "mm")
    block["probe_mm"] = written(field.probe, "length", "mm")
    block["reversal_threshold_um"] = written(field.reversal_threshold, "length", "um")
    block["outside"] = field.outside
    block["lines"] = [
        line for axis, family in zip("xyz", field.lines, strict=True) for line in _family_lines(axis, family)
    ]
    return block


def _is_no_field(field: GridField) -> bool:
    """Return whether leaving the block out brings the same field back."""
    nothing = no_field()
    return (
        not any(family.shape[4] for family in field.lines)
        and all(np.array_equal(ours, theirs) for ours, theirs in zip(field.grid, nothing.grid, strict=True))
        and not field.probe.any()
        and field.outside == nothing.outside
        and field.reversal_threshold == nothing.reversal_threshold
    )


def _family_lines(axis: str, family: np.ndarray) -> Iterator[dict[str, Any]]:
    """Yield the family's lines, each with the components that any line of the family has.

    Rows keep their full number of powers, and a family of zeros keeps one component, so that reading
    brings back the same shape.
    """
    if not family.shape[4]:
        return
    used = np.flatnonzero(family.any(axis=(0, 1, 2, 4)))
    components = used.tolist() or ["xyz".index(axis)]
    for first, second in np.ndindex(family.shape[1:3]):
        forward, backward = family[:, first, second]
        given = {"both": forward}
        if not np.array_equal(forward, backward):
            given = dict(zip(DIRECTIONS, (forward, backward), strict=True))
        for direction, line in given.items():
            rows = _component_rows(line, components)
            yield {"axis": axis, "at": [first, second], "direction": direction, **rows}


def _component_rows(line: np.ndarray, components: list[int]) -> dict[str, Any]:
    rows = {}
    for component in components:
        name = COMPONENTS[component]
        kind, unit = COMPONENT_UNITS[name]
        rows[f"{name}_{unit}"] = written(line[component], kind, unit)
    return rows
