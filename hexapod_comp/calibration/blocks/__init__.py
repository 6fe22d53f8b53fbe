"""Registry of the blocks (error terms) that a fit can estimate; doc/architecture.md describes how to add one."""

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
"""All blocks, in the order of their parameters in the parameter vector."""

WAVES = {wave.name: wave.times for wave in (Wave, Wave2, Wave3, Wave4)}
"""Blocks of screw waves: name, and number of periods of the wave per turn of the screw."""

GROUPS = {
    "harmonics": tuple(name for name, times in WAVES.items() if times > 1),
    "field": tuple(block.name for block in (FieldDisplacement, FieldRotation, FieldReversal)),
}
"""Blocks that the option ``--blocks`` names together."""

MAPS = (LengthMap.name, BacklashMap.name, *GROUPS["field"])
"""Blocks of smooth functions of strut length or position, which can also describe mistakes in the readings."""

EXPECTED = tuple(block.name for block in ERRORS if block.name not in (*GROUPS["harmonics"], *MAPS))
"""Blocks of errors that a machine always has if it has the part that causes them."""
