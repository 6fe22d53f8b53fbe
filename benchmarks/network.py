"""Compensator and drive on two simulated hosts (network namespaces) whose cable is cut, loses frames or delays them.

Usage: python -m benchmarks.network [--rounds 3] [--seconds 5] [--seed 0] [--only cut,loss,delay,long_cut]; see
doc/faults.md. Exit code 2: network namespaces are not permitted here.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import os
import select
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial

import numpy as np

from hexapod_comp.ros import avoid_shared_memory

from . import cannot_run
from .faults import judge
from .faults.campaign import RUNS_AGAIN_WITHIN, WARM_UP, Episode, Outcome, run_episode, table
from .faults.kinds import Fault
from .faults.record import Happened
from .faults.rig import Rig

# Tells child processes of this program their role: ``cable``, or the file descriptor of the socket for cable commands
INSIDE = "HEXAPOD_COMP_NETWORK_BENCHMARK"
OWN_NETWORK = ("unshare", "--map-root-user", "--net")  # runs a command as root of a new network namespace
APPEARS_WITHIN = 5.0  # longest wait for a new namespace, s
ALL_PROTOCOLS, OUTGOING, LONGEST_FRAME = 3, 4, 65_536  # Linux's ETH_P_ALL and PACKET_OUTGOING (own frames); bytes
IPV4, UDP = 0x0800, 17


# ---- the cable ----


class Cable:
    """Forwards frames between two interfaces of this network namespace.

    Commands are lines on a socket: ``delay SECONDS``, ``loss SHARE``, ``cut`` (all frames are lost) and ``mend``.
    """

    def __init__(self, names: tuple[str, str], orders: socket.socket, seed: int) -> None:
        self._ends = [socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ALL_PROTOCOLS)) for _ in names]
        for end, name in zip(self._ends, names, strict=True):
            end.bind((name, 0))
        self._orders, self._unread = orders, b""
        self._rng = np.random.default_rng(seed)
        self._delay, self._loss = 0.0, 0.0
        self._on_the_way: list[tuple[float, int, int, bytes]] = []
        self._count = itertools.count()
        self.carried = self.lost = 0

    def run(self) -> None:
        """Forward frames until the other end of the socket for commands is closed."""
        while True:
            wait = max(0.0, self._on_the_way[0][0] - time.monotonic()) if self._on_the_way else 1.0
            ready, _, _ = select.select([*self._ends, self._orders], [], [], wait)
            for index, end in enumerate(self._ends):
                if end in ready:
                    self._accept(index, *end.recvfrom(LONGEST_FRAME))
            while self._on_the_way and self._on_the_way[0][0] <= time.monotonic():
                _, _, index, frame = heapq.heappop(self._on_the_way)
                self._ends[1 - index].send(frame)
            if self._orders in ready and not self._obey():
                return

    def _accept(self, index: int, frame: bytes, address: tuple) -> None:
        if address[2] == OUTGOING:
            return
        if self._rng.uniform() < self._loss:
            self.lost += 1
            return
        self.carried += 1
        due = time.monotonic() + self._delay
        heapq.heappush(self._on_the_way, (due, next(self._count), index, without_udp_checksum(frame)))

    def _obey(self) -> bool:
        data = self._orders.recv(4096)
        *lines, self._unread = (self._unread + data).split(b"\n")
        for line in lines:
            word, *values = line.decode("ascii").split()
            if word == "delay":
                self._delay = float(values[0])
            else:
                self._delay, self._loss = 0.0, {"mend": 0.0, "cut": 1.0}.get(word) or float((*values, 0.0)[0])
        return bool(data)


def without_udp_checksum(frame: bytes) -> bytes:
    """Set a frame's UDP checksum, if it has one, to 0: no checksum.

    A virtual Ethernet leaves the checksum to hardware, of which there is none; so the checksum is wrong.
    """
    if len(frame) < 42 or struct.unpack_from("!H", frame, 12)[0] != IPV4 or frame[23] != UDP:
        return frame
    fragment = struct.unpack_from("!H", frame, 20)[0] & 0x1FFF
    place = 14 + 4 * (frame[14] & 0x0F) + 6
    return frame if fragment else frame[:place] + b"\0\0" + frame[place + 2 :]


# ---- two hosts: namespaces, each with one end of a virtual Ethernet ----


def refusal() -> str:
    """Return why network namespaces with virtual Ethernet are impossible here; "" if they are possible."""
    script = "ip link add he0 type veth peer name hw0 && ip link set lo up"
    try:
        done = subprocess.run([*OWN_NETWORK, "sh", "-c", script], capture_output=True, text=True, check=False)
    except OSError as error:
        return str(error)
    return "" if done.returncode == 0 else done.stderr.strip() or "not permitted"


def make_host(number: int) -> subprocess.Popen:
    """Make a host, 10.99.0.NUMBER, in a new namespace; return the idle process that keeps the namespace.

    The cable's end of the host's virtual Ethernet is the interface hwNUMBER.
    """
    holder = subprocess.Popen(["unshare", "--net", "sleep", "infinity"])
    give_up = time.monotonic() + APPEARS_WITHIN
    while os.readlink(f"/proc/{holder.pid}/ns/net") == os.readlink("/proc/self/ns/net"):
        if time.monotonic() > give_up:
            raise RuntimeError("the new network namespace does not appear")
        time.sleep(0.01)
    wire, end, inside = f"hw{number}", f"he{number}", " ".join(entering(holder))
    for words in (
        f"ip link add {wire} type veth peer name {end}",
        f"ip link set {end} netns {holder.pid}",
        f"ip link set {wire} up",
        f"{inside} ip link set lo up",
        f"{inside} ip addr add 10.99.0.{number}/24 dev {end}",
        f"{inside} ip link set {end} up",
        f"{inside} ip route add 224.0.0.0/4 dev {end}",
    ):
        done = subprocess.run(words.split(), capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{words}: {done.stderr.strip()}")
    return holder


def entering(host: subprocess.Popen) -> list[str]:
    """Return the words that, before a command, run it on a host."""
    return ["nsenter", f"--target={host.pid}", "--net", "--"]


# ---- the episodes ----


def on_cable(order: str, fault: Fault, rig: Rig, happened: Happened) -> Iterator[None]:
    CABLE[0].sendall(f"{order}\n".encode("ascii"))
    yield
    CABLE[0].sendall(b"mend\n")


CABLE: list[socket.socket] = []
# Command of the cable and duration, s (0: --seconds); in 13 s, DDS on each host drops the other host
ORDERS = {"cut": ("cut", 1.0), "loss": ("loss 0.05", 0.0), "delay": ("delay 0.05", 0.0), "long_cut": ("cut", 13.0)}
silent = partial(judge.silence, "feedback")
judge.VISIBLE.update(cut=silent, long_cut=silent, loss=judge.nothing, delay=judge.nothing)


def harness(args: argparse.Namespace, descriptor: int) -> int:
    """Run the episodes on the compensator's host; `args.far` are the words that run a command on the drive's host."""
    cable = socket.socket(fileno=descriptor)
    CABLE.append(cable)
    os.environ.update(ROS_DOMAIN_ID="1", ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET")
    avoid_shared_memory()
    wanted = [kind for kind in ORDERS if kind in args.only.split(",")]
    outcomes: list[Outcome] = []
    with cable, Rig(args.seed, domain=False, host=args.far.split()) as rig:
        rig.spin(WARM_UP)
        for number in range(args.rounds * len(wanted)):
            order, seconds = ORDERS[kind := wanted[number % len(wanted)]]
            rng = np.random.default_rng([args.seed, number])
            fault = Fault(kind, frozenset(), rng, seconds or args.seconds, partial(on_cable, order))
            outcomes.append(run_episode(rig, Episode(number, [(0.0, fault)])))
            for miss in outcomes[-1].verdict.misses():
                busy = f" [no processor for {outcomes[-1].starved:.0%} of the time]"
                print(f"{kind}, round {number // len(wanted)}: {miss}{busy}", flush=True)
            rig.spin(RUNS_AGAIN_WITHIN, rig.running)
            if not rig.running():
                print(f"{kind}: the machine does not run again")
                return 1
    print(table(outcomes))
    return int(any(outcome.verdict.misses() for outcome in outcomes))


def between_hosts(args: argparse.Namespace) -> int:
    """Make two hosts, run the harness on the first one, and forward frames until the harness ends."""
    hosts = [make_host(number) for number in (1, 2)]
    ours, theirs = socket.socketpair()
    near, far = map(entering, hosts)
    command = [*near, sys.executable, "-m", "benchmarks.network", *sys.argv[1:], "--far", " ".join(far)]
    try:
        environment = {**os.environ, INSIDE: str(theirs.fileno())}
        child = subprocess.Popen(command, env=environment, pass_fds=[theirs.fileno()])
        theirs.close()
        carrier = Cable(("hw1", "hw2"), ours, args.seed)
        carrier.run()
        print(f"{carrier.carried} frames carried, {carrier.lost} lost", file=sys.stderr)
        return child.wait()
    finally:
        for host in hosts:
            host.kill()
            host.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0, help="duration of loss and delay, s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(ORDERS), help="kinds of episode, separated by commas")
    parser.add_argument("--far", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    role = os.environ.get(INSIDE, "")
    if role == "cable":
        return between_hosts(args)
    if role:
        return harness(args, int(role))
    if why_not := refusal():
        return cannot_run(f"network namespaces are not possible here: {why_not}")
    command = [*OWN_NETWORK, sys.executable, "-m", "benchmarks.network", *sys.argv[1:]]
    return subprocess.run(command, env={**os.environ, INSIDE: "cable"}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
