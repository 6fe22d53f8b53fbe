"""A hexapod in LinuxCNC: the bridge to the compensator, and the machine behind the simulated drives."""

from __future__ import annotations

from ..ros import start


def start_bridge() -> int:
    """Run the executable ``linuxcnc_bridge``."""
    return start("hexapod_comp.linuxcnc.bridge")


def start_machine() -> int:
    """Run the executable ``linuxcnc_machine``."""
    return start("hexapod_comp.linuxcnc.machine")
