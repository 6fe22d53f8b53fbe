"""Try an export on the machine that its model describes: the tool error that remains with the exported data.

The model is taken for the truth. Its machine makes the same random passes twice, with nominal strut lengths and
with what the export makes of the same commands, and the tool's error is compared. Each point is passed along a
space diagonal, forward on all axes and then backward, so that everything that depends on a direction has one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..machine.arrays import Size
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.passes import Passes
from ..machine.temperatures import HUMIDITY, PARTS, REFERENCE_HUMIDITY, REFERENCE_TEMPERATURE, Temperatures
from ..machine.trial import ToolErrors, Trial
from ..pose import rotation_from_vector

# Readings of a machine that is 1 K warmer, and of one in damper air
WARMER, DAMPER = dict.fromkeys(PARTS, REFERENCE_TEMPERATURE + 1.0), {HUMIDITY: REFERENCE_HUMIDITY + 0.1}
DIAGONAL = np.ones(3)  # Direction of travel, forward; backward is its opposite


CommandsOf = Callable[[Passes], np.ndarray]  # Returns the strut commands, shape (N, 6), m, that are sent for N passes


@dataclass(frozen=True)
class Comparison:
    """Errors of the tool without and with an export."""

    passes: int  # Poses times directions that were driven
    before: Size  # 3-D displacement error, m
    after: Size
    before_rotation: Size  # Rotation error, rad
    after_rotation: Size

    @staticmethod
    def of(before: ToolErrors, after: ToolErrors) -> Comparison:
        """Return the sizes of errors without and with an export."""
        sizes = [Size.of(v) for v in (before.displacement, after.displacement, before.rotation, after.rotation)]
        return Comparison(len(after.displacement), *sizes)


@dataclass(frozen=True)
class ExportCheck:
    """Tool error without and with one export, and the size of the effects that it cannot represent."""

    level: Comparison  # Level tool, inside the box
    # The same places with the tool tilted; None where no such pose is within the machine's limits
    tilted: Comparison | None
    field: Size  # Displacement of the tool by the model's error field, m
    # Displacement of the tool when struts, base and platform are 1 K warmer, and when the air is damper by 0.1, m; None
    # for a model that this does not act on
    per_kelvin: Size | None
    per_humidity: Size | None


def diagonal_passes(geometry: HexapodGeometry, box: np.ndarray, count: int, seed: int, tilt: float = 0.0) -> Passes:
    """Draw positions in a box; each is passed forward and backward along a space diagonal."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(box[0], box[1], (count, 3))
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    axes = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    rotations = rotation_from_vector(tilt * axes)
    return Passes.of_tool(geometry, positions, rotations, np.tile(DIAGONAL, (count, 1))).both_ways()


class ExportTrial:
    """A machine and the passes on which exports for it are tried; the model is taken for the truth."""

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
        """Compare the tool error without and with an export."""
        commands = [commands_of(trial.passes) for trial in self._trials]
        after = [trial.errors(lengths) for trial, lengths in zip(self._trials, commands, strict=True)]
        level, *tilted = (Comparison.of(*pair) for pair in zip(self._before, after, strict=True))
        grown = [_grown(self._trials[0], commands[0], after[0], readings) for readings in (WARMER, DAMPER)]
        return ExportCheck(level, tilted[0] if tilted else None, Size.of(after[0].field_share), *grown)


def _grown(trial: Trial, commands: np.ndarray, driven: ToolErrors, readings: dict[str, float]) -> Size | None:
    """Return how far readings of the sensors move the tool, None where nothing grows by them."""
    grown = RealMachine(trial.machine.geometry, trial.machine.model, Temperatures(readings))
    if np.array_equal(grown.growth, trial.machine.growth) and all(
        np.array_equal(*joints) for joints in zip(grown.body[:2], trial.machine.body[:2], strict=True)
    ):
        return None
    return Size.of(Trial(grown, trial.passes).errors(commands).displacement - driven.displacement)
