"""LinuxCNC's own compiled hexapod kinematics, as Debian's linuxcnc-uspace installs it, without LinuxCNC.

The module is loaded beside a small stand-in for the HAL, genhexkins.c, and gets the paper's machine by its pins, in mm
and degrees.
"""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.machine.kinematics import Structure

NAME = "LinuxCNC genhexkins"
# Where Debian puts it; another one by the environment variable GENHEXKINS
MODULE = Path("/usr/lib/linuxcnc/modules/genhexkins.so")
MM = 1e-3
# Its own default: it ends when every strut was right to this, mm, before the last step. Its steps shrink by a
# constant factor each, so its answers are about as good as this; ours converges quadratically.
CRITERION = 1e-9
ANY_ERROR = 1e9  # Its default refuses a guess whose struts are off by 500 mm altogether; here it may try
POSE, STRUTS = 9, 6


class NotHere(Exception):
    """There is no module to compare with; says why."""


@functools.cache
def _load() -> tuple[ctypes.CDLL, ctypes.CDLL]:
    """Return stand-in and module, loaded once per process."""
    path = Path(os.environ.get("GENHEXKINS", MODULE))
    if not path.is_file():
        raise NotHere(f"{NAME}: no {path}; on Debian: apt-get install linuxcnc-uspace")
    compiler = shutil.which("cc")
    if compiler is None:
        raise NotHere(f"{NAME}: no C compiler (cc) for the stand-in for its HAL")
    with tempfile.TemporaryDirectory() as folder:
        library, source = Path(folder) / "stand_in.so", Path(__file__).with_suffix(".c")
        done = subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", "-o", library, source], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise NotHere(f"{NAME}: the stand-in for its HAL does not compile: {done.stderr.strip()}")
        stand_in = ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)
        try:
            module = ctypes.CDLL(str(path))
        except OSError as error:
            raise NotHere(f"{NAME}: cannot be loaded: {error}") from error
    stand_in.pin_value.restype = ctypes.c_void_p
    stand_in.forward_many.restype = stand_in.inverse_many.restype = ctypes.c_double
    if module.rtapi_app_main() != 0:
        raise NotHere(f"{NAME}: does not start")
    return stand_in, module


def emc_poses(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return poses (N, 3), m, and (N, 3, 3) as LinuxCNC has them: x y z, mm, a b c, degrees, u v w; (N, 9)."""
    poses = np.zeros((len(positions), POSE))
    poses[:, :3] = positions / MM
    poses[:, 3:6] = Rotation.from_matrix(rotations).as_euler("xyz", degrees=True)  # R = Rz(c)·Ry(b)·Rx(a)
    return poses


def si_poses(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, m, and rotations of LinuxCNC's poses."""
    return poses[:, :3] * MM, Rotation.from_euler("xyz", poses[:, 3:6], degrees=True).as_matrix()


class Genhexkins:
    """The module with a machine's joints on its pins."""

    def __init__(self, structure: Structure) -> None:
        self.stand_in, self.module = _load()
        for pin, joints in (("base", structure.base_joints), ("platform", structure.platform_joints)):
            for number, joint in enumerate(joints / MM):
                for axis, value in zip("xyz", joint, strict=True):
                    self.set(f"{pin}.{number}.{axis}", value)
        self.set("max-error", ANY_ERROR)
        self.set("convergence-criterion", CRITERION)
        guess = np.array([[0.0, 0.0, 1e3 * structure.characteristic_length, *np.zeros(6)]])
        self.solved(np.full((1, STRUTS), structure.characteristic_length), guess)  # the first call after loading fails

    def set(self, pin: str, value: float) -> None:
        address = self.stand_in.pin_value(f"genhexkins.{pin}".encode())
        if address is None:
            raise NotHere(f"{NAME}: has no pin {pin}")
        ctypes.c_double.from_address(address).value = value

    def forward(self, lengths: np.ndarray, guesses: np.ndarray, poses: np.ndarray, codes: np.ndarray) -> float:
        """Solve (N, 6) lengths, mm, from guesses (N, 9) or (1, 9) into `poses`, `codes`; return the time it took, s."""
        step = POSE if len(guesses) > 1 else 0
        return self.stand_in.forward_many(
            self.module.kinematicsForward,
            ctypes.c_long(len(lengths)),
            pointer(lengths),
            pointer(guesses),
            ctypes.c_long(step),
            pointer(poses),
            pointer(codes),
        )

    def inverse(self, poses: np.ndarray, lengths: np.ndarray, codes: np.ndarray) -> float:
        """Write the lengths, mm, of (N, 9) poses; return the time it took, s."""
        count = ctypes.c_long(len(poses))
        arrays = pointer(poses), pointer(lengths), pointer(codes)
        return self.stand_in.inverse_many(self.module.kinematicsInverse, count, *arrays)

    def one_call(self, inverse: bool) -> Callable[..., int]:
        """Return a function of the module for single calls from Python, with addresses."""
        function = self.module.kinematicsInverse if inverse else self.module.kinematicsForward
        function.argtypes = [ctypes.c_void_p] * 4
        return function

    @staticmethod
    def addresses(given: np.ndarray, found: np.ndarray, flags: np.ndarray) -> list[tuple[int, int, int, int]]:
        """Return the four arguments of one call per row, ready: looking them up is not counted."""
        rows = zip(given, found, strict=True)
        return [(row.ctypes.data, to.ctypes.data, flags.ctypes.data, flags.ctypes.data + 8) for row, to in rows]

    def solved(self, lengths: np.ndarray, guesses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return codes (N,), 0 for success, and poses (N, 9) for lengths (N, 6), m, from guesses (N, 9)."""
        poses, codes = np.empty((len(lengths), POSE)), np.empty(len(lengths), np.int32)
        self.forward(np.ascontiguousarray(lengths / MM), guesses, poses, codes)
        return codes, poses


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)
