"""Check of an export: the tool error of a simulated machine without and with the exported corrections.

The simulated machine has exactly the errors of the model. The tool passes random points along a space diagonal, forward
on all axes and then backward, so that errors that depend on the direction of motion are included.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..machine.arrays import Size
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.passes import Passes, level_attitude
from ..machine.temperatures import HUMIDITY, PARTS, REFERENCE_HUMIDITY, REFERENCE_TEMPERATURE, Temperatures
from ..machine.trial import ToolErrors, Trial
from ..pose import rotation_from_vector

# Sensor readings: 1 K above the reference temperature, and 10 % relative humidity above the reference humidity
WARMER, DAMPER = dict.fromkeys(PARTS, REFERENCE_TEMPERATURE + 1.0), {HUMIDITY: REFERENCE_HUMIDITY + 0.1}
DIAGONAL = np.ones(3)  # Direction of forward travel
CommandsOf = Callable[[Passes], np.ndarray]  # A function from N passes to their strut commands, shape (N, 6), m


@dataclass(frozen=True)
class Comparison:
    """Tool errors with nominal strut commands (before) and with the strut commands of an export (after)."""

    passes: int  # number of passes: poses times directions of travel
    before: Size  # displacement error without the export, m
    after: Size  # displacement error with the export, m
    before_rotation: Size  # rotation error without the export, rad
    after_rotation: Size  # rotation error with the export, rad

    @staticmethod
    def of(before: ToolErrors, after: ToolErrors) -> Comparison:
        sizes = [Size.of(v) for v in (before.displacement, after.displacement, before.rotation, after.rotation)]
        return Comparison(len(after.displacement), *sizes)


@dataclass(frozen=True)
class ExportCheck:
    """Tool errors without and with an export, and the sizes of effects that some exports cannot represent."""

    level: Comparison  # level tool at random positions in the box
    tilted: Comparison | None  # tilted tool at these positions; None if a limit refuses every tilted pose
    field: Size  # displacement of the tool by the model's error field, m
    per_kelvin: Size | None  # displacement of the tool if all parts are 1 K warmer, m; None: no effect
    per_humidity: Size | None  # displacement of the tool if humidity rises by 0.1, m; None: no effect


def diagonal_passes(geometry: HexapodGeometry, box: np.ndarray, count: int, seed: int, tilt: float = 0.0) -> Passes:
    """Return passes at `count` random positions of `box`, m in ``work``, each forward and backward along (1, 1, 1).

    The tool is tilted by `tilt`, rad, about a random horizontal axis.
    """
    rng = np.random.default_rng(seed)
    positions = rng.uniform(box[0], box[1], (count, 3))
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    axes = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    rotations = rotation_from_vector(tilt * axes) @ level_attitude(geometry)
    return Passes.of_tool(geometry, positions, rotations, np.tile(DIAGONAL, (count, 1))).both_ways()


class ExportTrial:
    """A machine with exactly the errors of a model, and the tool's motions for the check of this model's exports."""

    def __init__(
        self,
        geometry: HexapodGeometry,
        model: MachineModel,
        box: np.ndarray,
        count: int = 1000,
        seed: int = 0,
        tilt: float = np.deg2rad(5.0),
    ) -> None:
        self.machine = RealMachine(geometry, model)
        level = diagonal_passes(geometry, box, count, seed)
        level.refuse_unreachable()
        tilted = diagonal_passes(geometry, box, count, seed, tilt)
        reachable = tilted.reachable()
        passes = (level, tilted.select(reachable)) if reachable.any() else (level,)
        self._trials = [Trial(self.machine, some) for some in passes]
        self._before = [trial.errors(trial.commands(None)) for trial in self._trials]

    def check(self, commands_of: CommandsOf) -> ExportCheck:
        """Return the tool errors without compensation, and with the strut commands of an export, `commands_of`."""
        commands = [commands_of(trial.passes) for trial in self._trials]
        after = [trial.errors(lengths) for trial, lengths in zip(self._trials, commands, strict=True)]
        level, *tilted = (Comparison.of(*pair) for pair in zip(self._before, after, strict=True))
        grown = [_grown(self._trials[0], commands[0], after[0], readings) for readings in (WARMER, DAMPER)]
        return ExportCheck(level, tilted[0] if tilted else None, Size.of(after[0].field_share), *grown)


def _grown(trial: Trial, commands: np.ndarray, driven: ToolErrors, readings: dict[str, float]) -> Size | None:
    """Return how far the tool moves, m, as the parts grow at the sensor `readings`; None if no part grows."""
    grown = RealMachine(trial.machine.geometry, trial.machine.model, Temperatures(readings))
    if np.array_equal(grown.growth, trial.machine.growth) and all(
        np.array_equal(*joints) for joints in zip(grown.body[:2], trial.machine.body[:2], strict=True)
    ):
        return None
    return Size.of(Trial(grown, trial.passes).errors(commands).displacement - driven.displacement)
