"""``hexapod_comp record``: a machine's topics into a bag, without ROS 2's own tools."""

from __future__ import annotations

import argparse
import math
import sys
import time

from ..errors import InputFileError
from . import common


def run(args: argparse.Namespace) -> int:
    """Run the verb; 0 when there is something to be replayed."""
    from ..ros import heard_signals
    from ..ros.recorder import BagRecorder

    heard, end = heard_signals(), time.monotonic() + (args.seconds or math.inf)
    with BagRecorder(args.folder, args.namespace) as recorder, common.progress_bar(0, " messages") as bar:
        print(f"hexapod_comp: recording to {args.folder} until Ctrl-C", file=sys.stderr)
        recorder.run(lambda: not heard and time.monotonic() < end, bar.update)
    lines = [f"{count:8d}  {topic}" for topic, count in sorted(recorder.counts.items())]
    lines.append("recording ended early" if recorder.problem else f"written: {args.folder}")
    shown = common.Result(lambda: "\n".join(lines), lambda: {"bag": args.folder, "messages": recorder.counts})
    shown.finish(args)
    if recorder.problem:
        raise InputFileError(args.folder, "", recorder.problem)
    if not recorder.journal:
        common.say_notes(["no compensator was heard: there is nothing to replay"])
    return 0 if recorder.journal else 1
