"""Reads and writes machine models as YAML files; an entry that is invalid, unknown or incomplete is refused."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import date, datetime
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ..core import MOST_HARMONICS
from ..errors import ModelError
from ..formats.files import read_text
from ..formats.outputs import write_text
from ..formats.paths import input_file
from ..formats.schema import PER_STRUT, Numbers, Section, file_errors, in_unit
from ..formats.yaml import block_text, parse_yaml
from .field import COMPONENTS, CROSS_AXES, LARGEST, OUTSIDE_POLICIES, GridField, no_field
from .geometry import HexapodGeometry
from .load import MOST_LOADS, Load, Payload, check_gravity
from .model import Datum, MachineModel, ModelOrigin
from .outside import OutsideTable, outside_block, read_outside
from .region import Region
from .struts import WAVE_PARTS, StrutErrors
from .surroundings import load_row
from .temperatures import PARTS, LateGrowth
from .terms import check_magnitude, check_magnitudes, read_terms, table_text, write_terms

MODEL_FORMAT = "hexapod_comp/model"
MODEL_VERSION = 1
IDEAL = "ideal"  # Name of the model of a machine without errors, for :func:`load_model` and parameters
DIRECTIONS = ("forward", "backward")  # Order of the directions of motion in a field's arrays
# Keys of the delayed growth in a file, and the rows of `LateGrowth.expansion` that each key holds
LATE: dict[str, Any] = {"late_struts": slice(0, 6), "late_base": 6, "late_platform": 7}
WAVE, PERIOD, UM = Numbers("um", PER_STRUT), Numbers("mm", PER_STRUT, positive=True), Numbers("um")
CHECKED_POINTS = 33  # Points along each line of a field at which the polynomials' magnitude is checked
# Forms of ISO 8601 that every supported version of Python reads in the same way
ISO_8601 = re.compile(r"\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d(\.\d{3}(\d{3})?)?)?(Z|[+-]\d\d:\d\d)?)?")
SHA_256 = re.compile(r"[0-9a-f]{64}")
# Blocks that `text_sha256` leaves out: the file named in `posterior` contains the hash, and no fit changes `outside`
NOT_FITTED = re.compile(r"^(?:posterior|outside):\n(?:[ \t]+.*\n)*", re.MULTILINE)

# Key of one line among the field's lines along one axis: direction, node index on each of the two other axes
Line = tuple[int, int, int]


def load_model(path: str | Path, geometry: HexapodGeometry) -> MachineModel:
    """Read a model file; doc/model_file.md describes the format.

    Parameters
    ----------
    path : str or Path
        YAML file, or the name of a shipped model; ``ideal`` is the machine without errors.
    geometry : HexapodGeometry
        The machine that the model must belong to.

    Returns
    -------
    MachineModel

    Raises
    ------
    InputFileError
        The file cannot be used; the message names file, key, value and what is allowed.
    """
    if path == IDEAL:
        return MachineModel(geometry.name)
    file = input_file(path, "model")
    return parse_model(read_text(file), geometry.name, file)


def parse_model(text: str, machine: str, name: str | Path = "model") -> MachineModel:
    """Return the model that a model file's text describes, for this machine; error messages call the file `name`."""
    top = parse_yaml(text, name, MODEL_FORMAT, MODEL_VERSION)
    _refuse_cut_off(top)
    given = top.text("machine")
    if given != machine:
        raise top.error("machine", f"must be {machine!r}: the model is for another machine", given)
    with file_errors(top):
        origin = replace(_read_origin(top), text_sha256=text_sha256(text))
        values: dict[str, Any] = {"name": top.text("name"), "origin": origin}
        values |= {"region": _read_region(top)} | read_terms(MachineModel, top, "")
        blocks = {
            "structure": lambda section: read_terms(MachineModel, section, "structure"),
            "thermal": _read_thermal,
            "struts": _read_struts,
            "field": _read_field,
            "load": lambda section: {"load": Load(**read_terms(Load, section, "load"))},
            "outside": read_outside,
        }
        for key, read in blocks.items():
            if key in top:
                section = top.section(key)
                values |= read(section)
                section.finish()
        top.finish()
        model = MachineModel(machine, **values)
        check_possible(model)
    return model


