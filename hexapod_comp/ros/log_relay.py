"""Logging that cannot hold up a loop.

ROS writes its log to stderr from within the call, with Python's lock held. A terminal stopped with Ctrl-S, or a
pipe that nobody reads, would then stop the machine's loop for as long as it likes. Here a thread stands between:
the loop writes into a pipe of this process, and what does not fit into it any more is lost instead of waited for.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
import threading
from types import TracebackType

STREAMS = (1, 2)
"""stdout and stderr: RCUTILS_LOGGING_USE_STDOUT decides where ROS writes."""

BUFFER_SIZE = 1 << 20
"""Of the pipe, byte: some thousands of lines. Linux allows everybody this much."""

LEAVING_WITHIN = 0.5
"""How long the end of a process waits for its last lines to be taken, s."""


class LogRelay:
    """Context manager: writing to stdout and stderr never waits, and what nobody takes in time is lost."""

    def __enter__(self) -> LogRelay:
        self._relays = [_Relay(stream) for stream in STREAMS if _may_block(stream)]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for relay in self._relays:
            relay.close()


def _may_block(stream: int) -> bool:
    """Return whether writing can wait for somebody: a terminal, a pipe or a socket, but not a file."""
    try:
        return not stat.S_ISREG(os.fstat(stream).st_mode)
    except OSError:  # closed
        return False


class _Relay:
    """One stream and the thread that empties the pipe put in its place."""

    def __init__(self, stream: int) -> None:
        self._stream, self._real = stream, os.dup(stream)
        self._source, sink = os.pipe()
        with contextlib.suppress(OSError):  # a system with a lower limit keeps its own size
            fcntl.fcntl(sink, fcntl.F_SETPIPE_SZ, BUFFER_SIZE)
        os.set_blocking(sink, False)
        os.dup2(sink, stream)
        os.close(sink)
        self._thread = threading.Thread(target=self._carry, name=f"log of stream {stream}", daemon=True)
        self._thread.start()

    def _carry(self) -> None:
        """Hand on what was written, until the last writer has gone; go on emptying when the reader has gone."""
        while data := os.read(self._source, 1 << 16):
            with contextlib.suppress(OSError):
                while data:
                    data = data[os.write(self._real, data) :]

    def close(self) -> None:
        """Put the stream back and wait a little for what is on its way."""
        os.dup2(self._real, self._stream)
        self._thread.join(LEAVING_WITHIN)
