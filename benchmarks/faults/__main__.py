"""The fault campaign: a moving machine, one or two injected faults per episode, and an independent judge.

Usage: python -m benchmarks.faults [--mover] [--episodes 300] [--seed 0] [--only 17,kill_drive]

Every missed target is printed with the options that run its episode alone. Exit code 1: a target is missed.
"""

import sys

from .campaign import main

if __name__ == "__main__":
    sys.exit(main(__doc__))
