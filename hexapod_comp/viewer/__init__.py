"""Looking at a machine: markers for RViz and Foxglove, and the live page of ``watch`` (an extra: viser)."""
