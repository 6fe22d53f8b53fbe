"""Model files: the machine model as YAML, readable by people, refused when anything in it is in doubt.

Keys end in their unit, as in geometry files (:data:`hexapod_comp.formats.schema.UNITS`); below stand the units that
:func:`save_model` writes, reading takes any unit of the same kind. A value *per strut* is one number for
all six or a list of six. Everything marked optional may be left out and is then zero or as stated::

    format: hexapod_comp/model
    version: 1
    closed: true                      # optional: the last key is `end`; without it the file is refused as cut off
    machine: paper                    # must be the geometry file's `machine`
    name: after the crash             # shown in diagnostics
    date: '2026-01-31'                # ISO 8601, date or date and time
    sources:                          # every file that it was fitted to; [] for none
    - file: laser_x.csv
      sha256: 64 lower-case hexadecimal digits
    region:                           # optional: where it was measured; by default where its field is
      box_mm: [[-200, -200, 350], [200, 200, 550]]  # lowest, highest place of the measured point
      point_mm: [0, 0, 0]             # optional: that point, in platform; its origin
      position_mm: [0, 0, 0]          # optional: origin and axes of the box in base, as α, β, γ
      rotation_deg: [0, 0, 0]
                                      # in place of it, `valid_box_mm`: lowest, highest platform position in base
    held_out_residual_um: 4.2         # optional: RMS tool error left on data not used for the fit
    note: one line for people         # optional
    posterior:                        # optional: how well the fit knows its parameters, in a file beside this one
      file: crash.posterior.npz
      sha256: 64 lower-case hexadecimal digits
    datum:                            # optional: where the tool stays, as readings did not see where the machine stands
      position_mm: [0, 0, 450]        # platform in base
      rotation_deg: [0, 0, 0]         # α, β, γ; optional
      held: 6                         # of the six ways to shift and turn the whole machine; 0: the readings saw all
    reversal_threshold_um: 0.2        # optional (0.2): way back until a strut's direction counts as reversed

    structure:                        # optional: real − nominal joint position
      base_deviation_um:              # optional, 6×3, in base
      platform_deviation_um:          # optional, 6×3, in platform
      base_axes_turn_urad: [0, 0, 0]  # optional: rotation vector of the base's cardan axes, turned with the whole base

    struts:                           # optional; L = (1 + g)(c + errors), see hexapod_comp.machine.struts
      offset_um: 0.0                  # each of these optional and per strut
      pitch_ppm: 0.0
      reference_length_mm: 0.0        # command at which the pitch error is zero
      backlash_um: 0.0                # lost motion on reversal
      expansion_ppm_per_K: 0.0
      moisture_ppm_per_percent: 0.0   # growth by relative humidity above 50 %: struts of carbon fibre
      wave:                           # optional: cosine·cos(2πc/period) + sine·sin(2πc/period), per strut
        cosine_um: 0.0
        sine_um: 0.0
        period_mm: 5.0                # required in this block: one turn of the screw
        harmonics:                    # optional: the same several times a turn
        - times: 2                    # 2, 3 or 4, each once
          cosine_um: 0.0
          sine_um: 0.0
      map:                            # optional: natural cubic spline, end values held outside
        knots_mm: [330, 600, 880]     # commands, increasing
        values_um:                    # 6×n, one row per strut
        backlash_um:                  # optional, 6×n: by how much the lost motion is larger there than backlash_um

    thermal:                          # optional: bodies about their origins
      base_expansion_ppm_per_K: 0.0
      platform_expansion_ppm_per_K: 0.0
      thermometer: base               # optional: this part's sensor stands for all; else each part has its own
      time_constants_s: [1800, 7200]  # optional: how late parts follow, one or two, see machine.temperatures
      late_struts_ppm_per_K:          # optional, 6 × time constants: what of a strut's growth comes so late
      late_base_ppm_per_K: [0, 0]     # optional: the same of the base, and of the platform
      late_platform_ppm_per_K: [0, 0]

    field:                            # optional: interpolated error of the measured point, in base
      grid_x_mm: [-200, 0, 200]       # increasing nodes; the outermost bound the measured box
      grid_y_mm: [-200, 0, 200]
      grid_z_mm: [350, 450, 550]
      probe_mm: [0, 0, 0]             # optional: the measured point in platform
      reversal_threshold_um: 10.0     # optional (10): way back until an axis' direction counts as reversed
      outside: hold                   # optional: hold or refuse
      lines:                          # [] for none
      - axis: x                       # the line runs along this axis …
        at: [0, 2]                    # … through these nodes of the other two (in the order x, y, z), from 0
        direction: forward            # of motion along the axis: forward, backward or both
        dx_um: [0.1, -3.0, 0.4]       # polynomial: constant, u, u², … with u from −1 to 1 over the box
        rz_urad: [5.0]                # dx dy dz (lengths), rx ry rz (angles); one left out is zero

    end: true                         # of a closed file: everything above has arrived

What no machine has is refused as an error of units: joints more than 50 mm away, strut lengths more than 100 mm wrong,
expansions above 1000 ppm/K or 1000 ppm per % of humidity; a field of more than 50 mm or 100 mrad anywhere on one of
its lines.

A family of lines (all along one axis) is whole or absent: every pair of nodes in both directions.

Numbers are written with as many digits as bring back the very same float where the unit's factor allows
it, and to one rounding (relative 2e-16) elsewhere; what was read from a file is written back unchanged.
"""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import replace
from datetime import date, datetime
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ..core import MOST_HARMONICS
from ..errors import InputFileError, ModelError
from ..formats.files import read_text
from ..formats.outputs import write_text
from ..formats.paths import input_file
from ..formats.schema import Section
from ..formats.yaml import block_text, parse_yaml
from .field import CROSS_AXES, OUTSIDE_POLICIES, GridField, no_field
from .geometry import HexapodGeometry
from .magnitudes import check_magnitudes
from .model import Datum, MachineModel, ModelOrigin
from .model_blocks import (
    COMPONENT_UNITS,
    DIRECTIONS,
    LATE_PARTS,
    STRUT_TERMS,
    datum_block,
    field_block,
    region_block,
    structure_block,
    struts_block,
    thermal_block,
    written,
)
from .region import Region
from .struts import WAVE_PARTS, StrutErrors
from .temperatures import PARTS, LateGrowth

