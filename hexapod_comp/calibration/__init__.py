"""From readings to a machine model, and how accurate that model is."""
