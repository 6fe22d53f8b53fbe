"""From a commanded tool pose to compensated strut commands, and what is checked before a move."""