def check_possible(model: MachineModel) -> None:
    """Raise ModelError if a term exceeds its largest allowed magnitude: such a model is neither written nor read."""
    for part in (model, model.struts, model.late_growth, model.load, model.outside):
        check_magnitudes(part)
    _check_lines(model.field)


def text_sha256(text: str) -> str:
    """Return the SHA-256 of a model file's text without the blocks `posterior` and `outside`."""
    return hashlib.sha256(NOT_FITTED.sub("", text).encode()).hexdigest()


def read_load(path: str | Path) -> Load:
    """Read a load file: format ``hexapod_comp/load``, with the keys of a model file's block ``load``."""
    file = input_file(path, "load")
    top = parse_yaml(read_text(file), file, "hexapod_comp/load", 1)
    with file_errors(top):
        load = Load(**read_terms(Load, top, "load"))
        check_magnitudes(load)
        if (load.lost_motion < 0.0).any():  # a model may have it, from noisy readings
            raise ModelError("load.lost_motion", "must not be negative", load.lost_motion.tolist())
    top.finish()
    return load


def save_model(model: MachineModel, path: str | Path) -> None:
    """Write a model file; if writing fails, an existing file stays unchanged.

    Parameters
    ----------
    model : MachineModel
        Machine model whose origin has a date.
    path : str or Path
        File to make or to replace.

    Raises
    ------
    ModelError
        The origin has an invalid date, file hash, posterior file name or residual, or a term exceeds its limit.
    InputFileError
        The file cannot be written.
    """
    write_text(path, model_text(model))


def model_text(model: MachineModel) -> str:
    """Return the text of a model file; equal models give equal texts."""
    origin, region = model.origin, model.region
    _check_origin(origin)
    check_possible(model)
    content: dict[str, Any] = {"format": MODEL_FORMAT, "version": MODEL_VERSION, "closed": True}
    content |= {"machine": model.machine, "name": model.name, "date": origin.date}
    content["sources"] = [{"file": name, "sha256": digest} for name, digest in origin.sources]
    if region is not None:
        content["region"] = write_terms(region, "region")
    if origin.held_out_residual is not None:
        content |= [UM.write("held_out_residual", origin.held_out_residual)]
    if origin.note:
        content["note"] = origin.note
    if origin.posterior is not None:
        content["posterior"] = dict(zip(("file", "sha256"), origin.posterior, strict=True))
    if origin.datum is not None:
        place, angles = in_unit(origin.datum.position, "mm"), in_unit(origin.datum.angles, "deg")
        content["datum"] = {"position_mm": place, "rotation_deg": angles, "held": origin.datum.held}
    if origin.loads:
        content["measured_loads"] = [
            {"mass_kg": row[0], "centre_mm": in_unit(row[1:4], "mm"), "gravity_m_s2": list(row[4:])}
            for row in origin.loads
        ]
    content |= write_terms(model, "", whole=True)
    blocks = {
        "structure": write_terms(model, "structure"),
        "struts": _struts_block(model.struts),
        "thermal": _thermal_block(model),
        "field": _field_block(model.field),
        "load": write_terms(model.load, "load"),
        "outside": outside_block(model.outside),
    }
    return block_text(content | {name: block for name, block in blocks.items() if block} | {"end": True})


def terms_text() -> str:
    """Return the table of all terms of a model for doc/model_file.md."""
    return table_text(MachineModel, StrutErrors, LateGrowth, Load, GridField, OutsideTable, Region)


# How the model was made


def _refuse_cut_off(top: Section) -> None:
    """Raise if a file is cut off: as every block is optional, a file without its last blocks could look complete."""
    marks = [key for key in ("closed", "end") if key in top]
    for key in marks:
        value = top.require(key)
        if value is not True:
            raise top.error(key, "must be true; a file has both `closed` and `end`, or neither", value)
    if marks == ["closed"]:
        raise top.error("end", "is missing: the file is cut off, or still being written")
    if marks == ["end"]:
        raise top.error("closed", "is missing at the beginning of the file: a file with `end` needs it")


