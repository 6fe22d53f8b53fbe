"""From readings to a machine model, and what that model is worth."""
