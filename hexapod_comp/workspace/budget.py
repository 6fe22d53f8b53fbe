"""Error budgets: sizes of the types of machine errors, the budget file, and single errors (Daake et al.)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import ModelError
from ..formats.paths import input_file
from ..formats.schema import file_errors
from ..formats.yaml import read_yaml
from ..machine.geometry import HexapodGeometry, first_of_same

BUDGET_FORMAT = "hexapod_comp/error_budget"
BUDGET_VERSION = 1
LENGTH, BASE_JOINT, PLATFORM_JOINT, TOOL = range(4)  # part of the machine that a single error changes
AXES = ("x", "y", "z")
LARGEST = 0.1  # m or relative; a larger size is probably in a wrong unit


@dataclass(frozen=True)
class SingleErrors:
    """E single errors, whose effects the study computes one by one."""

    kind: np.ndarray  # (E,): index into `kinds`
    part: np.ndarray  # (E,): LENGTH, BASE_JOINT, PLATFORM_JOINT or TOOL
    # (E, 6): whether the error changes a strut's length or end; a platform joint may belong to two struts
    struts: np.ndarray
    # (E, 3): displacement of a joint or of the tool in base or platform, m; or coefficients a, b, c of the length error
    # δL = a + b·(L − L_home) + c·L of a strut of length L
    vector: np.ndarray
    kinds: tuple[str, ...]  # names of the error types, in the budget's order
    labels: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.kind)

    def select(self, mask: np.ndarray) -> SingleErrors:
        chosen = np.flatnonzero(mask)
        labels = tuple(self.labels[i] for i in chosen)
        return SingleErrors(
            self.kind[chosen], self.part[chosen], self.struts[chosen], self.vector[chosen], self.kinds, labels
        )


@dataclass(frozen=True)
class SourceType:
    """A type of error in a budget: single errors of equal size, one for each part (strut, joint or tool) and axis."""

    name: str  # key in the budget file without its unit
    dimension: str  # length or ratio
    title: str  # name in reports
    part: int  # LENGTH, BASE_JOINT, PLATFORM_JOINT or TOOL
    axes: tuple[int, ...]  # components of `SingleErrors.vector`, one for each single error of a part
    factor: float = 1.0  # size of a single error divided by the size in the budget

    def rows(self, size: float, joints: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray, str]]:
        """Yield the fields part, struts, vector and label of `SingleErrors` for each single error.

        `size` is the size in the budget, m or relative. `joints[n]`, (6,), is True for the struts
        that end in platform joint n.
        """
        for struts in {PLATFORM_JOINT: joints, TOOL: NO_STRUT}.get(self.part, EACH):
            numbers = "/".join(str(strut + 1) for strut in np.flatnonzero(struts))
            where = ("strut_{}", "base joint {} ", "platform joint {} ", "tool ")[self.part].format(numbers)
            for axis in self.axes:
                vector = self.factor * size * np.eye(3)[axis]
                yield self.part, struts, vector, where if self.part == LENGTH else where + AXES[axis]


EACH, NO_STRUT = np.eye(6, dtype=bool), np.zeros((1, 6), dtype=bool)

# Error types. `screw_pitch` is the largest length error, as in Daake et al.; `screw_pitch_slope` is the error over
# the length from home. A backlash b changes a strut's length by ± b/2. `thermal_growth` is the expansion coefficient
# times the temperature difference.
SOURCE_TYPES = (
    SourceType("strut_length", "length", "strut length", LENGTH, (0,)),
    SourceType("screw_pitch", "length", "screw pitch", LENGTH, (0,)),
    SourceType("screw_pitch_slope", "ratio", "screw pitch slope", LENGTH, (1,)),
    SourceType("quantisation", "length", "quantisation", LENGTH, (0,)),
    SourceType("base_joint_xy", "length", "base joint x/y", BASE_JOINT, (0, 1)),
    SourceType("base_joint_z", "length", "base joint z", BASE_JOINT, (2,)),
    SourceType("platform_joint_xy", "length", "platform joint x/y", PLATFORM_JOINT, (0, 1)),
    SourceType("platform_joint_z", "length", "platform joint z", PLATFORM_JOINT, (2,)),
    SourceType("backlash", "length", "backlash", LENGTH, (0,), 0.5),
    SourceType("thermal_growth", "ratio", "thermal growth", LENGTH, (2,)),
    SourceType("tool_offset", "length", "tool offset", TOOL, (0, 1, 2)),
)

BY_NAME = {source.name: source for source in SOURCE_TYPES}


@dataclass(frozen=True)
class Budget:
    """Sizes of a machine's errors.

    Attributes
    ----------
    machine : str
        Name of the geometry that the budget belongs to.
    sizes : dict of str to float
        Size s of each error type, m or relative, in the file's order; an error lies within ±s.
    """

    machine: str
    sizes: dict[str, float]

    def __post_init__(self) -> None:
        if not self.sizes:
            raise ModelError("errors", "must name at least one error type")
        for name, size in self.sizes.items():
            if name not in BY_NAME:
                raise ModelError(f"errors.{name}", f"must be one of {', '.join(sorted(BY_NAME))}")
            if not 0.0 < size < LARGEST:
                raise ModelError(f"errors.{name}", f"must be above zero and below {LARGEST:g} (m, or relative)", size)

    def single_errors(self, geometry: HexapodGeometry, shared_platform_joints: bool = True) -> SingleErrors:
        """Return the single errors; if `shared_platform_joints`, platform joints at the same point are one joint."""
        if self.machine != geometry.name:
            problem = f"the budget is for {self.machine!r}, the geometry is {geometry.name!r}"
            raise ModelError("machine", f"{problem}; write a budget file for {geometry.name!r}")
        first = first_of_same(geometry.platform_joints) if shared_platform_joints else np.arange(6)
        joints = np.array([first == joint for joint in np.unique(first)])
        rows = [
            (number, *row)
            for number, (name, size) in enumerate(self.sizes.items())
            for row in BY_NAME[name].rows(size, joints)
        ]
        kind, part, struts, vector, labels = zip(*rows, strict=True)
        titles = tuple(BY_NAME[name].title for name in self.sizes)
        return SingleErrors(
            np.array(kind), np.array(part), np.array(struts), np.array(vector, dtype=float), titles, tuple(labels)
        )


def load_budget(path: str | Path) -> Budget:
    """Read a budget file (YAML, see config/error_budget.yaml), or a shipped one by its name.

    Raises
    ------
    InputFileError
        The file cannot be used (unknown type, no unit, negative size); the message names file, key and value.
    """
    path = input_file(path, "error_budget")
    top = read_yaml(path, BUDGET_FORMAT, BUDGET_VERSION)
    machine, section = top.text("machine"), top.section("errors")
    top.finish()
    sizes = {}
    for source in SOURCE_TYPES:
        if section.quantity_key(source.name, source.dimension) is not None:
            sizes[source.name] = float(section.quantity(source.name, source.dimension))
    if unknown := section.remaining():
        known = ", ".join(source.name for source in SOURCE_TYPES)
        problem = f"is not an error type followed by its unit; types are {known}"
        raise section.error(unknown[0], problem, section.require(unknown[0]))
    with file_errors(section):
        return Budget(machine, sizes)