MODEL_FORMAT = "hexapod_comp/model"
MODEL_VERSION = 1

IDEAL = "ideal"
"""What :func:`load_model` and parameters call the model of a machine without errors."""

ISO_8601 = re.compile(r"\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d(\.\d{3}(\d{3})?)?)?(Z|[+-]\d\d:\d\d)?)?")
"""The extended forms that every supported Python reads alike."""

SHA_256 = re.compile(r"[0-9a-f]{64}")

POSTERIOR_LINES = re.compile(r"^posterior:\n(?:[ \t]+.*\n)*", re.MULTILINE)
"""The block that names a fit's posterior: that file names the hash of all the rest."""

Line = tuple[int, int, int]
"""Key of a field line inside its family: direction, node index along each of the two cross axes."""


def load_model(path: str | Path, geometry: HexapodGeometry) -> MachineModel:
    """Read a model file; the module's docstring describes the format.

    Parameters
    ----------
    path : str or Path
        YAML file, or the name of a shipped one; ``ideal`` is the machine without errors.
    geometry : HexapodGeometry
        The machine that it must belong to.

    Returns
    -------
    MachineModel

    Raises
    ------
    InputFileError
        Naming file, key, value and what is allowed.
    """
    if path == IDEAL:
        return MachineModel(geometry.name)
    file = input_file(path, "model")
    return parse_model(read_text(file), geometry.name, file)


def parse_model(text: str, machine: str, name: str | Path = "model") -> MachineModel:
    """Return the model of a model file's text."""
    top = parse_yaml(text, name, MODEL_FORMAT, MODEL_VERSION)
    _refuse_cut_off(top)
    given = top.text("machine")
    if given != machine:
        raise top.error("machine", f"the model is for another machine, must be {machine!r}", given)
    try:
        values = {
            "name": top.text("name"),
            "origin": replace(_read_origin(top), text_sha256=text_sha256(text)),
            **_read_scalars(top),
            **_read_structure(top),
            **_read_thermal(top),
        }
        if "struts" in top:
            values["struts"] = _read_struts(top.section("struts"))
        if "field" in top:
            values["field"] = _read_field(top.section("field"))
        top.finish()
        model = MachineModel(machine, **values)
        check_magnitudes(model)
    except ModelError as error:
        raise InputFileError(name, error.key, error.problem, error.value) from error
    return model


