"""Two hosts that are none: network namespaces, each with one end of a virtual Ethernet; the cable lies between."""

from __future__ import annotations

import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

OWN_NETWORK = ("unshare", "--map-root-user", "--net")
"""A network namespace, and a user namespace in which we are root and may set it up."""

ADDRESS = "10.99.0.{}/24"

APPEARS_WITHIN = 5.0
"""A namespace that is not there after this long, s, will not be."""


def refusal() -> str:
    """Return why there cannot be network namespaces with virtual Ethernet here, or nothing if there can."""
    script = "ip link add he0 type veth peer name hw0 && ip link set lo up"
    try:
        done = subprocess.run([*OWN_NETWORK, "sh", "-c", script], capture_output=True, text=True, check=False)
    except OSError as error:
        return str(error)
    return "" if done.returncode == 0 else done.stderr.strip() or "not permitted"


@dataclass
class Host:
    """One namespace.

    Attributes
    ----------
    holder : Popen
        A process that does nothing in it but keep it.
    wire : str
        Name of the cable's end, in our namespace.
    """

    holder: subprocess.Popen
    wire: str

    @property
    def enter(self) -> list[str]:
        """The words before a command that make it run there."""
        return ["nsenter", f"--target={self.holder.pid}", "--net", "--"]

    def close(self) -> None:
        """Give it up."""
        self.holder.kill()
        self.holder.wait()


def make_host(number: int) -> Host:
    """Make a host with address 10.99.0.NUMBER; must be called in a namespace of our own (:data:`OWN_NETWORK`)."""
    holder = subprocess.Popen(["unshare", "--net", "sleep", "infinity"])
    _wait_for_namespace(holder.pid)
    wire, end = f"hw{number}", f"he{number}"
    _run("ip", "link", "add", wire, "type", "veth", "peer", "name", end)
    _run("ip", "link", "set", end, "netns", str(holder.pid))
    _run("ip", "link", "set", wire, "up")
    host = Host(holder, wire)
    for words in (
        ("link", "set", "lo", "up"),
        ("addr", "add", ADDRESS.format(number), "dev", end),
        ("link", "set", end, "up"),
        ("route", "add", "224.0.0.0/4", "dev", end),
    ):
        _run(*host.enter, "ip", *words)
    return host


def _wait_for_namespace(pid: int) -> None:
    give_up = time.monotonic() + APPEARS_WITHIN
    while os.readlink(Path("/proc") / str(pid) / "ns/net") == os.readlink("/proc/self/ns/net"):
        if time.monotonic() > give_up:
            raise RuntimeError("the new network namespace does not appear")
        time.sleep(0.01)


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr.strip()}")
