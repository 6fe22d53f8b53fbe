"""The old name of :mod:`hexapod_comp.ros` (version 0.2), by which its modules can be imported for one more version."""

import sys

from . import ros

# The package itself, since its modules import names from their parent, which is this module
sys.modules[__name__] = ros
