"""How far does the tool move when the compensator is activated anew while the machine stands?

A controller of strut lengths that starts from the readings, as those of ros2_control do, holds from then on what it was
told at its start: the noise of that reading stays in the tool's place. A controller of poses goes on with its last
pose. The simulated drive has encoders of 0.1 µm with 0.05 µm of noise, and motors with steps of 0.1 µm, or with none;
the true pose is read without noise.

Usage: python -m benchmarks.restart [--restarts 40] [--seed 0]

Exits 1 when one restart in twenty moves the tool further than 60 nm.
"""

from __future__ import annotations

import argparse
import os
import sys
import time

import numpy as np
import rclpy
from rclpy.context import Context
from sensor_msgs.msg import JointState
from tqdm import tqdm

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros import keep_discovery_local
from hexapod_comp.testing.bench import BEST_EFFORT, Bench

# Where the machine stands: a step off home, where the simulated drive begins, so that all struts differ
AT = Pose([0.0004, -0.0003, 0.4006], np.eye(3))

# Truth and model. A machine with backlash hides steps of the motors that are smaller than its play.
MACHINE = "ideal"

BAR = 60e-9  # Largest 95 % quantile, m: half the step of the encoders

RATE, SETTLES_IN = 50.0, 0.6  # Commands per second; time in which drives and ramps come to rest, s


def hold(bench: Bench, setpoint: list[float] | None, seconds: float) -> None:
    """Command lengths, or the pose, at a constant rate."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if setpoint is None:
            bench.send(AT)
        else:
            message = JointState(name=list(STRUT_NAMES), position=setpoint)
            message.header.stamp = bench.now()
            bench.publish("strut_setpoints", message)
        due = time.monotonic() + 1.0 / RATE
        while (left := due - time.monotonic()) > 0.0:
            bench.executor.spin_once(timeout_sec=left)


def ways(bench: Bench, command_input: str, step: float, restarts: int, seed: int) -> np.ndarray:
    """Return how far the tool moves at each restart under a controller of ``struts`` or of ``poses``, m."""
    lengths, told = command_input == "struts", list[JointState]()
    bench.remove_publisher("tool_pose_command" if lengths else "strut_setpoints")
    bench.drive(noise_seed=seed, truth_file=MACHINE, step=step)
    if lengths:
        bench.add_publisher("strut_setpoints")
        bench.witness.create_subscription(JointState, "nominal_strut_states", told.append, BEST_EFFORT)
    bench.compensator(model_file=MACHINE, command_input=command_input, ramp_rate=1e-3)
    seen, places = bench.seen["tool_pose_true"], []
    for number in tqdm(range(restarts + 1), disable=None, leave=False):
        if number:
            bench.change("deactivate")
            bench.change("activate")
        told.clear()
        if lengths:  # a controller starts from the newest lengths that it is told
            bench.until(lambda: told, "lengths")
        hold(bench, list(told[-1].position) if lengths else None, SETTLES_IN if number else 2.0 * SETTLES_IN)
        seen.clear()
        bench.until(lambda: len(seen) >= 25, "true poses")
        places.append(np.mean([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in seen[-25:]], axis=0))
    return np.linalg.norm(np.diff(places, axis=0), axis=1)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--restarts", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    keep_discovery_local()
    worst = 0.0
    for name in ("struts", "poses"):
        for motors, step in (("steps of 0.1 µm", 1e-7), ("no steps", 0.0)):
            context = Context()
            rclpy.init(args=[], context=context, domain_id=int(os.environ.get("ROS_DOMAIN_ID", "0")))
            try:
                with Bench(context) as bench:
                    moved = ways(bench, name, step, options.restarts, options.seed)
            finally:
                rclpy.try_shutdown(context=context)
            median, upper, largest = np.quantile(moved, (0.5, 0.95, 1.0)) * 1e9
            text = (
                f"median {median:.1f} nm, 95 % {upper:.1f} nm, largest {largest:.1f} nm, in {options.restarts} restarts"
            )
            print(f"controller of {name}, {motors}: the tool moved by {text}", flush=True)
            worst = max(worst, upper)
    return int(worst > BAR * 1e9)


if __name__ == "__main__":
    sys.exit(main())
