"""LinuxCNC's compiled hexapod kinematics, genhexkins, from Debian's package linuxcnc-uspace, run without LinuxCNC.

genhexkins.c replaces the HAL, on whose pins the module reads a machine in mm and degrees.
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
# Path in Debian; the environment variable GENHEXKINS gives another path
MODULE = Path("/usr/lib/linuxcnc/modules/genhexkins.so")
MM = 1e-3
# mm, genhexkins' default: the iteration ends when every strut's error was below this before the last step. The errors
# shrink by a constant factor per step, so the result is about as accurate; the package converges quadratically.
CRITERION = 1e-9
ANY_ERROR = 1e9  # limit of a guess' summed strut errors, mm; genhexkins' default of 500 mm would refuse guesses
POSE, STRUTS = 9, 6


class NotHere(Exception):
    """genhexkins cannot be loaded."""


@functools.cache
def _load() -> tuple[ctypes.CDLL, ctypes.CDLL]:
    """Load the replacement of the HAL and the module, once per process."""
    path = Path(os.environ.get("GENHEXKINS", MODULE))
    if not path.is_file():
        raise NotHere(f"{NAME}: {path} is missing; on Debian: apt-get install linuxcnc-uspace")
    compiler = shutil.which("cc")
    if compiler is None:
        raise NotHere(f"{NAME}: no C compiler (cc) for the replacement of the HAL")
    with tempfile.TemporaryDirectory() as folder:
        library, source = Path(folder) / "stand_in.so", Path(__file__).with_suffix(".c")
        done = subprocess.run(
            [compiler, "-O2", "-shared", "-fPIC", "-o", library, source], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise NotHere(f"{NAME}: the replacement of the HAL does not compile: {done.stderr.strip()}")
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
    """Convert poses, (N, 3), m, and (N, 3, 3), to LinuxCNC's, (N, 9): x y z, mm, a b c, degrees, u v w (zero)."""
    poses = np.zeros((len(positions), POSE))
    poses[:, :3] = positions / MM
    poses[:, 3:6] = Rotation.from_matrix(rotations).as_euler("xyz", degrees=True)  # R = Rz(c)·Ry(b)·Rx(a)
    return poses


def si_poses(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, m, and rotation matrices of LinuxCNC's poses."""
    return poses[:, :3] * MM, Rotation.from_euler("xyz", poses[:, 3:6], degrees=True).as_matrix()


class Genhexkins:
    """The module genhexkins with a machine's joint positions on its pins."""

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
        """Solve lengths (N, 6), mm, from guesses (N, 9) or (1, 9) into `poses` and `codes`; return the time, s."""
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
        """Compute the strut lengths, mm, of poses (N, 9) into `lengths`; return the time, s."""
        count = ctypes.c_long(len(poses))
        arrays = pointer(poses), pointer(lengths), pointer(codes)
        return self.stand_in.inverse_many(self.module.kinematicsInverse, count, *arrays)

    def one_call(self, inverse: bool) -> Callable[..., int]:
        """Return the module's function for single calls from Python; its arguments are addresses."""
        function = self.module.kinematicsInverse if inverse else self.module.kinematicsForward
        function.argtypes = [ctypes.c_void_p] * 4
        return function

    @staticmethod
    def addresses(given: np.ndarray, found: np.ndarray, flags: np.ndarray) -> list[tuple[int, int, int, int]]:
        """Return the four addresses for the call of each row, so that a timed call need not compute them."""
        rows = zip(given, found, strict=True)
        return [(row.ctypes.data, to.ctypes.data, flags.ctypes.data, flags.ctypes.data + 8) for row, to in rows]

    def solved(self, lengths: np.ndarray, guesses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solve lengths (N, 6), m, from guesses (N, 9); return codes (N,), 0 for success, and poses (N, 9)."""
        poses, codes = np.empty((len(lengths), POSE)), np.empty(len(lengths), np.int32)
        self.forward(np.ascontiguousarray(lengths / MM), guesses, poses, codes)
        return codes, poses


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)