def text_sha256(text: str) -> str:
    """Return the hash of a model file's text less the block that names its posterior, which names this hash."""
    return hashlib.sha256(POSTERIOR_LINES.sub("", text).encode()).hexdigest()


def save_model(model: MachineModel, path: str | Path) -> None:
    """Write a model file, whole or not at all.

    Parameters
    ----------
    model : MachineModel
        Its origin must carry a date.
    path : str or Path
        File to make or to replace.

    Raises
    ------
    ModelError
        Date or hashes of the origin are not what they should be.
    InputFileError
        The file cannot be written.
    """
    write_text(path, model_text(model))


def model_text(model: MachineModel) -> str:
    """Return the text that :func:`save_model` writes; equal models give equal texts."""
    _check_origin(model.origin)
    content: dict[str, Any] = {"format": MODEL_FORMAT, "version": MODEL_VERSION, "closed": True}
    content |= {"machine": model.machine, "name": model.name, "date": model.origin.date}
    content["sources"] = [{"file": name, "sha256": digest} for name, digest in model.origin.sources]
    if model.region is not None:
        content["region"] = region_block(model.region)
    if model.origin.held_out_residual is not None:
        content["held_out_residual_um"] = written(model.origin.held_out_residual, "length", "um")
    if model.origin.note:
        content["note"] = model.origin.note
    if model.origin.posterior is not None:
        content["posterior"] = dict(zip(("file", "sha256"), model.origin.posterior, strict=True))
    if model.origin.datum is not None:
        content["datum"] = datum_block(model.origin.datum)
    content["reversal_threshold_um"] = written(model.reversal_threshold, "length", "um")
    blocks = {
        "structure": structure_block(model),
        "struts": struts_block(model.struts),
        "thermal": thermal_block(model),
        "field": field_block(model.field),
    }
    content |= {name: block for name, block in blocks.items() if block} | {"end": True}
    return block_text(content)


# Reading


def _refuse_cut_off(top: Section) -> None:
    """Raise when a closed file has lost its end: every block is optional, so what is left may read well."""
    marks = [key for key in ("closed", "end") if key in top]
    for key in marks:
        value = top.take(key)
        if value is not True:
            raise top.error(key, "must be true, or be left out together with its fellow", value)
    if marks == ["closed"]:
        raise top.error("end", "is missing: the file is cut off, or still being written")
    if marks == ["end"]:
        raise top.error("closed", "is missing at the file's beginning")


def _read_origin(top: Section) -> ModelOrigin:
    given = top.take("date")
    if isinstance(given, date):  # YAML makes one of an unquoted date
        given = given.isoformat()
    residual = None
    if top.quantity_key("held_out_residual", "length"):
        residual = float(top.quantity("held_out_residual", "length"))
    sources = []
    for entry in top.sections("sources"):
        sources.append((entry.text("file"), entry.take("sha256")))
        entry.finish()
    note = top.text("note") if "note" in top else ""
    posterior = None
    if "posterior" in top:
        section = top.section("posterior")
        posterior = section.text("file"), section.take("sha256")
        section.finish()
    origin = ModelOrigin(given, tuple(sources), residual, note, posterior, _read_datum(top))
    _check_origin(origin)
    return origin


def _read_datum(top: Section) -> Datum | None:
    if "datum" not in top:
        return None
    section = top.section("datum")
    position = section.quantity("position", "length", (3,))
    angles = section.quantity("rotation", "angle", (3,), np.zeros(3))
    datum = Datum(tuple(position.tolist()), tuple(angles.tolist()), section.take("held"))
    section.finish()
    return datum


