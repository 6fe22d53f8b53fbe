"""The model of the real machine: it computes the actual pose from strut commands, and strut commands from a pose."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core import Status, Struct, batch, lib
from ..core.batch import backwards, rotate
from ..errors import ModelError, NotConvergedError
from ..pose import Pose, attitude_error, rotation_from_vector, rotation_vector
from .field import GridField, no_field
from .geometry import HexapodGeometry
from .kinematics import Structure, forward_error, over_chunks, strut_lengths
from .load import FREE, Load, Loading, Payload
from .outside import NO_TABLE, OutsideTable
from .region import Region
from .struts import StrutErrors
from .temperatures import AT_ONCE, EXPANSION, HUMIDITY, MOST_TIME_CONSTANTS, PARTS, LateGrowth, Temperatures
from .terms import check_magnitudes, term, validate_terms


@dataclass(frozen=True)
class Datum:
    """The pose at which a calibrated model has no tool error, in the degrees of freedom that the datum fixes."""

    position: tuple[float, float, float]  # position of ``pose_platform_in_base``, m
    angles: tuple[float, float, float]  # α, β, γ with R = Ry(β)·Rx(α)·Rz(γ), rad
    held: int  # how many of the tool's six degrees of freedom the datum fixes; the readings fix the others

    def __post_init__(self) -> None:
        for name in ("position", "angles"):
            values = tuple(getattr(self, name))
            if len(values) != 3 or not all(math.isfinite(value) for value in values):
                raise ModelError(f"datum.{name}", "must be three finite numbers, m or rad", values)
            object.__setattr__(self, name, values)
        if not (type(self.held) is int and 0 <= self.held <= 6):
            raise ModelError("datum.held", "must be a whole number, 0…6", self.held)

    @staticmethod
    def at(pose: Pose, held: int) -> Datum:
        x, y, z = (pose.position + 0.0).tolist()  # turns -0.0 into 0.0
        alpha, beta, gamma = (pose.angles() + 0.0).tolist()
        return Datum((x, y, z), (alpha, beta, gamma), held)

    @property
    def pose(self) -> Pose:
        return Pose.from_angles(self.position, self.angles)

    def __str__(self) -> str:
        # Rounded, because a tool turned by 180° has angles of 1e-14° from the conversion of its rotation matrix
        position = ", ".join(f"{round(value * 1e3, 9) + 0.0:.10g}" for value in self.position)
        angles = ", ".join(f"{round(math.degrees(value), 9) + 0.0:.10g}" for value in self.angles)
        fixed = f"fixes {self.held} of 6 degrees of freedom" + ("" if self.held else ", as the readings fix all six")
        return f"{fixed}; platform at {position} mm, {angles}° in base"


@dataclass(frozen=True)
class ModelOrigin:
    """How a model was made; stored in the model file, without effect on computed poses and commands."""

    date: str = ""  # date of the fit, ISO 8601
    sources: tuple[tuple[str, str], ...] = ()  # name and SHA-256 of each data file that the model was fitted to
    held_out_residual: float | None = None  # RMS tool error on readings not used in the fit, m; None if not measured
    note: str = ""  # remark, one line
    # Name and SHA-256 of the file with the fit's posterior, in the model file's folder; None if not known
    posterior: tuple[str, str] | None = None
    datum: Datum | None = None  # None if not known
    # Loads during the measurement, if known: payload, kg, its centre in platform, m, gravity in base, m/s²
    loads: tuple[tuple[float, ...], ...] = ()
    # :func:`~.model_file.text_sha256` of the model file; empty if the model was not read from a file
    text_sha256: str = dataclasses.field(default="", compare=False)


@dataclass(frozen=True)
class MachineModel:
    """Deviations of the real machine from its geometry file.

    Parameters
    ----------
    machine : str
        Name of the geometry that the model belongs to.
    name : str
        Name of the model, shown in diagnostics.
    base_deviation, platform_deviation : ndarray, shape (6, 3)
        Real minus nominal joint positions, m, in the frame of base or platform.
    base_axes_turn : ndarray, shape (3,)
        Rotation vector, rad in ``base``, by which the base's cardan axes turn when the datum turns the whole base.
    struts : StrutErrors
        Errors of the six struts.
    field : GridField
        Interpolated tool error that structure and struts do not explain.
    base_expansion, platform_expansion : float
        Thermal expansion of the two bodies about their origins, 1/K.
    late_growth : LateGrowth
        How the parts' growth lags behind the thermometers; which thermometer represents all parts, if one does.
    load : Load
        How struts stretch under weight and other forces.
    outside : OutsideTable
        Table of the error due to one or two external quantities such as elevation; :meth:`at` adds it to the field.
    reversal_threshold : float
        Distance, m, that a strut must move back until its direction counts as reversed: larger than the noise of the
        commands, and much smaller than the backlash. The field has its own threshold for reversals along x, y, z.
    region : Region or None
        Box in which the model was measured; None: not known.
    origin : ModelOrigin
        How the model was made.

    Raises
    ------
    ModelError
        A term has a wrong shape or value; the message names key, value and what is allowed.
    """

    machine: str
    name: str = "ideal"
    base_deviation: np.ndarray = term("structure", "um", "real − nominal joints, in base", (6, 3), largest=0.05)
    platform_deviation: np.ndarray = term("structure", "um", "real − nominal joints, in platform", (6, 3), largest=0.05)
    base_axes_turn: np.ndarray = term(
        "structure", "urad", "rotation vector of the base's cardan axes, in base", (3,), largest=0.1
    )
    struts: StrutErrors = dataclasses.field(default_factory=StrutErrors)
    field: GridField = dataclasses.field(default_factory=no_field)
    base_expansion: float = term("thermal", "ppm_per_K", "expansion of the base", (), largest=EXPANSION)
    platform_expansion: float = term("thermal", "ppm_per_K", "expansion of the platform", (), largest=EXPANSION)
    late_growth: LateGrowth = AT_ONCE
    load: Load = dataclasses.field(default_factory=Load)
    outside: OutsideTable = NO_TABLE
    reversal_threshold: float = term(
        "", "um", "distance that a strut moves back until its direction counts as reversed", (), 0.2e-6, least=0.0
    )
    region: Region | None = None
    origin: ModelOrigin = ModelOrigin()

    def __post_init__(self) -> None:
        validate_terms(self)
        check_magnitudes(self, "structure")

    def at(self, outside: Mapping[str, float]) -> MachineModel:
        """Return the model for these external quantities (SI, by name): its error field includes its table's error."""
        if not self.outside.names:
            return self
        # The table's error is the same at all poses, so a constant added to the field represents it exactly
        error = self.outside.evaluate(outside)
        return replace(self, outside=NO_TABLE, field=self.field.plus(error) if error.any() else self.field)

    @cached_property
    def measured(self) -> Region | None:
        """Box in which the model was measured; if unknown, the box of its field; None if there is no field either."""
        if self.region is None and any(family.shape[4] for family in self.field.lines):
            return Region(self.field.box, self.field.probe)
        return self.region

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """Names of the parts whose temperatures move the tool, and ``humidity`` if it changes the struts' lengths."""
        late = self.late_growth
        grows = np.append(self.struts.expansion, [self.base_expansion, self.platform_expansion]) != 0.0
        read = {late.sensor_of(part) for part in np.flatnonzero(grows | late.expansion.any(axis=1)).tolist()}
        return (*(PARTS[n] for n in sorted(read)), *[HUMIDITY] * bool(self.struts.moisture.any()))


