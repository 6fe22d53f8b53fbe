"""The ROS side: nodes and what they share. Started without Numba, a program ends with one line that says so."""

import sys

try:
    from ..kernels import compiling  # noqa: F401
except ImportError as error:
    sys.exit(f"cannot start: {error}")
