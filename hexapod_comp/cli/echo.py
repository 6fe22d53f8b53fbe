"""``hexapod_comp echo``: a topic's messages with units, rate and age, without ROS 2's own tools."""

from __future__ import annotations

import argparse
import math
import sys
import time

from ..formats.json import json_text
from . import common

HZ_PERIOD = 1.0  # how often --hz prints a line, s


def run(args: argparse.Namespace) -> int | common.Result:
    """Run the verb until Ctrl-C, --count or --seconds; 0 when a message has come."""
    from ..ros import heard_signals, keep_discovery_local
    from ..ros.echo import DISCOVERY_TIME, Echo, EchoedMessage, published_topics
    from ..ros.process import QUIET, SPIN_PERIOD, RosSession

    keep_discovery_local()
    signals = heard_signals()
    began = time.monotonic()

    def going_on(until: float) -> bool:
        return not signals and time.monotonic() < until

    with RosSession("hexapod_comp_echo", args.namespace, **QUIET) as session:
        if args.topic is None:
            while going_on(began + DISCOVERY_TIME):
                session.spin_once(SPIN_PERIOD)
            topics = published_topics(session.node)
            lines = (f"{name}  {kind}" for name, kind in topics.items())
            return common.Result(lambda: "\n".join(lines), lambda: topics, code=0 if topics else 1)

        def print_message(received: EchoedMessage) -> None:
            if not args.hz and (args.count is None or echo.intervals.count <= args.count):
                print(json_text(received.record(), indent=None) if args.json else received.text() + "\n")

        echo = Echo(session.node, session.spin_once, args.topic, print_message)
        end, next_line = began + (args.seconds or math.inf), began + HZ_PERIOD
        while going_on(end) and (args.count is None or echo.intervals.count < args.count):
            session.spin_once(SPIN_PERIOD)
            sys.stdout.flush()
            if args.hz and not args.json and time.monotonic() > next_line:
                next_line += HZ_PERIOD
                print(f"{echo.topic}: {echo.intervals.text()}")
    intervals = echo.intervals
    if args.hz and args.json:
        print(json_text({"topic": echo.topic, **intervals.record()}), end="")
    elif not args.json:
        print(f"{echo.topic}: {intervals.text()}", file=sys.stderr)
    return 0 if intervals.count else 1