def _read_origin(top: Section) -> ModelOrigin:
    given = top.require("date")
    if isinstance(given, date):  # YAML reads an unquoted date as a date object
        given = given.isoformat()
    sources = []
    for entry in top.sections("sources"):
        sources.append((entry.text("file"), entry.require("sha256")))
        entry.finish()
    residual = UM.read(top, "held_out_residual", None)
    note, posterior, datum = top.text("note") if "note" in top else "", None, None
    if "posterior" in top:
        section = top.section("posterior")
        posterior = section.text("file"), section.require("sha256")
        section.finish()
    if "datum" in top:
        section = top.section("datum")
        position = section.quantity("position", "length", (3,))
        angles = section.quantity("rotation", "angle", (3,), np.zeros(3))
        datum = Datum(tuple(position.tolist()), tuple(angles.tolist()), section.require("held"))
        section.finish()
    loads = []
    for entry in top.sections("measured_loads") if "measured_loads" in top else ():
        parts = entry.quantity("mass", "mass"), entry.quantity("centre", "length", (3,))
        try:
            payload = Payload(float(parts[0]), tuple(parts[1].tolist()))
            gravity = check_gravity("gravity", entry.quantity("gravity", "acceleration", (3,)))
        except ModelError as error:
            raise entry.error(error.key, error.problem, error.value) from error
        loads.append(load_row(payload, gravity))
        entry.finish()
    if len(loads) > MOST_LOADS:
        raise top.error("measured_loads", f"must have at most {MOST_LOADS} entries", len(loads))
    origin = ModelOrigin(given, tuple(sources), residual, note, posterior, datum, tuple(loads))
    _check_origin(origin)
    return origin


def _check_origin(origin: ModelOrigin) -> None:
    try:
        if not ISO_8601.fullmatch(origin.date):
            raise ValueError
        datetime.fromisoformat(origin.date.replace("Z", "+00:00"))
    except (TypeError, ValueError) as error:
        raise ModelError("date", "must be ISO 8601, like 2026-01-31", origin.date) from error
    hashes = {f"sources[{index}]": source for index, source in enumerate(origin.sources)}
    if origin.posterior is not None:
        hashes["posterior"] = origin.posterior
        if Path(origin.posterior[0]).name != origin.posterior[0]:
            raise ModelError("posterior.file", "must be a file name without a folder", origin.posterior[0])
    for key, (name, digest) in hashes.items():
        if not (isinstance(digest, str) and SHA_256.fullmatch(digest)):
            problem = f"must be the 64 lower-case hexadecimal digits of the SHA-256 of {name!r}"
            raise ModelError(f"{key}.sha256", problem, digest)
    residual = origin.held_out_residual
    if residual is not None and not (math.isfinite(residual) and residual >= 0.0):
        raise ModelError("held_out_residual", "must be finite and not negative", residual)


def _read_region(top: Section) -> Region | None:
    """Return the measured box, or None; older files have ``valid_box``, a box of platform positions in ``base``."""
    if top.quantity_key("valid_box", "length"):
        box = top.quantity("valid_box", "length", (2, 3))
        if "region" in top:
            raise top.error("region", "must not be given together with valid_box")
        try:
            return Region(box)
        except ModelError as error:
            raise top.error("valid_box", error.problem, error.value) from error
    if "region" not in top:
        return None
    section = top.section("region")
    region = Region(**read_terms(Region, section, "region"))
    section.finish()
    return region


# Thermal, struts


def _read_thermal(section: Section) -> dict[str, Any]:
    thermometer = section.choice("thermometer", PARTS) if "thermometer" in section else ""
    constants = section.quantity("time_constants", "time", (None,), ())
    late = np.zeros((len(PARTS), len(constants)))
    for name, part in LATE.items():
        none = np.zeros_like(late[part])
        late[part] = section.quantity(name, "expansion", none.shape, none)
    growth = LateGrowth(tuple(constants.tolist()), late, thermometer)
    return read_terms(MachineModel, section, "thermal") | {"late_growth": growth}


