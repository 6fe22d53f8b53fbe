"""ros2_control's package for one machine: a controller around the C core, and configurations of all three wirings.

Within ros2_control the package's own controller compensates, chained below one that plans struts; *below* ros2_control
the compensator node is its hardware, *before* it the node commands a forward_command_controller.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputFileError
from ..formats.outputs import write_text
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.model import MachineModel
from ..machine.robot_description import HEAD, MOCK, urdf
from .c_code import write_c

# The package's files; ``@NAME@`` stands for what differs from machine to machine
TEMPLATES = Path(__file__).parent / "ros2_control"
CHAINED = "compensation"  # Name of the controller in ``within.yaml``: ahead of the joints that it offers
TOLERANCE = 0.75
"""Of the largest step between two commands: a goal that lags by more is aborted. What the controller then holds, where
the struts are, must still be within a step of the last command that was not refused."""

LAG = 0.02  # Of drives, s, for the speed at which a trajectory comes to the tolerance by lag alone


def write_ros2_control(
    folder: str | Path,
    geometry: HexapodGeometry,
    model: MachineModel,
    hashes: tuple[str, str],
    rate: int,
    joint_names: Sequence[str] = STRUT_NAMES,
) -> list[Path]:
    """Write an ament_cmake package into a folder, which is made if it is missing."""
    folder = Path(folder)
    written = write_c(folder / "core", geometry, model, hashes)
    values = _values(geometry, model, rate, joint_names)
    files = {folder / "urdf" / "machine.urdf": urdf(geometry, joint_names, hardware=MOCK).removeprefix(HEAD)}
    for template in sorted(TEMPLATES.iterdir()):
        place = folder / "config" if template.suffix == ".yaml" else folder
        files[place / template.name] = filled(template.read_text(encoding="utf-8"), values)
    for path, text in files.items():
        path.parent.mkdir(exist_ok=True)
        write_text(path, text)
    return [*written, *files]


def package_name(machine: str) -> str:
    """Return the package's name, which ROS wants to be lower case letters, digits and underscores, a letter first."""
    plain = re.sub(r"[^a-z0-9]+", "_", machine.lower()).strip("_")
    if not plain:
        raise InputFileError("export", "--ros2-control", f"no package can be named after machine {machine!r}")
    return ("" if plain[0].isalpha() else "machine_") + plain + "_compensation"


def filled(template: str, values: dict[str, str]) -> str:
    """Return a template with its values."""
    return re.sub(r"@([A-Z_]+)@", lambda name: values[name[1]], template)


def _values(geometry: HexapodGeometry, model: MachineModel, rate: int, joint_names: Sequence[str]) -> dict[str, str]:
    """Return the value of each name in a template."""
    chained = [f"{CHAINED}/{name}" for name in joint_names]
    plain = {"MACHINE": geometry.name, "MODEL": model.name}
    return {
        **{key: re.sub(r"[^\w .,:()+-]", "_", value) for key, value in plain.items()},  # for XML, YAML and comments
        "PACKAGE": package_name(geometry.name),
        "RATE": str(rate),
        "JOINTS": f"[{', '.join(joint_names)}]",
        "CHAINED": f"[{', '.join(chained)}]",
        "CONSTRAINTS": _constraints(geometry, rate, joint_names),
        "CHAINED_CONSTRAINTS": _constraints(geometry, rate, chained),
    }


def _constraints(geometry: HexapodGeometry, rate: int, joints: Sequence[str]) -> str:
    """Return the lines that abort a goal when the struts do not follow, before the holding command would be refused."""
    step, speed = geometry.limits.step, geometry.limits.speed
    tolerance = TOLERANCE * step
    fastest = min(speed, step * rate, tolerance / (LAG + 1.0 / rate))
    lines = [
        "# Abort a goal and hold the struts when one is this far from its setpoint, m: below the",
        f"# machine's step_mm, {step * 1e3:g}. Drives that lag by {LAG * 1e3:g} ms are so far behind at "
        f"{fastest * 1e3:.3g} mm/s: plan trajectories below",
        "# that speed, and with velocities: between positions alone the setpoint's speed jumps.",
        "constraints:",
        "  goal_time: 1.0                     # s",
        "  stopped_velocity_tolerance: 0.0    # of the encoders' steps",
        *(f"  {joint}: {{trajectory: {tolerance:.9g}}}" for joint in joints),
    ]
    return "\n".join("    " + line for line in lines)
