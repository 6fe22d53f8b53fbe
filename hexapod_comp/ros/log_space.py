"""Whether there is room for the log: nobody but the nodes can say that nothing is written any more."""

from __future__ import annotations

import os
from pathlib import Path

from rclpy.logging import get_logging_directory

LEAST_ROOM = 65_536
"""A file system with less than this, byte, is full: a few hundred lines."""


class LogSpace:
    """Watches the file system of ROS's log folder.

    Parameters
    ----------
    folder : Path, optional
        ROS's log folder by default.

    Attributes
    ----------
    problem : str
        What is wrong, empty while there is room.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = Path(get_logging_directory()) if folder is None else folder
        self.problem = ""

    def look(self) -> None:
        """Look again; takes a few microseconds on a local file system."""
        self.problem = ""
        try:
            usage = os.statvfs(self._folder)
        except FileNotFoundError:
            return  # nothing is logged to files
        except OSError as error:
            self.problem = f"log folder lost: {error.strerror}"
            return
        full = usage.f_bavail * usage.f_frsize < LEAST_ROOM
        self.problem = f"log disk full: {self._folder}" if full else ""
