"""The fault campaign: a moving machine, one or two faults per episode, and a judge.

Usage: python -m benchmarks.faults [--mover] [--episodes 300] [--seed 0] [--only 17,kill_drive]

Every miss is printed with what runs it alone. Exits with 1 when a bar is missed.
"""

import sys

from .campaign import main

if __name__ == "__main__":
    sys.exit(main(__doc__))
