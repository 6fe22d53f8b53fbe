"""Benchmark of planned motions and of unattended calibration and repair, on all machines of test/foreign_machines.py.

Usage: python -m benchmarks.adapt [--part moves|unattended] [--moves 1000] [--machines 4] [--first 1]

Parts and targets: doc/benchmarks.md.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.drawn import Table, machines, of_zoo
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.compensation.checks import check
from hexapod_comp.errors import NoAnswerError
from hexapod_comp.loop.story import demo_place
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.path import Motion, StrutRates, plan_motion
from hexapod_comp.pose import Pose
from hexapod_comp.upkeep.loop import Adaptation, Task
from hexapod_comp.virtual.named import imagine
from hexapod_comp.virtual.watched import Instrument, VirtualMachine

RATE = 1000.0  # samples per second of the sent commands, which are differentiated
RATES = StrutRates(0.1, 1.0, 20.0)  # limits of every strut: m/s, m/s², m/s³
OPTIMUM, KEPT = 1.02, 1.0 + 1e-3  # targets: duration / toppra's optimum; speed, acceleration or jerk / its limit
GRID = 1000  # path sections of toppra's optimum


def struts(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the strut lengths of tool poses in work, shape (N, 6), m; by vector arithmetic, without the core."""
    turned = geometry.work.rotation @ rotations @ geometry.tool.rotation.T
    tips = geometry.work.position + positions @ geometry.work.rotation.T
    joints = tips[:, None] + np.einsum("nij,kj->nki", turned, geometry.platform_joints - geometry.tool.position)
    return np.linalg.norm(joints - geometry.base_joints, axis=2)


