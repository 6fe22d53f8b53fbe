"""Export of a ros2_control package for one machine: a controller around the C core, and three configurations.

``within.yaml``: the controller compensates strut lengths that another controller plans; ``below.yaml``: the compensator
node takes the place of the hardware; ``before.yaml``: the node commands a forward_command_controller.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputFileError
from ..formats.outputs import make_folder, write_text
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.model import MachineModel
from ..machine.robot_description import HEAD, MOCK, urdf
from .c_code import write_c

# Folder of templates; each ``@NAME@`` in a template is replaced by the machine's value
TEMPLATES = Path(__file__).parent / "ros2_control"
CHAINED = "compensation"  # Name of the controller in ``within.yaml``, and prefix of its joints' names
TOLERANCE = 0.75
"""A controller aborts a goal if a strut lags by this share of the limit `step`, and then commands the measured lengths.
With a share above 1 these commands would break the limit."""

LAG = 0.02  # Assumed delay of the drives, s


def write_ros2_control(
    folder: str | Path,
    geometry: HexapodGeometry,
    model: MachineModel,
    hashes: tuple[str, str],
    rate: int,
    joint_names: Sequence[str] = STRUT_NAMES,
) -> list[Path]:
    """Write an ament_cmake package into a folder; return the files."""
    folder = Path(folder)
    written = write_c(folder / "core", geometry, model, hashes)
    values = _values(geometry, model, rate, joint_names)
    files = {folder / "urdf" / "machine.urdf": urdf(geometry, joint_names, hardware=MOCK).removeprefix(HEAD)}
    for template in sorted(TEMPLATES.iterdir()):
        place = folder / "config" if template.suffix == ".yaml" else folder
        files[place / template.name] = filled(template.read_text(encoding="utf-8"), values)
    for path, text in files.items():
        make_folder(path.parent)
        write_text(path, text)
    return [*written, *files]


def package_name(machine: str) -> str:
    """Return the package's name: the machine's name reduced to lower case letters, digits and _, with a suffix."""
    plain = re.sub(r"[^a-z0-9]+", "_", machine.lower()).strip("_")
    if not plain:
        problem = f"the machine's name {machine!r} has no letter a-z and no digit for the package's name"
        raise InputFileError("export", "--ros2-control", problem)
    return ("" if plain[0].isalpha() else "machine_") + plain + "_compensation"


def filled(template: str, values: dict[str, str]) -> str:
    """Return a template with its values in place of each ``@NAME@``."""
    return re.sub(r"@([A-Z_]+)@", lambda name: values[name[1]], template)


def _values(geometry: HexapodGeometry, model: MachineModel, rate: int, joint_names: Sequence[str]) -> dict[str, str]:
    """Return the text for each ``@NAME@`` in the templates, by NAME."""
    chained = [f"{CHAINED}/{name}" for name in joint_names]
    plain = {"MACHINE": geometry.name, "MODEL": model.name}
    return {
        # Only characters that are safe in XML and YAML
        **{key: re.sub(r"[^\w .,:()+-]", "_", value) for key, value in plain.items()},
        "PACKAGE": package_name(geometry.name),
        "RATE": str(rate),
        "JOINTS": f"[{', '.join(joint_names)}]",
        "CHAINED": f"[{', '.join(chained)}]",
        "CONSTRAINTS": _constraints(geometry, rate, joint_names),
        "CHAINED_CONSTRAINTS": _constraints(geometry, rate, chained),
    }


def _constraints(geometry: HexapodGeometry, rate: int, joints: Sequence[str]) -> str:
    """Return the lines of a controller's configuration that abort a goal if a strut lags; see `TOLERANCE`."""
    step, speed = geometry.limits.step, geometry.limits.speed
    tolerance = TOLERANCE * step
    fastest = min(speed, step * rate, tolerance / (LAG + 1.0 / rate))
    lines = [
        "# trajectory: distance of a strut from its setpoint, m, at which the controller aborts a goal and holds the",
        f"# struts (less than the machine's step_mm, {step * 1e3:g}). Drives with a delay of {LAG * 1e3:g} ms "
        f"lag by this distance at {fastest * 1e3:.3g} mm/s: plan slower",
        "# trajectories. Give velocities with the setpoints: without velocities the speed jumps at each setpoint.",
        "constraints:",
        "  goal_time: 1.0                     # s",
        "  stopped_velocity_tolerance: 0.0    # 0: no check, because encoder positions change in steps",
        *(f"  {joint}: {{trajectory: {tolerance:.9g}}}" for joint in joints),
    ]
    return "\n".join("    " + line for line in lines)
