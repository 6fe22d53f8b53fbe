"""The model of the real machine, run forwards (where will the tool go?) and backwards (what to command?)."""

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
from .terms import check_magnitudes, settle, term


@dataclass(frozen=True)
class Datum:
    """A pose at which a calibration keeps the tool at its nominal place."""

    position: tuple[float, float, float]  # ``pose_platform_in_base``: m, and the paper's α, β, γ, rad
    angles: tuple[float, float, float]  # ``pose_platform_in_base``: m, and the paper's α, β, γ, rad
    # In how many of the six ways to shift and turn the whole machine. Those that the readings show are not held: there
    # the model contains the machine's place
    held: int

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
        """Return the datum at a ``pose_platform_in_base``."""
        x, y, z = (pose.position + 0.0).tolist()  # no minus before zero
        alpha, beta, gamma = (pose.angles() + 0.0).tolist()
        return Datum((x, y, z), (alpha, beta, gamma), held)

    @property
    def pose(self) -> Pose:
        """``pose_platform_in_base``."""
        return Pose.from_angles(self.position, self.angles)

    def __str__(self) -> str:
        position = ", ".join(f"{value * 1e3:.10g}" for value in self.position)
        angles = ", ".join(f"{math.degrees(value):.10g}" for value in self.angles)
        ways = f"held in {self.held} of 6 ways" if self.held else "not held, the readings saw it"
        return f"{ways}; platform at {position} mm, {angles}° in base"


@dataclass(frozen=True)
class ModelOrigin:
    """Origin of a model; stored in the file, not used in the arithmetic."""

    date: str = ""  # ISO 8601 date of the fit
    sources: tuple[tuple[str, str], ...] = ()  # Name and SHA-256 of each data file that the model was fitted to
    # RMS residual tool error on data that were not used in the fit, m; None if not measured
    held_out_residual: float | None = None
    note: str = ""  # One line for people
    # Name, beside the model file, and SHA-256 of the file with the fit's posterior; None if not known
    posterior: tuple[str, str] | None = None
    # Pose at which the tool is held, and how many ways; None if not known
    datum: Datum | None = None
    # Loads during its measurement, if known: each payload, kg, its centre in platform, m, gravity in base, m/s²
    loads: tuple[tuple[float, ...], ...] = ()
    # Of what a fit has made of the file that the model was read from; empty when it was not read
    text_sha256: str = dataclasses.field(default="", compare=False)


@dataclass(frozen=True)
class MachineModel:
    """Deviations of the real machine from its geometry file.

    Parameters
    ----------
    machine : str
        Name of the geometry that it belongs to.
    name : str
        Name of the model, shown in diagnostics.
    base_deviation, platform_deviation : ndarray, shape (6, 3)
        Real minus nominal joint position, m, in each body's frame.
    base_axes_turn : ndarray, shape (3,)
        Rotation vector, rad in ``base``, by which the base's cardan axes are turned when the whole base is.
    struts : StrutErrors
        Errors of the six struts.
    field : GridField
        Interpolated rest.
    base_expansion, platform_expansion : float
        Thermal expansion of the two bodies about their origins, 1/K.
    late_growth : LateGrowth
        How parts lag behind their thermometers, and which thermometer represents all parts.
    load : Load
        How struts give under weight and other forces.
    outside : OutsideTable
        Error over one or two outside numbers, added to the field where these are known: :meth:`at`.
    reversal_threshold : float
        How far a strut must come back before its direction counts as reversed, m: above the noise of the
        commands, and as far below the backlash as that allows. The field has a threshold of its own.
    region : Region or None
        Where the model was measured; None: not known.
    origin : ModelOrigin
        Provenance.

    Raises
    ------
    ModelError
        With key, value and what is allowed.
    """

    machine: str
    name: str = "ideal"
    base_deviation: np.ndarray = term("structure", "um", "real − nominal joints, in base", (6, 3), largest=0.05)
    platform_deviation: np.ndarray = term("structure", "um", "the same, in platform", (6, 3), largest=0.05)
    base_axes_turn: np.ndarray = term(
        "structure", "urad", "rotation vector of the base's cardan axes, which turn with it", (3,), largest=0.1
    )
    struts: StrutErrors = dataclasses.field(default_factory=StrutErrors)
    field: GridField = dataclasses.field(default_factory=no_field)
    base_expansion: float = term("thermal", "ppm_per_K", "of the base about its origin", (), largest=EXPANSION)
    platform_expansion: float = term("thermal", "ppm_per_K", "of the platform", (), largest=EXPANSION)
    late_growth: LateGrowth = AT_ONCE
    load: Load = dataclasses.field(default_factory=Load)
    outside: OutsideTable = NO_TABLE
    reversal_threshold: float = term(
        "", "um", "way back until a strut's direction counts as reversed", (), default=0.2e-6, least=0.0
    )
    region: Region | None = None
    origin: ModelOrigin = ModelOrigin()

    def __post_init__(self) -> None:
        settle(self)
        check_magnitudes(self, "structure")

    def at(self, outside: Mapping[str, float]) -> MachineModel:
        """Return the model of the machine at outside numbers, by their names in SI units: without table, and with its
        error there in the field. An error of the table is the same everywhere, so the field represents it exactly."""
        if not self.outside.names:
            return self
        error = self.outside.evaluate(outside)
        return replace(self, outside=NO_TABLE, field=self.field.plus(error) if error.any() else self.field)

    @cached_property
    def measured(self) -> Region | None:
        """Region of the model's measurement, or else of its field; None if not known."""
        if self.region is None and any(family.shape[4] for family in self.field.lines):
            return Region(self.field.box, self.field.probe)
        return self.region