def share_of_limits(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> float:
    """Return the largest ratio of a strut's speed, acceleration or jerk, by differences of lengths, to its limit."""
    lengths, worst = struts(geometry, positions, rotations), 0.0
    for order, limit in enumerate((RATES.speed, RATES.acceleration, RATES.jerk), start=1):
        if len(lengths) > order:
            worst = max(worst, float(np.abs(np.diff(lengths, order, axis=0)).max()) * RATE**order / limit)
    return worst


def optimum(motion: Motion) -> float:
    """Return toppra's least duration, s, of a motion's leg with limits of speed and acceleration."""
    import toppra
    from toppra import algorithm, constraint

    s = np.linspace(0.0, 1.0, GRID + 1)
    lengths = motion.leg.struts(s)[0]
    scale = float(np.ptp(lengths, axis=0).max())  # length unit: toppra's solver has absolute tolerances
    path = toppra.SplineInterpolator(s, lengths / scale)
    speed, acceleration = (np.tile([-most, most], (6, 1)) / scale for most in (RATES.speed, RATES.acceleration))
    limits = [
        constraint.JointVelocityConstraint(speed),
        constraint.JointAccelerationConstraint(acceleration, constraint.DiscretizationType.Interpolation),
    ]
    speeds = algorithm.TOPPRA(limits, path, gridpoints=s).compute_parameterization(0.0, 0.0)[1]
    if speeds is None:
        return float("nan")
    return float((2.0 * np.diff(s) / (speeds[1:] + speeds[:-1])).sum())


def targets(geometry: HexapodGeometry, rng: np.random.Generator) -> Iterator[tuple[Pose, Pose]]:
    """Yield random moves near home, of very different sizes, between poses within the machine's limits."""
    home = geometry.tool_pose(geometry.home)
    while True:
        size = 10.0 ** rng.uniform(-4.0, 0.0)
        ends = [
            Pose(
                home.position + scale * rng.uniform(-0.05, 0.05, 3),
                home.rotation @ Rotation.from_rotvec(scale * rng.uniform(-0.09, 0.09, 3)).as_matrix(),
            )
            for scale in (1.0, size)
        ]
        start, by = ends[0], ends[1].position - home.position
        end = Pose(start.position + by, start.rotation @ home.rotation.T @ ends[1].rotation)
        if check(geometry, MachineModel(geometry.name), [start, end], "poses").ok:
            yield start, end


def judged(geometry: HexapodGeometry, count: int, seed: int) -> np.ndarray:
    """Plan, sample, differentiate and stop random moves; return six numbers for each.

    Duration without jerk limit / toppra's optimal duration; duration with / without jerk limit; largest ratio to a
    limit in the move, and in the stopped move; duration of the stop, s; processor time of planning, s.
    """
    rng, found, jerkless = np.random.default_rng([seed, 30]), [], replace(RATES, jerk=np.inf)
    for (start, end), _ in zip(targets(geometry, rng), range(count), strict=False):
        (quick,) = plan_motion(geometry, [start, end], jerkless)
        began = time.process_time()
        (motion,) = plan_motion(geometry, [start, end], RATES)
        planning, sent = time.process_time() - began, motion.sample(RATE)
        tick = int(rng.integers(0, len(sent)))
        stop = motion.stop(min(tick / RATE, motion.duration), RATE)
        both = (
            np.concatenate([a[:tick], b])
            for a, b in ((sent.positions, stop.positions), (sent.rotations, stop.rotations))
        )
        shares = share_of_limits(geometry, sent.positions, sent.rotations), share_of_limits(geometry, *both)
        times = quick.duration / optimum(quick), motion.duration / quick.duration
        found.append((*times, *shares, (len(stop) - 1) / RATE, planning))
    return np.array(found)


def moves(args: argparse.Namespace) -> bool:
    """Run the part "moves": print a row per machine; return whether the targets are met."""
    try:
        import toppra  # noqa: F401
    except ImportError:
        print("part moves needs toppra, which is not installed: pip install '.[bench]'", file=sys.stderr)
        sys.exit(2)
    names = [*machines()]
    each = -(-args.moves // len(names))
    print(f"limits: {RATES.speed} m/s, {RATES.acceleration} m/s², {RATES.jerk} m/s³; {each} moves of each machine\n")
    columns = ["machine", "moves", "over toppra", "largest", "over 1.02", "of a limit", "stops", "with jerk", "plan"]
    table = Table(columns)
    for name in tqdm(names, disable=None):
        ratio, jerk, share, stopped, duration, planning = judged(of_zoo(name)[0], each, args.first).T
        met = bool((ratio <= OPTIMUM).all()) and max(share.max(), stopped.max()) <= KEPT
        over = [f"{np.median(ratio):.4f}", f"{ratio.max():.4f}", int((ratio > OPTIMUM).sum()), f"{share.max():.4f}"]
        ends = [f"{stopped.max():.4f}, {np.median(duration) * 1e3:.0f} ms", f"{np.median(jerk):.2f} ×"]
        table.row(name, each, *over, *ends, f"{np.median(planning) * 1e3:.0f} ms", met=met)
    return table.met


GOAL, KNOCK = 3e-6, 20e-6  # goal of the calibration, and change of a strut's length by a collision, m
NAMED, FALSE, REPAIRED = 0.95, 0.05, 1.5  # targets: shares of named struts, of false alarms; repaired / first error
FAULTS = Instrument(wild=0.01, broken=0.02)
LAST_KILL = 80  # the loop and the node are killed once each before this stop


class Killed(BaseException):
    """An exception that ends the loop of ``adapt`` at once, as SIGKILL would."""


@dataclass
class Adapted:
    """Result for one machine; errors are RMS, µm."""

    state: str
    text: str
    stops: int
    kept: bool = True  # whether the error is at most the promised error and at most the goal
    left: float = np.nan  # after the calibration
    alarm: bool = False  # whether the guard raised a false alarm
    named: bool = False  # whether the guard named the changed strut
    knocked: float = np.nan  # after the change of a strut
    repaired: float = np.nan  # after the repair
    seconds: float = 0.0  # processor time


def adapted(name: str, seed: int, folder: Path) -> Adapted:
    """Calibrate a machine with outliers, broken beams and killed processes; check, change and repair it."""
    began, rng = time.process_time(), np.random.default_rng([seed, 31])
    geometry, _ = of_zoo(name)
    place = demo_place(geometry)
    machine = VirtualMachine(geometry, imagine(geometry, seed), FAULTS, seed)
    task = Task(place.box, place.attitude, goal=GOAL, every=0.0)

    def loop() -> Adaptation:
        def reload(path: Path) -> None:
            machine.reload(load_model(path, geometry))

        return Adaptation(geometry, machine, task, folder / "adapted", reload)

    def left() -> float:
        model = load_model(folder / "adapted" / "model.yaml", geometry)
        error = held_out(RealMachine(geometry, machine.truth), model, place.box, level=place.attitude)
        return 1e6 * error.aligned.rms

    ends = Killed(), NoAnswerError("nobody publishes strut_commands")
    move, left_to_end = machine.move, dict(zip(rng.choice(LAST_KILL, 2, replace=False).tolist(), ends, strict=True))

    def ended(pose: Pose) -> None:
        if machine.stops in left_to_end:
            raise left_to_end.pop(machine.stops)
        move(pose)

    machine.move, outcome = ended, None  # type: ignore[method-assign]
    while outcome is None:
        with suppress(Killed, NoAnswerError):
            outcome = loop().calibrate()
    found = Adapted(outcome.state, outcome.text, machine.stops)
    if outcome.state == "in use":
        found.left = left()
        found.kept = found.left <= 1e6 * min(loop().state.promised_in_use, GOAL)
        before = len(loop().events)
        loop().guard(1)
        found.alarm = any(e["event"] in ("repaired", "beyond repair") for e in loop().events[before:])
        machine.knock(strut := int(rng.integers(6)), KNOCK * rng.choice((-1.0, 1.0)))
        found.knocked, before = left(), len(loop().events)
        loop().guard(1)
        named = [e for e in loop().events[before:] if e["event"] == "repaired"]
        found.named = bool(named) and f"strut_{strut + 1} " in named[0]["text"]
        found.repaired = left()
    found.seconds = time.process_time() - began
    return found


def unattended(args: argparse.Namespace) -> bool:
    """Run the part "unattended": print a row per machine; return whether the targets are met."""
    print(f"goal {GOAL * 1e6:g} µm (95 %, after best-fit alignment); sizes in µm RMS\n")
    columns = ["machine", "seed", "ended", "stops", "left", "kept", "false alarm", "knocked", "named", "repaired", "s"]
    table, names, found = Table(columns), list(machines()), list[Adapted]()
    for n in tqdm(range(args.machines), disable=None):
        name, seed = names[n % len(names)], args.first + n
        with tempfile.TemporaryDirectory() as folder:
            one = adapted(name, seed, Path(folder))
        found.append(one)
        words = ["yes" if flag else "no" for flag in (one.kept, one.alarm, one.named)]
        sizes = [f"{size:.3f}" for size in (one.left, one.knocked, one.repaired)]
        cells = [sizes[0], words[0], words[1], sizes[1], words[2], sizes[2], f"{one.seconds:.0f}"]
        table.row(name, seed, one.state, one.stops, *cells)
        if one.state != "in use":
            tqdm.write(f"  {one.text}")
    used = [one for one in found if one.state == "in use"]
    refused = [one for one in found if one.state == "refused" and one.text]
    kept, alarms, named = (sum(getattr(one, key) for one in used) for key in ("kept", "alarm", "named"))
    worst = max((one.repaired / one.left for one in used), default=np.nan)
    times = float(np.median([one.repaired / one.left for one in used])) if used else np.nan
    print(f"\n{len(found)} machines: promise kept {kept}, refused with a reason {len(refused)}; {len(used)} in use:")
    text = f"false alarms {alarms}, strut named {named}; error after the repair / error before the knock"
    print(f"{text}: {times:.2f} (median), {worst:.2f} (largest)")
    return (
        kept + len(refused) == len(found)
        and bool(used)
        and alarms <= FALSE * len(used)
        and named >= NAMED * len(used)
        and worst <= REPAIRED
    )


PARTS = {
    "unattended": unattended,
    "moves": moves,
}
"""Each part prints its results and returns whether its targets are met."""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", choices=PARTS, action="append", help="run only this part; may be repeated")
    parser.add_argument("--moves", type=int, default=1000, help="moves of all machines together (default 1000)")
    parser.add_argument("--machines", type=int, default=4, help="machines of the part unattended (default 4)")
    parser.add_argument("--first", type=int, default=1, help="seed of the first machine (default 1)")
    args = parser.parse_args()
    met = []
    for name in args.part or PARTS:
        print(f"== {name}", flush=True)
        met.append(PARTS[name](args))
    print("all targets met" if all(met) else "a target was missed")
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
