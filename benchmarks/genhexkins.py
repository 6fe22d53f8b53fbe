"""LinuxCNC's own compiled hexapod kinematics, as Debian's linuxcnc-uspace installs it, without LinuxCNC.

The module is loaded beside a small stand-in for the HAL (genhexkins.c, ours, compiled into a temporary folder), and
gets the paper's machine by its pins, in mm and degrees as LinuxCNC has them. Who has no such module, or no C
compiler, is told so and goes without.
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

from .peers import STEP_TOLERANCE
from .poses import NEAR, WIDE, Contender, Poses, joined

NAME = "LinuxCNC genhexkins"
LOOSE, SECOND = f"{NAME}, to 1e-8 m", f"{NAME}: second solve"
# Where Debian puts it; another one by the environment variable GENHEXKINS
MODULE = Path("/usr/lib/linuxcnc/modules/genhexkins.so")

MM = 1e-3
# Its own default: it ends when every strut was right to this, mm, before the last step. Its steps shrink by a
# constant factor each, so its answers are about as good as this; ours converges quadratically.
CRITERION = 1e-9

# What ours calls a last step, 1e-8 m, mm: genhexkins is quicker with it, and its answers are worse
LOOSE_CRITERION = STEP_TOLERANCE / MM

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
        self.criterion(CRITERION)
        guess = np.array([[0.0, 0.0, 1e3 * structure.characteristic_length, *np.zeros(6)]])
        self.solved(np.full((1, STRUTS), structure.characteristic_length), guess)  # the first call after loading fails

    def criterion(self, largest: float) -> None:
        """Set when it ends, mm."""
        self.set("convergence-criterion", largest)

    def set(self, pin: str, value: float) -> None:
        """Set a pin, as setp does."""
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

    def solved(self, lengths: np.ndarray, guesses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return codes (N,), 0 for success, and poses (N, 9) for lengths (N, 6), m, from guesses (N, 9)."""
        poses, codes = np.empty((len(lengths), POSE)), np.empty(len(lengths), np.int32)
        self.forward(np.ascontiguousarray(lengths / MM), guesses, poses, codes)
        return codes, poses


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


# --- taking part in benchmarks.kernels ---------------------------------------------------------------------


def contenders(single: Poses, batch: Poses, near_single: Poses, near: Poses) -> list[Contender]:
    """Return genhexkins' runs: batches in C loops that time themselves, single calls from Python by ctypes."""
    module, found = Genhexkins(batch.structure), []
    for shape, wide, close in (("batch", batch, near), ("single", single, near_single)):
        found.append(_inverse(module, wide, shape))
        for criterion in (CRITERION, LOOSE_CRITERION):
            found += [_forward(module, WIDE, wide, shape, criterion), _forward(module, NEAR, close, shape, criterion)]
    return [*found, _second_solve(module, near)]


def _inverse(module: Genhexkins, poses: Poses, shape: str) -> Contender:
    told, count = emc_poses(poses.positions, poses.rotations), len(poses.positions)
    lengths, codes, flags = np.empty((count, STRUTS)), np.empty(count, np.int32), np.zeros(2, np.uint64)
    inverse, calls = _caller(module.module.kinematicsInverse), _addresses(told, lengths, flags)

    def one_by_one(kept: tuple = (told, flags)) -> None:  # whose addresses are used
        for call in calls:
            inverse(*call)

    run = one_by_one if shape == "single" else functools.partial(module.inverse, told, lengths, codes)
    return Contender("inverse", NAME, shape, count, run, lambda: lengths * MM)


def _forward(module: Genhexkins, task: str, poses: Poses, shape: str, criterion: float) -> Contender:
    count, lengths = len(poses.lengths), poses.lengths / MM
    home = emc_poses(poses.home.position[None], poses.home.rotation[None])
    found, codes, flags = np.empty((count, POSE)), np.empty(count, np.int32), np.zeros(2, np.uint64)
    forward, calls = _caller(module.module.kinematicsForward), _addresses(lengths, found, flags)

    def many() -> float:
        module.criterion(criterion)
        return module.forward(lengths, home, found, codes)

    def one_by_one(kept: tuple = (lengths, flags)) -> None:  # whose addresses are used
        module.criterion(criterion)
        found[:] = home
        codes[:] = [forward(*call) for call in calls]

    name, run = NAME if criterion == CRITERION else LOOSE, one_by_one if shape == "single" else many
    return Contender(task, name, shape, count, run, lambda: _checked(found, codes))


def _second_solve(module: Genhexkins, poses: Poses) -> Contender:
    """Time what each call spends on a second solution, from the first, for the pins of its display.

    Started at the solution, both solutions of a call take one iteration: half the time is the second one's.
    """
    count, lengths, told = len(poses.lengths), poses.lengths / MM, emc_poses(poses.positions, poses.rotations)
    found, codes = np.empty((count, POSE)), np.empty(count, np.int32)

    def run() -> float:
        module.criterion(CRITERION)
        return 0.5 * module.forward(lengths, told, found, codes)

    return Contender(NEAR, SECOND, "batch", count, run, lambda: _checked(found, codes))


def _checked(poses: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return poses for comparison; those that it did not solve hold NaN."""
    return np.where(codes[:, None] == 0, joined(*si_poses(np.where(codes[:, None] == 0, poses, 0.0))), np.nan)


def _caller(function: Callable[..., int]) -> Callable[..., int]:
    """Return a function of the module for calls from Python with addresses."""
    function.argtypes = [ctypes.c_void_p] * 4  # type: ignore[attr-defined]
    return function


def _addresses(given: np.ndarray, found: np.ndarray, flags: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Return the four arguments of one call per row, ready: looking them up is not counted."""
    rows = zip(given, found, strict=True)
    return [(row.ctypes.data, to.ctypes.data, flags.ctypes.data, flags.ctypes.data + 8) for row, to in rows]
