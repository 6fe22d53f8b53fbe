"""The computation of compensated strut commands from tool poses, and the checks before a move."""
