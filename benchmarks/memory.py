"""What a node keeps in memory: at rest, and at most while somebody sends it messages of 10 MB.

Usage: python -m benchmarks.memory [--messages 30]; exits 1 when a bar is missed: 100 MB resident at rest, 200 at most.

Resident is what the system counts for a process, and counts again for each other that uses the same libraries; its
share divides those pages among them; private is what would come free if it ended. A bare lifecycle node stands beside
them for what rclpy and DDS take by themselves. Messages come by commands, readings and temperatures in turn. 1 MB is
2²⁰ bytes."""

from __future__ import annotations

import argparse
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path

from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState, Temperature

from hexapod_comp.loop.processes import NodeProcess, PrivateDomain
from hexapod_comp.ros.process import RosSession

ROOT = Path(__file__).resolve().parents[1]

BAR, LARGEST_BAR = 100.0, 200.0  # At rest and at most, MB

LENGTH = 10_000_000  # Of a message, byte

# What each node hears
HEARD = {
    "compensator": {"tool_pose_command": PoseStamped, "strut_states": JointState, "temperatures": Temperature},
    "strut_drive": {"strut_commands": JointState},
}

BARE = """
import rclpy, rclpy.lifecycle
rclpy.init()
node = rclpy.lifecycle.LifecycleNode("bare")
rclpy.spin(node)
"""

SETTLED = 3.0  # What does not change for so long stays, s


def kept(pid: int) -> tuple[float, float, float]:
    """Return what a process has in memory: resident, its share of that, private, MB."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
    found = {name: int(size) / 1024.0 for name, size in re.findall(r"^(\w+): +(\d+) kB", text, re.MULTILINE)}
    return found["Rss"], found["Pss"], found["Private_Clean"] + found["Private_Dirty"]


def settled(pid: int) -> tuple[float, float, float]:
    """Return what a process has in memory when that does not change any more, MB."""
    before = math.inf
    while True:
        time.sleep(SETTLED)
        now = kept(pid)
        if abs(now[0] - before) < 1.0:
            return now
        before = now[0]


def largest(pid: int, topics: dict[str, type], messages: int) -> float:
    """Return what a node has in memory at most while long messages come, MB."""
    Path(f"/proc/{pid}/clear_refs").write_text("5", encoding="ascii")  # forget the largest so far
    with RosSession("stranger") as session:
        publishers = [session.node.create_publisher(kind, topic, QoSProfile(depth=1)) for topic, kind in topics.items()]
        kinds = list(topics.values())
        while not all(publisher.get_subscription_count() for publisher in publishers):
            session.spin_once(0.02)
        for number in range(messages):
            message = kinds[number % len(kinds)]()
            message.header.frame_id = "x" * LENGTH
            publishers[number % len(kinds)].publish(message)
            end = time.monotonic() + 0.2
            while time.monotonic() < end:
                session.spin_once(0.02)
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 1024.0


def look(name: str, messages: int) -> bool:
    """Print a node's memory; return whether it keeps the bars."""
    node = NodeProcess(name, {"model_file": "paper_machine.yaml"} if name == "compensator" else {})
    try:
        while "ready" not in node.output():
            if node.exit_code() is not None:
                raise SystemExit(f"{name} did not become ready:\n{node.output()}")
            time.sleep(0.05)
        resident, share, private = settled(node.pid)
        most = largest(node.pid, HEARD[name], messages)
    finally:
        node.stop()
    print(f"{name}: {resident:.0f} / {share:.0f} / {private:.0f} MB; with messages of 10 MB {most:.0f} MB at most")
    return resident <= BAR and most <= LARGEST_BAR


def main() -> int:
    """Print a line per node."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=30)
    messages = parser.parse_args().messages
    print("resident / share / private:")
    with PrivateDomain():
        os.environ["PYTHONPATH"] = str(ROOT)
        bare = subprocess.Popen([sys.executable, "-c", BARE])
        try:
            print("a bare lifecycle node: {:.0f} / {:.0f} / {:.0f} MB".format(*settled(bare.pid)))
        finally:
            bare.kill()
            bare.wait()
        good = [look(name, messages) for name in HEARD]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
