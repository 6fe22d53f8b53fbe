"""How the nodes' DDS is set up, before ROS is initialised in a process."""

from __future__ import annotations

import os

from ..formats.paths import config_folder

PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Where Fast DDS looks for a user's profile: up to version 2 (ROS 2 Jazzy), and from version 3."""

PROFILE = "fastdds.xml"

TAKE_PROFILE_WHOLE = "RMW_FASTRTPS_USE_QOS_FROM_XML"
"""Without it ROS overrules what a profile says of memory."""


def avoid_shared_memory() -> None:
    """Let Fast DDS receive by UDP only, unless the user has a profile of their own.

    A process killed while it holds a lock in the shared memory of another stalls that other for seconds.
    The environment of this process, and so of its children, is changed.
    """
    if not any(os.environ.get(name) for name in PROFILE_VARIABLES):
        os.environ[PROFILE_VARIABLES[0]] = str(config_folder() / PROFILE)
        os.environ.setdefault(TAKE_PROFILE_WHOLE, "1")