def _check_origin(origin: ModelOrigin) -> None:
    """Raise ModelError on a date, hash or residual that is none."""
    try:
        if not ISO_8601.fullmatch(origin.date):
            raise ValueError
        datetime.fromisoformat(origin.date.replace("Z", "+00:00"))
    except (TypeError, ValueError) as error:
        raise ModelError("date", "must be ISO 8601, like 2026-01-31", origin.date) from error
    for index, source in enumerate(origin.sources):
        _check_hash(f"sources[{index}]", *source)
    if origin.posterior is not None:
        _check_hash("posterior", *origin.posterior)
        if Path(origin.posterior[0]).name != origin.posterior[0]:
            raise ModelError("posterior.file", "must be a file's name, without a folder", origin.posterior[0])
    residual = origin.held_out_residual
    if residual is not None and not (math.isfinite(residual) and residual >= 0.0):
        raise ModelError("held_out_residual", "must be finite and not negative, m", residual)


def _check_hash(key: str, name: str, digest: object) -> None:
    if not (isinstance(digest, str) and SHA_256.fullmatch(digest)):
        problem = f"must be the 64 lower-case hexadecimal digits of the SHA-256 of {name!r}"
        raise ModelError(f"{key}.sha256", problem, digest)


def _read_scalars(top: Section) -> dict[str, Any]:
    """Return region and reversal threshold, where given."""
    values: dict[str, Any] = {}
    if top.quantity_key("valid_box", "length"):
        box = top.quantity("valid_box", "length", (2, 3))
        try:
            values["region"] = Region(box)
        except ModelError as error:
            raise top.error("valid_box", error.problem, error.value) from error
        if "region" in top:
            raise top.error("region", "stands beside valid_box: only one can be true")
    if "region" in top:
        section, zero = top.section("region"), np.zeros(3)
        box, point = section.quantity("box", "length", (2, 3)), section.quantity("point", "length", (3,), zero)
        position, angles = (
            section.quantity(*key, (3,), zero) for key in (("position", "length"), ("rotation", "angle"))
        )
        section.finish()
        values["region"] = Region(box, point, position, angles)
    if top.quantity_key("reversal_threshold", "length"):
        values["reversal_threshold"] = float(top.quantity("reversal_threshold", "length"))
    return values


def _read_structure(top: Section) -> dict[str, Any]:
    if "structure" not in top:
        return {}
    section = top.section("structure")
    names = ("base_deviation", "platform_deviation")
    values = {name: section.quantity(name, "length", (6, 3), np.zeros((6, 3))) for name in names}
    values["base_axes_turn"] = section.quantity("base_axes_turn", "angle", (3,), np.zeros(3))
    section.finish()
    return values


def _read_thermal(top: Section) -> dict[str, Any]:
    if "thermal" not in top:
        return {}
    section = top.section("thermal")
    names = ("base_expansion", "platform_expansion")
    values: dict[str, Any] = {name: float(section.quantity(name, "expansion", (), 0.0)) for name in names}
    thermometer = section.choice("thermometer", PARTS) if "thermometer" in section else ""
    constants = section.quantity("time_constants", "time", (None,), ())
    shapes = zip(LATE_PARTS, ((6, len(constants)), (len(constants),), (len(constants),)), strict=True)
    late = [section.quantity(name, "expansion", shape, np.zeros(shape)) for name, shape in shapes]
    section.finish()
    values["late_growth"] = LateGrowth(tuple(constants.tolist()), np.vstack(late), thermometer)
    return values


def _read_struts(section: Section) -> StrutErrors:
    values = {name: section.per_strut(name, kind, 0.0) for name, (kind, _) in STRUT_TERMS.items()}
    if "wave" in section:
        values |= _read_wave(section.section("wave"))
    if "map" in section:
        length_map = section.section("map")
        values["map_knots"] = length_map.quantity("knots", "length", (None,))
        values["map_values"] = length_map.quantity("values", "length", (6, None))
        values["map_backlash"] = length_map.quantity("backlash", "length", (6, None), np.zeros((6, 0)))
        length_map.finish()
    section.finish()
    return StrutErrors(**values)