def _thermal_block(model: MachineModel) -> dict[str, Any]:
    block, growth = write_terms(model, "thermal"), model.late_growth
    if growth.thermometer:
        block["thermometer"] = growth.thermometer
    if growth.time_constants:
        block["time_constants_s"] = list(growth.time_constants)
        late = {name: growth.expansion[part] for name, part in LATE.items()}
        block |= {f"{name}_ppm_per_K": in_unit(rows, "ppm_per_K") for name, rows in late.items() if rows.any()}
    return block


def _read_struts(section: Section) -> dict[str, Any]:
    values = read_terms(StrutErrors, section, "struts")
    if "wave" in section:
        values |= _read_wave(section.section("wave"))
    if "map" in section:
        length_map = section.section("map")
        for key in ("knots", "values"):
            if length_map.quantity_key(key, "length") is None:
                length_map.quantity(key, "length")  # raises if the key is missing
        values |= read_terms(StrutErrors, length_map, "struts.map")
        length_map.finish()
    return {"struts": StrutErrors(**values)}


def _read_wave(section: Section) -> dict[str, np.ndarray]:
    """Return the wave's amplitudes, shape (6, harmonics), and periods, shape (6,), m."""

    def amplitudes(one: Section) -> np.ndarray:
        return np.array([WAVE.read(one, name, np.zeros(6)) for name in WAVE_PARTS])

    waves = {1: amplitudes(section)}
    period = PERIOD.read_value(section, "period")
    for harmonic in section.sections("harmonics") if "harmonics" in section else ():
        times = harmonic.require("times")
        if type(times) is not int or not 2 <= times <= MOST_HARMONICS:
            raise harmonic.error("times", f"must be a whole number, 2…{MOST_HARMONICS}", times)
        if times in waves:
            raise harmonic.error("times", "is given twice", times)
        waves[times] = amplitudes(harmonic)
        harmonic.finish()
    section.finish()
    every = np.stack([waves.get(n, np.zeros((2, 6))) for n in range(1, max(waves) + 1)], axis=2)
    return {"cosine": every[0], "sine": every[1], "period": period}


def _struts_block(struts: StrutErrors) -> dict[str, Any]:
    block = write_terms(struts, "struts")
    if struts.cosine.any() or struts.sine.any() or (struts.period != StrutErrors().period).any():

        def amplitudes(column: int) -> dict[str, Any]:
            return dict(WAVE.write(name, getattr(struts, name)[:, column]) for name in WAVE_PARTS)

        block["wave"] = {**amplitudes(0), **dict([PERIOD.write("period", struts.period)])}
        columns = range(1, len(struts.harmonics))
        used = [k for k in columns if struts.cosine[:, k].any() or struts.sine[:, k].any()]
        if used:
            block["wave"]["harmonics"] = [{"times": k + 1, **amplitudes(k)} for k in used]
    if len(struts.map_knots):
        block["map"] = write_terms(struts, "struts.map", whole=True)
        if not struts.map_backlash.any():
            del block["map"]["backlash_um"]
    return block


# Field


def _component(name: str) -> Numbers:
    """Return unit and shape, in a file, of the polynomial of an error component such as ``dx``."""
    return Numbers("um" if name.startswith("d") else "urad", (None,))


def _read_field(section: Section) -> dict[str, Any]:
    grid = tuple(section.quantity(f"grid_{axis}", "length", (None,)) for axis in "xyz")
    values = read_terms(GridField, section, "field")
    outside = section.choice("outside", OUTSIDE_POLICIES, "hold")
    families: dict[str, dict[Line, np.ndarray]] = {axis: {} for axis in "xyz"}
    for entry in section.sections("lines"):
        _read_line(entry, grid, families)
    lines = tuple(_family_array(section, axis, families[axis], [len(nodes) for nodes in grid]) for axis in "xyz")
    return {"field": GridField(grid, lines, outside=outside, **values)}  # type: ignore[arg-type]


