"""A hexapod in LinuxCNC: the bridge to the compensator, and the machine behind the simulated drives."""