FOLLOWED = 9  # Number of directions of motion: of the measured point along x, y and z, and of six struts
# Directions of motion by name; midway: direction not known, the model assumes half of the backlash
DIRECTIONS = {"forward": 1.0, "midway": 0.0, "backward": -1.0}


PoseArrays = tuple[np.ndarray, np.ndarray]  # position (3,), m, and rotation (3, 3)


class MotionState:
    """Directions of motion of axes and struts; a motion back by less than a threshold (noise) reverses no direction."""

    __slots__ = ("low", "sense")

    def __init__(self, low: np.ndarray | None = None, sense: np.ndarray | None = None) -> None:
        self.low = np.full(FOLLOWED, math.nan) if low is None else low  # lower end of each dead band, m; NaN: not known
        self.sense = np.zeros(FOLLOWED) if sense is None else sense  # directions −1, 0 (not known) or 1

    def copy_from(self, other: MotionState) -> None:
        self.low[:] = other.low
        self.sense[:] = other.sense


class RealMachine:
    """A machine with its errors, at given temperatures and loads, for inverse and forward kinematics.

    Parameters
    ----------
    geometry : HexapodGeometry
        The nominal machine.
    model : MachineModel
        Errors of the machine.
    temperatures : Temperatures, optional
        Readings of temperatures and humidity; by default 20 °C everywhere and 50 % relative humidity.
    loading : Loading, optional
        Gravity, and other forces on the platform; by default the model's gravity and no other force.

    Raises
    ------
    ModelError
        The model belongs to another machine.
    """

    def __init__(
        self,
        geometry: HexapodGeometry,
        model: MachineModel,
        temperatures: Temperatures | None = None,
        loading: Loading = FREE,
        constants: Struct | None = None,  # ``hc_model`` of this geometry and model, if already made
    ) -> None:
        self.geometry, self.model = geometry, model
        self.temperatures, self.loading = temperatures or Temperatures(), loading
        self.constants, self.state = constants or core_model(geometry, model), Struct("hc_state")
        lib.hc_init(self.state.at, self.constants.at, 0.0)
        self.state.keep(self.constants)
        write_temperatures(self.state, self.temperatures)
        write_loading(self.state, loading)
        lib.hc_place(self.state.at)
        placed = self.state.view["base_joints"].copy(), self.state.view["platform_joints"].copy()
        self.structure = Structure(*placed, *Structure.of(geometry).solver, geometry.home)

    def __reduce__(self) -> tuple:
        return RealMachine, (self.geometry, self.model, self.temperatures, self.loading)

    @property
    def bends(self) -> bool:
        """Whether the model lets weight and forces move the platform."""
        return self.model.load.bends

    @property
    def warms(self) -> bool:
        """Whether the model lets temperatures move the tool."""
        return bool({*PARTS} & {*self.model.sensors})

    def at(
        self, temperatures: Temperatures, payload: Payload | None = None, gravity: Sequence[float] | None = None
    ) -> RealMachine:
        """Return the same machine at other temperatures and, if given, with another payload and gravity."""
        geometry = self.geometry if payload is None else self.geometry.carrying(payload)
        loading = self.loading if gravity is None else Loading.of(gravity)
        constants = self.constants if geometry is self.geometry else None
        return RealMachine(geometry, self.model, temperatures, loading, constants)

    def advance(
        self, seconds: float, commands: np.ndarray, sense: np.ndarray, pose: PoseArrays, actual: PoseArrays
    ) -> tuple[int, float]:
        """Run :meth:`forward`: this machine without inertia ignores `seconds`, the time since the last command."""
        return self.forward(commands, sense, pose, actual)

    @property
    def body(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Real joints of base and platform, m, and their cardan axes, each (6, 3) in the frame of base or platform."""
        base, platform = (self.constants.view[name]["axes"] for name in ("base", "platform"))
        return (*self.structure.joints, base, platform)

    @property
    def growth(self) -> np.ndarray:
        """L/L₀ − 1 of each strut, with present length L, and length L₀ at 20 °C and 50 % humidity; shape (6,)."""
        return self.state.view["growth"]

    def commands_for(self, target: Pose, motion: MotionState | None = None) -> tuple[np.ndarray, Pose, bool]:
        """Return the strut commands that bring the real platform to a pose (inverse kinematics).

        Parameters
        ----------
        target : Pose
            Wanted ``pose_platform_in_base``.
        motion : MotionState, optional
            Directions of motion, which this call updates; by default not known.

        Returns
        -------
        commands : ndarray, shape (6,)
            Strut commands, m.
        model_pose : Pose
            q with q ∘ E(q) = target, where E is the error field: the platform pose from which the strut lengths were
            computed.
        outside : bool
            Whether the measured point lies outside the field's box.

        Raises
        ------
        NotConvergedError
            The iteration for `model_pose` does not converge, as the field's error changes too much with the pose.
        """
        motion = MotionState() if motion is None else motion
        given = (array[None] for array in (target.position, target.rotation, motion.low, motion.sense))
        (position,), (rotation,), (commands,), (outcome,) = backwards(self.state, *given)
        if outcome == Status.NOT_CONVERGED:
            raise NotConvergedError()
        return commands, Pose(position, rotation), bool(outcome == Status.OUTSIDE_FIELD)

    def pose_for(
        self, commands: ArrayLike, sense: np.ndarray | None = None, guess: Pose | None = None
    ) -> tuple[Pose, Pose]:
        """Return the real platform's pose at given strut commands (forward kinematics).

        Parameters
        ----------
        commands : array_like, shape (6,)
            Strut commands, or encoder readings, m.
        sense : ndarray, shape (9,), optional
            Directions of motion, as in :class:`MotionState`; by default not known.
        guess : Pose, optional
            Model pose from which the search starts, usually the last pose; home by default.

        Returns
        -------
        actual, model_pose : Pose
            ``pose_platform_in_base`` with and without the field's error.

        Raises
        ------
        KinematicsError
            For the reasons that :func:`hexapod_comp.machine.kinematics.solve_pose` lists.
        """
        guess = self.geometry.home if guess is None else guess
        sense = MotionState().sense if sense is None else sense
        pose, actual = (guess.position.copy(), guess.rotation.copy()), (np.empty(3), np.empty((3, 3)))
        lengths, senses = (np.ascontiguousarray(values, dtype=float) for values in (commands, sense))
        outcome, condition = self.forward(lengths, senses, pose, actual)
        if outcome != Status.OK:
            raise forward_error(outcome, condition, self.structure.max_condition)
        return Pose(*actual), Pose(*pose)

    def forward(
        self, commands: np.ndarray, sense: np.ndarray, pose: PoseArrays, actual: PoseArrays
    ) -> tuple[int, float]:
        """Compute the platform pose at strut `commands`; return the core's status and the condition number.

        `pose` must contain a guess of the platform pose. If the status is OK, the call writes the platform pose into
        `actual`, and the platform pose without the field's error into `pose`.
        """
        outcome, condition = np.empty(1, np.intc), np.empty(1)
        rows = (array[None] for array in (commands, sense, *pose, *actual))
        batch.forwards(self.state.at, *rows, outcome, condition)
        return int(outcome[0]), float(condition[0])

    def forward_many(self, *arrays: np.ndarray) -> None:
        """Do as :meth:`forward` for N rows of each array, in several threads if that is faster."""

        def run(rows: slice) -> None:
            batch.forwards(self.state.at, *(array[rows] for array in arrays))

        over_chunks(run, len(arrays[0]))


def core_model(geometry: HexapodGeometry, model: MachineModel) -> Struct:
    """Make the C struct ``hc_model`` of a geometry and its model; raise ModelError if their machines differ."""
    if model.machine != geometry.name:
        problem = f"the model is for machine {model.machine!r}, but the geometry is of machine {geometry.name!r}"
        raise ModelError("machine", problem)
    return Struct("hc_model", members(geometry, model))


def write_temperatures(state: Struct, temperatures: Temperatures) -> None:
    """Write temperatures, humidity and lags into an ``hc_state``; they act when the caller then calls ``hc_place``."""
    view = state.view
    view["temperatures"] = [temperatures.at(name) for name in PARTS]
    view["humidity"] = temperatures.at(HUMIDITY)
    for index, name in enumerate(PARTS):
        lag = temperatures.lags.get(name)
        if lag is not None:
            view["began"][index] = 0.0 if math.isnan(lag.began) else lag.began  # time of the first reading
            view["newest"][index] = lag.newest
            view["behind"][index][: len(lag.behind)] = lag.behind


def write_loading(state: Struct, loading: Loading) -> None:
    state.view["gravity"] = loading.gravity or (math.nan,) * 3
    state.view["external"] = loading.wrench


def members(geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str] = ("", "")) -> dict[str, Any]:
    """Return the C struct ``hc_model`` as values by member name; `hashes`: SHA-256 of geometry file and model file."""
    model_texts = {"machine": model.machine, "model": model.name, "date": model.origin.date or ""}
    tool, late = geometry.tool, model.late_growth
    constants, expansion = np.zeros(MOST_TIME_CONSTANTS), np.zeros((len(PARTS), MOST_TIME_CONSTANTS))
    count = len(late.time_constants)
    constants[:count], expansion[:, :count] = late.time_constants, late.expansion
    return {
        **model_texts,
        "geometry_sha256": hashes[0],
        "model_sha256": hashes[1],
        "base": _body(geometry, model, 0),
        "platform": _body(geometry, model, 1),
        "home": _pose(geometry.home),
        "work": _pose(geometry.work),
        "tool": _pose(tool),
        "tool_inverse": _pose(tool.inverse()),
        "limits": geometry.limit_numbers.view,
        "struts": model.struts.members(geometry),
        "map": {
            "knot_count": len(model.struts.map_knots),
            "knots": model.struts.map_knots,
            "pieces": model.struts.spline_coefficients(),
        },
        "field": model.field.members(),
        "late": {
            "count": count,
            "time_constants": constants,
            "expansion": expansion,
            "sensors": [late.sensor_of(part) for part in range(len(PARTS))],
        },
        "load": model.load.members(geometry),
        "axis_threshold": model.field.reversal_threshold,
        "strut_threshold": model.reversal_threshold,
    }


def _body(geometry: HexapodGeometry, model: MachineModel, index: int) -> dict[str, Any]:
    name, axes = ("base", "platform")[index], geometry.kernel_axes[index]
    if name == "base" and model.base_axes_turn.any():
        turn = np.eye(3)
        rotate(turn, *model.base_axes_turn.tolist())
        axes = axes @ turn.T
    return {
        "joints": geometry.kernel_joints[index],
        "deviation": getattr(model, f"{name}_deviation"),
        "axes": axes,
        "expansion": getattr(model, f"{name}_expansion"),
    }


def _pose(pose: Pose) -> dict[str, Any]:
    return {"position": pose.position, "rotation": pose.rotation}


def commanded_box(geometry: HexapodGeometry, model: MachineModel) -> np.ndarray:
    """Return the box in which a model was measured, as positions of an untilted tool, (2, 3), m in ``work``."""
    return measured_region(model).commanded(geometry)


def measured_region(model: MachineModel) -> Region:
    """Return the box in which a model was measured; raise ModelError if the model does not state the box."""
    region = model.measured
    if region is None:
        raise ModelError(
            "region", "the model does not state the box in which it was measured; give a box of tool positions"
        )
    return region


ROUNDS = 10  # Most iterations of `with_datum_held`; each divides the tool's error at the datum by about a thousand
SETTLED = 1e-12  # Tool error, m and rad, below which this iteration has converged


def tool_move(geometry: HexapodGeometry, model: MachineModel, pose: Pose) -> np.ndarray:
    """Return the tool's error, (6,), m and rad in ``base``, if a platform pose is commanded without compensation."""
    machine = RealMachine(geometry, model)
    actual, _ = machine.pose_for(strut_lengths(Structure.of(geometry), pose), guess=pose)
    displacement = (actual @ geometry.tool).position - (pose @ geometry.tool).position
    return np.concatenate([displacement, attitude_error(actual.rotation, pose.rotation)])


def with_datum_held(
    geometry: HexapodGeometry, model: MachineModel, pose: Pose, part: np.ndarray | None = None
) -> MachineModel:
    """Return the model with its base shifted and turned so that the tool's error at a platform pose is zero.

    The matrix `part`, (6, 6), projects the tool's error on the degrees of freedom that the datum fixes, by default all.
    """
    part = np.eye(6) if part is None else part
    tip = (pose @ geometry.tool).position
    for _ in range(ROUNDS):
        move = tool_move(geometry, model, pose)
        taken = part @ move
        if np.abs(taken).max() <= SETTLED:
            return model
        about, back = tip + move[:3], rotation_from_vector(-taken[3:])
        joints = about - taken[:3] + (geometry.base_joints + model.base_deviation - about) @ back.T
        model = replace(model, base_deviation=joints - geometry.base_joints)
        if geometry.screw_lead.any():
            axes = back @ rotation_from_vector(model.base_axes_turn)
            model = replace(model, base_axes_turn=rotation_vector(axes))
    problem = f"{ROUNDS} iterations found no shift and turn of the base that hold the tool at the datum pose"
    raise NotConvergedError(problem, limit=ROUNDS)
