"""Display of a machine: workspace shells as markers for RViz and Foxglove, and the live page of ``watch`` (viser)."""
