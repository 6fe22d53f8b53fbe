"""The ROS side: nodes and what they share. Started without Numba, a program ends with one line that says so."""

import sys

from ..errors import MissingPackageError

try:
    from ..kernels import compiling  # noqa: F401
except MissingPackageError as error:
    sys.exit(f"cannot start: {error}")
