"""How the nodes' DDS is set up; must be done before ROS is initialised in a process."""

from __future__ import annotations

import contextlib
import ctypes
import os

from ..formats.paths import config_folder

PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Where Fast DDS looks for a user's profile: up to version 2 (ROS 2 Jazzy), and from version 3."""

PROFILE = "fastdds.xml"

TAKE_PROFILE_WHOLE = "RMW_FASTRTPS_USE_QOS_FROM_XML"
"""Without it ROS overrules what a profile says of memory."""

M_MMAP_THRESHOLD, LARGEST_KEPT = -3, 1 << 20
"""Parameter of glibc's ``mallopt``; blocks from this size on, byte, go back to the system when they are freed. Left
alone, the threshold grows with the largest block that was ever freed, and long messages leave holes in the heap."""


def avoid_shared_memory() -> None:
    """Let Fast DDS receive by UDP only, unless the user has a profile of their own.

    A process killed while it holds a lock in the shared memory of another stalls that other for seconds.
    The environment of this process, and so of its children, is changed.
    """
    if not any(os.environ.get(name) for name in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[0]] = str(config_folder() / PROFILE)
        os.environ.setdefault(TAKE_PROFILE_WHOLE, "1")


def give_memory_back() -> None:
    """Let large blocks go back to the system at once, where the C library is glibc."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)
