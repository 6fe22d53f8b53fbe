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


class Restarting:
    """A machine that stands under a controller of poses or of lengths, and restarts of its compensator."""

    def __init__(self, bench: Bench, command_input: str, step: float, seed: int) -> None:
        self._bench, self._lengths = bench, command_input == "struts"
        bench.remove_publisher("tool_pose_command" if self._lengths else "strut_setpoints")
        bench.drive(noise_seed=seed, truth_file=MACHINE, step=step)
        if self._lengths:
            bench.add_publisher("strut_setpoints")
            self._told = bench.seen["nominal_strut_states"]
            topic = "nominal_strut_states"
            bench.witness.create_subscription(JointState, topic, self._told.append, BEST_EFFORT)
        bench.compensator(model_file=MACHINE, command_input=command_input, ramp_rate=1e-3)

    def hold(self, setpoint: list[float] | None, seconds: float) -> None:
        """Command a pose, or lengths, at a constant rate."""
        bench, end = self._bench, time.monotonic() + seconds
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

    def where(self) -> np.ndarray:
        """Return the true position of the tool, the mean of 25 readings, m."""
        seen = self._bench.seen["tool_pose_true"]
        seen.clear()
        self._bench.until(lambda: len(seen) >= 25, "true poses")
        return np.mean([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in seen[-25:]], axis=0)

    def told(self) -> list[float] | None:
        """Return what a controller starts from: the newest lengths that it is told; None for one of poses."""
        if not self._lengths:
            return None
        self._told.clear()
        self._bench.until(lambda: self._told, "lengths")
        return list(self._told[-1].position)

    def run(self, count: int) -> np.ndarray:
        """Return how far the tool has moved at each restart, shape (count,), m."""
        self.hold(self.told(), 2.0 * SETTLES_IN)
        places = [self.where()]
        for _ in tqdm(range(count), disable=None, leave=False):
            self._bench.change("deactivate")
            self._bench.change("activate")
            self.hold(self.told(), SETTLES_IN)
            places.append(self.where())
        return np.linalg.norm(np.diff(places, axis=0), axis=1)


def measured(command_input: str, step: float, restarts: int, seed: int) -> dict[str, float]:
    """Return the distribution of the ways for one kind of controller and of motors, nm."""
    context = Context()
    rclpy.init(args=[], context=context, domain_id=int(os.environ.get("ROS_DOMAIN_ID", "0")))
    try:
        with Bench(context) as bench:
            ways = Restarting(bench, command_input, step, seed).run(restarts) * 1e9
    finally:
        rclpy.try_shutdown(context=context)
    median, upper = np.quantile(ways, (0.5, 0.95))
    return {"median": float(median), "95 %": float(upper), "largest": float(ways.max()), "restarts": restarts}


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--restarts", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    keep_discovery_local()
    results = {
        f"{name}, {motors}": measured(name, step, options.restarts, options.seed)
        for name in ("struts", "poses")
        for motors, step in (("steps of 0.1 µm", 1e-7), ("no steps", 0.0))
    }
    for name, result in results.items():
        figures = ", ".join(f"{key} {value:.1f} nm" for key, value in result.items() if key != "restarts")
        print(f"controller of {name}: the tool moved by {figures}, in {options.restarts} restarts")
    return int(max(result["95 %"] for result in results.values()) > BAR * 1e9)


if __name__ == "__main__":
    sys.exit(main())
