"""Take a dead process's HAL component away, so that its successor can have the name.

A userspace component that is killed stays in LinuxCNC's HAL, pins and all, until LinuxCNC ends: a new process
of that name is refused, and ``loadusr -W`` takes the dead component for ready. LinuxCNC has no command for
this; its library's ``hal_exit`` takes any component's number, and frees it with its pins.

Run it from a HAL file, ahead of loadusr: ``loadusr -w hal_sweep hexapod_comp``. A living process's component is
left alone.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import re
import subprocess
import sys
from collections.abc import Sequence

LIBRARY = "liblinuxcnchal.so.0"

ROW = re.compile(r"^\s*(\d+)\s+User\s+(\S+)\s+(\d+)\s", re.MULTILINE)
"""``halcmd show comp``: number, type, name, process."""


def dead_components(listing: str, name: str) -> list[int]:
    """Return the numbers of components of a name whose process is gone."""
    rows = ROW.findall(listing)
    return [int(number) for number, known, pid in rows if known == name and not _is_alive(int(pid))]


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return not _is_zombie(pid)


def _is_zombie(pid: int) -> bool:
    """Return whether a process has ended, and its parent has not asked for its exit code."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
            return file.read().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return False


def remove(number: int) -> None:
    """Free a component."""
    library = ctypes.CDLL(LIBRARY)
    # Whoever calls hal_exit must have entered HAL. The entry itself stays behind, a name without pins: one
    # process can take one component away, and this one spends that on the dead one.
    if library.hal_init(f"hal_sweep-{os.getpid()}".encode()) < 0:
        raise OSError("there is no running HAL to enter")
    code = library.hal_exit(number)
    if code:
        raise OSError(-code, "hal_exit refused")


def main(argv: Sequence[str] | None = None) -> int:
    """Free what a dead process has left under a name; the entry of the executable ``hal_sweep``."""
    parser = argparse.ArgumentParser(prog="hal_sweep", description="Free the HAL component of a dead process.")
    parser.add_argument("name", help="of the component, e.g. hexapod_comp")
    name = parser.parse_args(argv).name
    try:
        listing = subprocess.run(["halcmd", "show", "comp"], check=True, capture_output=True, text=True).stdout
        for number in dead_components(listing, name):
            remove(number)
            print(f"hal_sweep: component {name} of a dead process removed", file=sys.stderr)
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"hal_sweep: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
