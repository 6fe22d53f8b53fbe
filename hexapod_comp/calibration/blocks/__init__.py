"""The errors that a machine may have, one file each; see doc/architecture.md, "Add an error term"."""

from .backlash import Backlash, BacklashMap
from .block import Block
from .field import FieldDisplacement, FieldReversal, FieldRotation
from .growth import Expansion, Late, Moisture
from .length_map import LengthMap
from .load import Compliance, Friction, LostMotion
from .pitch import Pitch
from .structure import Structure
from .waves import Wave, Wave2, Wave3, Wave4

ERRORS: tuple[type[Block], ...] = (
    Structure,
    Pitch,
    Wave,
    Wave2,
    Wave3,
    Wave4,
    Backlash,
    LengthMap,
    BacklashMap,
    FieldDisplacement,
    FieldRotation,
    FieldReversal,
    Expansion,
    Moisture,
    Late,
    Compliance,
    LostMotion,
    Friction,
)
"""The registry: all blocks, in the order of the parameter vector."""

WAVES = {wave.name: wave.times for wave in (Wave, Wave2, Wave3, Wave4)}
"""Blocks of the screw waves, with the number of periods a turn."""

HARMONICS = tuple(name for name, times in WAVES.items() if times > 1)

EXPECTED = ("pitch", "wave", "backlash", "expansion", "moisture", "late", "compliance", "lost motion", "friction")
"""Errors that every screw has, and growth; a length map, wear or a field need not exist."""
