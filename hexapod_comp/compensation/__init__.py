"""From a commanded tool pose to compensated strut commands, and the checks before a move."""