def _read_wave(section: Section) -> dict[str, np.ndarray]:
    """Return amplitudes, shape (6, harmonics), and periods, shape (6,), m."""
    waves = {1: _amplitudes(section)}
    period = section.per_strut("period", "length")
    for harmonic in section.sections("harmonics") if "harmonics" in section else ():
        times = harmonic.take("times")
        if type(times) is not int or not 2 <= times <= MOST_HARMONICS:
            raise harmonic.error("times", f"must be a whole number, 2…{MOST_HARMONICS}", times)
        if times in waves:
            raise harmonic.error("times", "is given twice", times)
        waves[times] = _amplitudes(harmonic)
        harmonic.finish()
    section.finish()
    every = np.stack([waves.get(n, np.zeros((2, 6))) for n in range(1, max(waves) + 1)], axis=2)
    return {"cosine": every[0], "sine": every[1], "period": period}


def _amplitudes(section: Section) -> np.ndarray:
    return np.array([section.per_strut(name, "length", 0.0) for name in WAVE_PARTS])


def _read_field(section: Section) -> GridField:
    grid = tuple(section.quantity(f"grid_{axis}", "length", (None,)) for axis in "xyz")
    probe = section.quantity("probe", "length", (3,), np.zeros(3))
    threshold = float(section.quantity("reversal_threshold", "length", (), no_field().reversal_threshold))
    outside = section.choice("outside", OUTSIDE_POLICIES, "hold")
    families: dict[str, dict[Line, np.ndarray]] = {axis: {} for axis in "xyz"}
    for entry in section.sections("lines"):
        _read_line(entry, grid, families)
    lines = [
        _family_array(section, axis, families[axis], len(grid[first]), len(grid[second]))
        for axis, (first, second) in zip("xyz", CROSS_AXES, strict=True)
    ]
    section.finish()
    families_in_order = (lines[0], lines[1], lines[2])
    return GridField((grid[0], grid[1], grid[2]), families_in_order, probe, outside, threshold)


def _read_line(entry: Section, grid: tuple[np.ndarray, ...], families: dict[str, dict[Line, np.ndarray]]) -> None:
    """Read one line of the field into its family, for one direction or both."""
    axis = entry.choice("axis", ("x", "y", "z"))
    cross = CROSS_AXES["xyz".index(axis)]
    first, second = _node_indices(entry, [len(grid[other]) for other in cross])
    direction = entry.choice("direction", (*DIRECTIONS, "both"))
    rows = [entry.quantity(name, kind, (None,), ()) for name, (kind, _) in COMPONENT_UNITS.items()]
    entry.finish()
    coefficients = np.zeros((6, max(len(row) for row in rows)))
    for component, row in enumerate(rows):
        coefficients[component, : len(row)] = row
    for index, name in enumerate(DIRECTIONS):
        if direction not in (name, "both"):
            continue
        if (index, first, second) in families[axis]:
            problem = f"the {name} line along {axis} through these nodes is given twice"
            raise entry.error("at", problem, [first, second])
        families[axis][index, first, second] = coefficients


def _node_indices(entry: Section, counts: list[int]) -> tuple[int, int]:
    indices = entry.take("at")
    inside = (
        isinstance(indices, list)
        and len(indices) == 2
        and all(type(index) is int and 0 <= index < count for index, count in zip(indices, counts, strict=True))
    )
    if not inside:
        problem = f"must be two node indices within 0…{counts[0] - 1} and 0…{counts[1] - 1}"
        raise entry.error("at", problem, indices)
    return indices[0], indices[1]


def _family_array(
    section: Section, axis: str, family: dict[Line, np.ndarray], first_count: int, second_count: int
) -> np.ndarray:
    """Return the family's coefficients, shape (2, n, m, 6, K); K = 0 for one that was not measured."""
    if not family:
        return np.zeros((2, first_count, second_count, 6, 0))
    every = product(range(2), range(first_count), range(second_count))
    missing = next((line for line in every if line not in family), None)
    if missing is not None:  # looked for before anything is allocated: node counts are the file's
        direction, *nodes = missing
        raise section.error("lines", f"the {DIRECTIONS[direction]} line along {axis} at {nodes} is missing")
    powers = max(coefficients.shape[1] for coefficients in family.values())
    array = np.zeros((2, first_count, second_count, 6, powers))
    for line, coefficients in family.items():
        array[line][:, : coefficients.shape[1]] = coefficients
    return array
