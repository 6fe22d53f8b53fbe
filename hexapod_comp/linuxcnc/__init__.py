"""LinuxCNC components: the bridge to the compensator, and a simulated machine with hidden errors."""

from functools import partial

from ..ros import start

start_bridge, start_machine = (partial(start, f"{__name__}.{part}") for part in ("bridge", "machine"))