def _read_line(entry: Section, grid: tuple[np.ndarray, ...], families: dict[str, dict[Line, np.ndarray]]) -> None:
    """Read an entry of ``lines``; store its coefficients, for one or both directions of motion, in `families`."""
    axis = entry.choice("axis", ("x", "y", "z"))
    counts = [len(grid[other]) for other in CROSS_AXES["xyz".index(axis)]]
    nodes = entry.require("at")
    if not (
        isinstance(nodes, list)
        and len(nodes) == 2
        and all(type(node) is int and 0 <= node < count for node, count in zip(nodes, counts, strict=True))
    ):
        raise entry.error("at", f"must be two node indices within 0…{counts[0] - 1} and 0…{counts[1] - 1}", nodes)
    direction = entry.choice("direction", (*DIRECTIONS, "both"))
    rows = [_component(name).read(entry, name, ()) for name in COMPONENTS]
    entry.finish()
    coefficients = np.zeros((6, max(len(row) for row in rows)))
    for component, row in enumerate(rows):
        coefficients[component, : len(row)] = row
    for index, name in enumerate(DIRECTIONS):
        if direction in (name, "both"):
            line = index, nodes[0], nodes[1]
            if line in families[axis]:
                raise entry.error("at", f"the {name} line along {axis} through these nodes is given twice", nodes)
            families[axis][line] = coefficients


def _family_array(section: Section, axis: str, family: dict[Line, np.ndarray], counts: list[int]) -> np.ndarray:
    """Return the coefficients of the error polynomials on all lines along an axis, (2, n, m, 6, K), by direction of
    motion, node on each of the two other axes, error component, and power; K = 0 if there are no lines.
    """
    first, second = (counts[other] for other in CROSS_AXES["xyz".index(axis)])
    if not family:
        return np.zeros((2, first, second, 6, 0))
    every = product(range(2), range(first), range(second))
    missing = next((line for line in every if line not in family), None)
    if missing is not None:  # checked before the array is allocated: a file could give huge node counts
        direction, *nodes = missing
        raise section.error("lines", f"the {DIRECTIONS[direction]} line along {axis} at {nodes} is missing")
    powers = max(coefficients.shape[1] for coefficients in family.values())
    array = np.zeros((2, first, second, 6, powers))
    for line, coefficients in family.items():
        array[line][:, : coefficients.shape[1]] = coefficients
    return array


def _field_block(field: GridField) -> dict[str, Any]:
    def content(field: GridField) -> dict[str, Any]:
        grid = {f"grid_{axis}_mm": in_unit(nodes, "mm") for axis, nodes in zip("xyz", field.grid, strict=True)}
        families = zip("xyz", field.lines, strict=True)
        lines = [line for axis, family in families for line in _family_lines(axis, family)]
        return grid | write_terms(field, "field", whole=True) | {"outside": field.outside, "lines": lines}

    block = content(field)
    return {} if block == content(no_field()) else block


def _family_lines(axis: str, family: np.ndarray) -> Iterator[dict[str, Any]]:
    """Yield the file entries of the lines along an axis, each with every component that a line of this axis has."""
    if not family.shape[4]:
        return
    components = np.flatnonzero(family.any(axis=(0, 1, 2, 4))).tolist() or ["xyz".index(axis)]
    for first, second in np.ndindex(family.shape[1:3]):
        forward, backward = family[:, first, second]
        given = {"both": forward}
        if not np.array_equal(forward, backward):
            given = dict(zip(DIRECTIONS, (forward, backward), strict=True))
        for direction, line in given.items():
            rows = dict(_component(COMPONENTS[k]).write(COMPONENTS[k], line[k]) for k in components)
            yield {"axis": axis, "at": [first, second], "direction": direction, **rows}


def _check_lines(field: GridField) -> None:
    """Raise ModelError if an error component exceeds its limit in `LARGEST` on one of the field's lines."""
    for axis, family in zip("xyz", field.lines, strict=True):
        largest = np.zeros(6)
        with np.errstate(over="ignore", invalid="ignore"):
            for u in np.linspace(-1.0, 1.0, CHECKED_POINTS):
                value = np.zeros(family.shape[:4])
                for power in reversed(range(family.shape[4])):
                    value = value * u + family[..., power]
                largest = np.maximum(largest, np.nan_to_num(np.abs(value), nan=math.inf).max(axis=(0, 1, 2)))
        for component, found, allowed in zip(COMPONENTS, largest, LARGEST, strict=True):
            unit = "mm" if component.startswith("d") else "mrad"
            check_magnitude(
                f"field.lines_{axis}.{component}", found, allowed, f"{allowed * 1e3:g} {unit} along every line"
            )
