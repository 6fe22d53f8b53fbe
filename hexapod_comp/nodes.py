"""Alias of :mod:`hexapod_comp.ros` from version 0.2, kept for one version: its modules can be imported from here."""

import sys

from . import ros

# The package itself, since its modules import names from their parent, which is this module
sys.modules[__name__] = ros
