"""A hexapod in LinuxCNC: the bridge to the compensator, and the machine behind the simulated drives."""

from functools import partial

from ..ros import start

start_bridge, start_machine = (partial(start, f"{__name__}.{part}") for part in ("bridge", "machine"))
