"""The machine: geometry, limits, kinematics, and the model of what the real one does differently."""
