"""Compensator and drive on two hosts: network namespaces and a cable. All of it: python -m benchmarks.network."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import long_test

pytest.importorskip("rclpy")

from benchmarks.faults.cable import without_udp_checksum
from benchmarks.faults.namespaces import refusal

ROOT = Path(__file__).resolve().parents[2]


def frame(kind: int, protocol: int, options: int, fragment: int, payload: bytes) -> bytes:
    """Return an Ethernet frame with an IPv4 packet, made from RFC 791: version and length, …, protocol at byte 9."""
    length = 20 + options + len(payload)
    version_and_length = 0x40 | (5 + options // 4)
    addresses = socket.inet_aton("10.99.0.1") + socket.inet_aton("10.99.0.2")
    head = struct.pack("!BBHHHBBH", version_and_length, 0, length, 7, fragment, 64, protocol, 0) + addresses
    return b"\1" * 12 + struct.pack("!H", kind) + head + b"\0" * options + payload


DATAGRAM = struct.pack("!HHHH", 7400, 7410, 8 + 5, 0xBEEF) + b"hello"
"""RFC 768: ports, length, checksum, data."""


@pytest.mark.parametrize("options", [0, 8])
def test_the_cable_takes_udp_checksums_off_and_nothing_else(options):
    found = without_udp_checksum(frame(0x0800, 17, options, 0, DATAGRAM))
    assert found == frame(0x0800, 17, options, 0, DATAGRAM.replace(b"\xbe\xef", b"\0\0"))


@pytest.mark.parametrize(
    "other",
    [
        frame(0x0800, 6, 0, 0, DATAGRAM * 3),  # TCP
        frame(0x0800, 17, 0, 185, DATAGRAM),  # a later fragment: no UDP header in it
        frame(0x86DD, 17, 0, 0, DATAGRAM),  # IPv6
        b"\xff" * 12 + b"\x08\x06" + b"\0" * 28,  # ARP
    ],
)
def test_the_cable_leaves_other_frames_alone(other):
    assert without_udp_checksum(other) == other


@long_test
def test_two_hosts_and_a_cable_that_is_cut():
    """The machine goes on, the loss is said, nothing is breached; the bars on time are the benchmark's."""
    why_not = refusal()
    if why_not:
        pytest.skip(f"no network namespaces here: {why_not}")
    command = [sys.executable, "-m", "benchmarks.network", "--rounds", "1", "--only", "cut,delay", "--seconds", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    rows = {line.split()[0]: line.split() for line in done.stdout.splitlines()[-2:]}
    assert rows.keys() == {"cut", "delay"}, done.stdout + done.stderr
    assert float(rows["cut"][2]) < 2000.0, "the loss of feedback is said"
    for row in rows.values():
        assert row[-1] == "0", "no breach"