FOLLOWED = 9  # Three axes of the measured point, then six struts
# Directions of all axes and struts approached in one direction; midway: not known
DIRECTIONS = {"forward": 1.0, "midway": 0.0, "backward": -1.0}


PoseArrays = tuple[np.ndarray, np.ndarray]  # position (3,), m, and rotation (3, 3)


class MotionState:
    """Directions of motion with a reversal threshold, so that noise at standstill does not flip a backlash."""

    __slots__ = ("low", "sense")

    def __init__(self, low: np.ndarray | None = None, sense: np.ndarray | None = None) -> None:
        self.low = np.full(FOLLOWED, math.nan) if low is None else low
        self.sense = np.zeros(FOLLOWED) if sense is None else sense

    def copy_from(self, other: MotionState) -> None:
        """Copy another's state."""
        self.low[:] = other.low
        self.sense[:] = other.sense


class RealMachine:
    """A geometry with its errors at given temperatures, for inverse and forward kinematics.

    Parameters
    ----------
    geometry : HexapodGeometry
        The nominal machine.
    model : MachineModel
        Its errors.
    temperatures : Temperatures, optional
        Readings; 20 °C everywhere, and 50 % of humidity, by default.
    loading : Loading, optional
        Gravity and other forces; the model's gravity and no force by default.

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
        constants: Struct | None = None,  # of another machine of this geometry and model, which does not change them
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
        """Whether weight and forces move the platform."""
        return self.model.load.bends

    @property
    def warms(self) -> bool:
        """Whether temperatures move the tool."""
        model = self.model
        bodies = model.base_expansion or model.platform_expansion or model.late_growth.expansion.any()
        return bool(bodies or model.struts.expansion.any())

    def at(
        self, temperatures: Temperatures, payload: Payload | None = None, gravity: Sequence[float] | None = None
    ) -> RealMachine:
        """Return the same machine at other temperatures and, if given, under another load."""
        geometry = self.geometry if payload is None else self.geometry.carrying(payload)
        loading = self.loading if gravity is None else Loading.of(gravity)
        constants = self.constants if geometry is self.geometry else None
        return RealMachine(geometry, self.model, temperatures, loading, constants)

    def advance(
        self, seconds: float, commands: np.ndarray, sense: np.ndarray, pose: PoseArrays, actual: PoseArrays
    ) -> tuple[int, float]:
        """Run :meth:`forward` after a time, s, in which the struts moved to their commands: without inertia at once."""
        return self.forward(commands, sense, pose, actual)

    @property
    def body(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Real joints of base and platform, and their cardan axes, shape (6, 3) each."""
        base, platform = (self.constants.view[name]["axes"] for name in ("base", "platform"))
        return (*self.structure.joints, base, platform)

    @property
    def growth(self) -> np.ndarray:
        """Relative growth of each strut since 20 °C and 50 % of humidity, shape (6,)."""
        return self.state.view["growth"]

    def commands_for(self, target: Pose, motion: MotionState | None = None) -> tuple[np.ndarray, Pose, bool]:
        """Return the strut commands that bring the real platform to a pose (backward run).

        Parameters
        ----------
        target : Pose
            ``pose_platform_in_base`` wanted.
        motion : MotionState, optional
            Directions of motion; updated. By default they are not known.

        Returns
        -------
        commands : ndarray, shape (6,)
            m.
        model_pose : Pose
            q with q ∘ E(q) = target: the pose for which the structure's lengths were taken.
        outside : bool
            The measured point lies outside the field's box.

        Raises
        ------
        NotConvergedError
            q ∘ E(q) = target could not be solved: the field is no small correction.
        """
        motion = MotionState() if motion is None else motion
        given = (array[None] for array in (target.position, target.rotation, motion.low, motion.sense))
        (position,), (rotation,), (commands,), (outcome,) = backwards(self.state, *given)
        if outcome == Status.NOT_CONVERGED:
            raise NotConvergedError("the error field is too steep to be undone at this pose")
        return commands, Pose(position, rotation), bool(outcome == Status.OUTSIDE_FIELD)

    def pose_for(
        self, commands: ArrayLike, sense: np.ndarray | None = None, guess: Pose | None = None
    ) -> tuple[Pose, Pose]:
        """Return the real platform's pose under given strut commands (forward run).

        Parameters
        ----------
        commands : array_like, shape (6,)
            Strut commands, or encoder readings, m.
        sense : ndarray, shape (9,), optional
            Directions of motion, as in :class:`MotionState`. By default they are not known.
        guess : Pose, optional
            Model pose to start from, usually the last one; home by default.

        Returns
        -------
        actual, model_pose : Pose
            ``pose_platform_in_base`` with and without the field's error.

        Raises
        ------
        KinematicsError
            As :func:`hexapod_comp.machine.kinematics.solve_pose`.
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
        """Run the model forwards on arrays of the caller; return (outcome, condition number).

        The model pose is the guess, and the solution where the outcome is OK; only then is the actual pose written.
        """
        outcome, condition = np.empty(1, np.intc), np.empty(1)
        rows = (array[None] for array in (commands, sense, *pose, *actual))
        batch.forwards(self.state.at, *rows, outcome, condition)
        return int(outcome[0]), float(condition[0])

    def forward_many(self, *arrays: np.ndarray) -> None:
        """Run :func:`~hexapod_comp.core.batch.forwards` by several threads if that is faster."""

        def run(rows: slice) -> None:
            batch.forwards(self.state.at, *(array[rows] for array in arrays))

        over_chunks(run, len(arrays[0]))


def core_model(geometry: HexapodGeometry, model: MachineModel) -> Struct:
    """Return a machine and its model for the core, ``hc_model``."""
    if model.machine != geometry.name:
        problem = f"the model is for machine {model.machine!r}, the geometry is {geometry.name!r}"
        raise ModelError("machine", problem)
    return Struct("hc_model", members(geometry, model))


def write_temperatures(state: Struct, temperatures: Temperatures) -> None:
    """Write readings and lags into an ``hc_state``, which must be placed then."""
    view = state.view
    view["temperatures"] = [temperatures.at(name) for name in PARTS]
    view["humidity"] = temperatures.at(HUMIDITY)
    for index, name in enumerate(PARTS):
        lag = temperatures.lags.get(name)
        if lag is not None:
            view["began"][index] = 0.0 if math.isnan(lag.began) else lag.began  # late parts are used from then on
            view["newest"][index] = lag.newest
            view["behind"][index][: len(lag.behind)] = lag.behind


def write_loading(state: Struct, loading: Loading) -> None:
    """Write gravity and other forces into an ``hc_state``."""
    state.view["gravity"] = loading.gravity or (math.nan,) * 3
    state.view["external"] = loading.wrench


def members(geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str] = ("", "")) -> dict[str, Any]:
    """Return the values of ``hc_model``."""
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
    """Return the box of level tool positions in ``work`` in which a model was measured, shape (2, 3), m."""
    return measured_region(model).commanded(geometry)


def measured_region(model: MachineModel) -> Region:
    """Return the region of a model's measurement."""
    region = model.measured
    if region is None:
        raise ModelError(
            "region", "the model does not state the box in which it was measured; give a box of tool positions"
        )
    return region


ROUNDS = 10  # Field and turning screws change slightly for a moved machine: each round reduces the error a thousandfold
SETTLED = 1e-12  # Smaller motions of the tool count as none, m and rad


def tool_move(geometry: HexapodGeometry, model: MachineModel, pose: Pose) -> np.ndarray:
    """Return the tool's motion at a pose with the struts commanded to nominal lengths."""
    machine = RealMachine(geometry, model)
    actual, _ = machine.pose_for(strut_lengths(Structure.of(geometry), pose), guess=pose)
    displacement = (actual @ geometry.tool).position - (pose @ geometry.tool).position
    return np.concatenate([displacement, attitude_error(actual.rotation, pose.rotation)])


def with_datum_held(
    geometry: HexapodGeometry, model: MachineModel, pose: Pose, part: np.ndarray | None = None
) -> MachineModel:
    """Return a model whose whole machine is shifted and turned so that it does not move the tool at a pose."""
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
    raise NotConvergedError("no shift and turn of the machine brings the tool to its nominal datum pose", limit=ROUNDS)
