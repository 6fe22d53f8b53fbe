"""A network cable in user space: carries Ethernet frames between two interfaces, late, with losses, or not at all.

Linux's own netem is a kernel module that not every machine has; this needs nothing but packet sockets.
"""

from __future__ import annotations

import heapq
import itertools
import select
import socket
import struct
import time

import numpy as np

ALL_PROTOCOLS = 3
"""ETH_P_ALL of Linux's <linux/if_ether.h>."""

OUTGOING = 4
"""PACKET_OUTGOING of Linux's <linux/if_packet.h>: our own frames, seen again."""

LONGEST_FRAME = 65_536

IPV4, UDP = 0x0800, 17


class Cable:
    """Carries frames between two interfaces of this network namespace.

    Parameters
    ----------
    names : (str, str)
        The interfaces.
    orders : socket
        From whom it takes orders: lines ``delay SECONDS``, ``loss SHARE``, ``cut`` and ``mend``.
    seed : int
        Of the losses.
    """

    def __init__(self, names: tuple[str, str], orders: socket.socket, seed: int) -> None:
        self._ends = [_packet_socket(name) for name in names]
        self._orders = orders
        self._rng = np.random.default_rng(seed)
        self._delay, self._loss, self._whole = 0.0, 0.0, True
        self._on_the_way: list[tuple[float, int, int, bytes]] = []
        self._count = itertools.count()
        self._unread = b""
        self.carried = self.lost = 0

    def run(self) -> None:
        """Carry until the one who gives orders hangs up."""
        while self._carry():
            pass

    def _carry(self) -> bool:
        wait = max(0.0, self._on_the_way[0][0] - time.monotonic()) if self._on_the_way else 1.0
        ready, _, _ = select.select([*self._ends, self._orders], [], [], wait)
        for index, end in enumerate(self._ends):
            if end in ready:
                self._take(index, end)
        while self._on_the_way and self._on_the_way[0][0] <= time.monotonic():
            _, _, index, frame = heapq.heappop(self._on_the_way)
            self._ends[1 - index].send(frame)
        return self._orders not in ready or self._obey()

    def _take(self, index: int, end: socket.socket) -> None:
        frame, address = end.recvfrom(LONGEST_FRAME)
        if address[2] == OUTGOING:
            return
        if not self._whole or self._rng.uniform() < self._loss:
            self.lost += 1
            return
        self.carried += 1
        due = time.monotonic() + self._delay
        heapq.heappush(self._on_the_way, (due, next(self._count), index, without_udp_checksum(frame)))

    def _obey(self) -> bool:
        data = self._orders.recv(4096)
        self._unread += data
        *lines, self._unread = self._unread.split(b"\n")
        for line in lines:
            word, *values = line.decode("ascii").split()
            if word == "mend":
                self._delay, self._loss, self._whole = 0.0, 0.0, True
            elif word == "cut":
                self._whole = False
            else:
                setattr(self, f"_{word}", float(values[0]))
        return bool(data)


def _packet_socket(name: str) -> socket.socket:
    end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ALL_PROTOCOLS))
    end.bind((name, 0))
    return end


def without_udp_checksum(frame: bytes) -> bytes:
    """Return a frame whose UDP checksum, if it has one, says that there is none.

    A virtual Ethernet leaves it to a hardware that is not there, so what we take off it is not valid yet.
    """
    if len(frame) < 42 or struct.unpack_from("!H", frame, 12)[0] != IPV4 or frame[23] != UDP:
        return frame
    fragment = struct.unpack_from("!H", frame, 20)[0] & 0x1FFF
    place = 14 + 4 * (frame[14] & 0x0F) + 6
    return frame if fragment else frame[:place] + b"\0\0" + frame[place + 2 :]
