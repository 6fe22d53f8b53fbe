"""The name of :mod:`hexapod_comp.ros` in version 0.2; its modules can be imported from here for one version more."""

import sys

from . import ros

# The package itself, since its modules import names from their parent, which is this module
sys.modules[__name__] = ros
