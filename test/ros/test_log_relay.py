"""Writing to a stream that nobody reads must neither wait nor lose what fits; plain operating system, no ROS."""

from __future__ import annotations

import os
import subprocess
import sys

SCRIPT = """
import os, sys, time
from hexapod_comp.ros.process import LogRelay

def write(stream, text):
    try:
        return os.write(stream, text.encode())
    except BlockingIOError:
        return 0

with LogRelay():
    {body}
"""


def start(body: str, **streams: object) -> subprocess.Popen[bytes]:
    """Run a few lines within a LogRelay in a process of its own."""
    return subprocess.Popen([sys.executable, "-c", SCRIPT.format(body=body)], **streams)


def test_all_lines_arrive_in_order() -> None:
    child = start("for i in range(20000): write(2, f'{i}\\n')", stderr=subprocess.PIPE)
    _, said = child.communicate(timeout=60)
    assert child.returncode == 0
    assert said.split() == [b"%d" % i for i in range(20000)]


def test_a_reader_that_does_not_read_stops_nobody() -> None:
    """16 MB into a pipe that takes 64 kB: without the relay the process would wait for ever."""
    reading, writing = os.pipe()
    body = "for i in range(16384): write(2, 'x' * 1023 + '\\n')"
    try:
        child = start(body, stderr=writing)
        assert child.wait(60) == 0
    finally:
        os.close(reading)
        os.close(writing)


def test_a_reader_that_has_gone_stops_nobody() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    child = start("for i in range(4096): write(2, 'x' * 1023 + '\\n')", stderr=writing)
    os.close(writing)
    assert child.wait(60) == 0


def test_a_closed_stream_and_a_file_are_left_alone(tmp_path) -> None:
    path = tmp_path / "log"
    with path.open("wb") as log:
        child = start("os.write(2, b'straight')", stderr=log, preexec_fn=lambda: os.close(1))
        assert child.wait(60) == 0
    assert path.read_bytes() == b"straight"


def test_stdout_is_relayed_too() -> None:
    said = start("os.write(1, b'out'); os.write(2, b'err')", stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert said.communicate(timeout=60) == (b"out", b"err")
