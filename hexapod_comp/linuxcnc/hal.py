"""Components of LinuxCNC's hardware abstraction layer (HAL) in this package's Python, whichever that is.

Debian's LinuxCNC brings a module ``hal`` for Debian's Python 3. It loads into any CPython of the same version;
where that is an environment of its own, the module is found in Debian's folder without letting the other
packages there (an old NumPy) in.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import math
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from ..errors import HexapodError

DEBIAN_PACKAGES = Path("/usr/lib/python3/dist-packages")  # where Debian's LinuxCNC puts its Python modules
METRES = {"mm": 1e-3, "inch": 0.0254}  # LinuxCNC's length units, m
COUNTS = 2**32  # a u32 pin goes on from zero after this many


class HalError(HexapodError):
    """LinuxCNC's HAL is not installed, or refuses a request."""

    reason = "hal"


def load_module(name: str = "hal") -> ModuleType:
    """Import one of LinuxCNC's Python modules."""
    with _own_signals():
        return _import(name)


@contextmanager
def _own_signals() -> Iterator[None]:
    """Keep this process's handling of SIGTERM: importing ``hal`` makes it a KeyboardInterrupt, anywhere."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)


def _import(name: str) -> ModuleType:
    with suppress(ImportError):
        return importlib.import_module(name)
    # At the end, and only for now: in front of the environment's own folders it would replace NumPy.
    sys.path.append(folder := str(DEBIAN_PACKAGES))
    importlib.invalidate_caches()
    try:
        return importlib.import_module(name)
    except ImportError as error:
        files = [file for form in (f"_{name}.*.so", f"{name}.*.so") for file in DEBIAN_PACKAGES.glob(form)]
        if built := sorted(file.name.split(".")[1] for file in files):
            here = f"CPython {sys.version_info.major}.{sys.version_info.minor}"
            problem = f"in {DEBIAN_PACKAGES} is built for {', '.join(built)}, this is {here}"
        else:
            problem = (
                f"is neither on this Python's path nor in {DEBIAN_PACKAGES}: install LinuxCNC "
                "(Debian: apt install linuxcnc-uspace), or set PYTHONPATH to its lib/python"
            )
        raise HalError(f"LinuxCNC's Python module {name!r} {problem}") from error
    finally:
        sys.path.remove(folder)


def pins(direction: str, kind: str, *names: str) -> dict[str, tuple[str, str]]:
    """Return direction (in, out) and type (float, bit, s32, u32) of some pins, by name."""
    return dict.fromkeys(names, (direction, kind))


class HalComponent:
    """A userspace HAL component; its pins exist from the start, :meth:`ready` lets ``loadusr -W`` go on."""

    def __init__(self, name: str, wanted: Mapping[str, tuple[str, str]], hal: Any = None) -> None:
        hal = load_module() if hal is None else hal
        self._pins: dict[str, Any] = {}
        try:
            self._component = hal.component(name)
            for pin, words in wanted.items():
                direction, kind = (getattr(hal, f"HAL_{word.upper()}") for word in words)
                self._pins[pin] = self._component.newpin(pin, kind, direction)
        except (hal.error, ValueError, RuntimeError) as error:
            raise HalError(f"HAL refuses the component {name!r}: {error}") from error

    def reader(self, *names: str) -> Callable[[], list[Any]]:
        """Return a fast function that reads some pins."""
        gets = [self._pins[name].get for name in names]
        return lambda: [get() for get in gets]

    def writer(self, *names: str) -> Callable[[Sequence[Any]], None]:
        """Return a fast function that writes some pins; counters must be below :data:`COUNTS`."""
        sets = [self._pins[name].set for name in names]

        def write(values: Sequence[Any]) -> None:
            for put, value in zip(sets, values, strict=True):
                put(value)

        return write

    def ready(self) -> None:
        self._component.ready()

    def exit(self) -> None:
        """Leave the HAL; the pins are gone, signals keep their last values."""
        self._component.exit()


def quaternion_from_axes(a: float, b: float, c: float) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of LinuxCNC's rotary axes: R = Rz(C)·Ry(B)·Rx(A) (genhexkins)."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(half), math.sin(half)) for half in (math.radians(0.5 * angle) for angle in (a, b, c))
    )
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def pose_from_axes(
    x: float, y: float, z: float, a: float, b: float, c: float, tool_offset: float = 0.0
) -> tuple[float, float, float, float, float, float, float]:
    """Return position and unit quaternion (x, y, z, w) of the platform that LinuxCNC's genhexkins commands."""
    i, j, k, w = quaternion_from_axes(a, b, c)
    return (
        x + tool_offset * 2.0 * (i * k + w * j),
        y + tool_offset * 2.0 * (j * k - w * i),
        z - tool_offset * 2.0 * (i * i + j * j),
        i,
        j,
        k,
        w,
    )


LIBRARY = "liblinuxcnchal.so.0"

ROW = re.compile(r"^\s*(\d+)\s+User\s+(\S+)\s+(\d+)\s", re.MULTILINE)  # `halcmd show comp`: number, type, name, process


def dead_components(listing: str, name: str) -> list[int]:
    rows = ROW.findall(listing)
    return [int(number) for number, known, pid in rows if known == name and not _is_alive(int(pid))]


def _is_alive(pid: int) -> bool:
    """Return whether a process runs; one that has ended, and whose parent has not asked for its exit code, does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
            return file.read().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return True


def remove(number: int) -> None:
    library = ctypes.CDLL(LIBRARY)
    # Whoever calls hal_exit must have entered HAL. The entry itself stays behind, a name without pins: one
    # process can take one component away, and this one spends that on the dead one.
    if library.hal_init(f"hal_sweep-{os.getpid()}".encode()) < 0:
        raise OSError("there is no running HAL to enter")
    code = library.hal_exit(number)
    if code:
        raise OSError(-code, "hal_exit refused")


def main(argv: Sequence[str] | None = None) -> int:
    """Remove the HAL component that a dead process has left under a name; the entry of the executable ``hal_sweep``."""
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
