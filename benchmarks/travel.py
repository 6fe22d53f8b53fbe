"""What working out how far the tool may go costs the commands beside it.

One thread answers commands of a small motion, as the compensator's does; in every second round another works out the
travel without a pause, a hundred times as often as the node's topic. Times of a command with and without it come from
the same run, so that whatever else the computer does hits both alike.

Usage: python -m benchmarks.travel [--rounds 40] [--machine paper] [--model paper_machine]
"""

from __future__ import annotations

import argparse
import threading
import time

import numpy as np

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.travel import travel
from hexapod_comp.core.batch import quaternion_of
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

COMMANDS, PAUSE, STEP = 60, 5e-4, 1e-5
"""Commands a round, seconds between two, and how far they are apart, m."""


def measure(compensator: Compensator, rounds: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the processor's time for one travel, s, and those of commands without and with travel beside them."""
    home = compensator.geometry.tool_pose(compensator.geometry.home)
    x, *rest = (*home.position.tolist(), *quaternion_of(home.rotation))
    travel(compensator.machine, home)
    began = time.thread_time()
    travel(compensator.machine, home)
    cost = time.thread_time() - began
    beside, ended = threading.Event(), threading.Event()

    def work() -> None:
        while not ended.is_set():
            if beside.wait(0.05):
                travel(compensator.machine, home)

    thread = threading.Thread(target=work)
    thread.start()
    times: tuple[list[float], list[float]] = ([], [])
    for number in range(rounds * COMMANDS):
        busy = number // COMMANDS % 2
        (beside.set if busy else beside.clear)()
        time.sleep(PAUSE)
        began = time.perf_counter()
        compensator.step((x + STEP * (number % 2), *rest), 0.01 * number, None, 0.01 * number)
        times[busy].append(time.perf_counter() - began)
    ended.set()
    thread.join()
    return cost, np.array(times[0]), np.array(times[1])


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--machine", default="paper")
    parser.add_argument("--model", default="paper_machine")
    args = parser.parse_args()
    geometry = load_geometry(args.machine)
    cost, without, beside = measure(Compensator(geometry, load_model(args.model, geometry)), args.rounds)
    print(f"travel of {geometry.name}, twelve ways: {cost * 1e3:.1f} ms of a processor")
    for name, found in (("without", without), ("beside it", beside)):
        median, p99 = np.percentile(found * 1e6, [50.0, 99.0])
        print(f"a command {name}: median {median:.1f} µs, 99 % {p99:.1f} µs")
    ratios = np.percentile(beside, [50.0, 99.0]) / np.percentile(without, [50.0, 99.0])
    print(f"ratios: median {ratios[0]:.3f}, 99 % {ratios[1]:.3f}")


if __name__ == "__main__":
    main()
