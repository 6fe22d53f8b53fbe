"""The disk of the nodes' logs: small, so that it can be filled."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

SIZE = "1m"
"""Of the file system, which is filled to the last byte."""


class LogDisk:
    """A folder for ``ROS_LOG_DIR``, on a small file system of its own where that is permitted.

    Parameters
    ----------
    folder : Path
        Made here.

    Attributes
    ----------
    permitted : bool
        Whether the system let us mount one; else :meth:`fill` must not be called.
    why_not : str
        What the system said.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "hexapod_comp_faults", str(folder)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            self.permitted, self.why_not = done.returncode == 0, done.stderr.strip()
        except OSError as error:
            self.permitted, self.why_not = False, str(error)

    @property
    def _filler(self) -> Path:
        return self.folder / "filler"

    def fill(self) -> None:
        """Fill it: not one more byte."""
        with self._filler.open("wb", buffering=0) as file:
            block = b"\0" * 4096
            while True:
                try:
                    file.write(block)
                except OSError:
                    return

    def clear(self) -> None:
        """Make room again."""
        self._filler.unlink(missing_ok=True)

    def close(self) -> None:
        """Unmount it."""
        if self.permitted:
            subprocess.run(["umount", "--lazy", str(self.folder)], capture_output=True, check=False)


def refusal_to_mount() -> str:
    """Return why no small file system can be mounted here, or nothing if it can."""
    with tempfile.TemporaryDirectory() as folder:
        disk = LogDisk(Path(folder) / "try")
        disk.close()
        return "" if disk.permitted else disk.why_not or "not permitted"
