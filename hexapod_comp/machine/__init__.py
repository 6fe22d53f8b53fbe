"""The machine: geometry, limits, kinematics, and the model of the real machine's deviations from the geometry."""
