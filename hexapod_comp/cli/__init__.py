# PYTHON_ARGCOMPLETE_OK
"""The command ``hexapod_comp <verb>``: light parsers, and a module for each verb that is loaded when it is chosen."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Sequence

from ..errors import HexapodError
from ..formats.outputs import inputs_protected
from ..formats.texts import run_with_plain_streams
from .parsers import GONE, PROGRAM, make_parser, unknown_verb

NEGATIVE = re.compile(r"-[.\d]")
"""What follows an option and looks like this is its value, not another option."""

USAGE_ERROR, INTERRUPTED = 2, 130
"""Exit codes: bad input; Ctrl-C as shells count it, 128 + signal."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    arguments = sys.argv[1:] if argv is None else argv
    return run_with_plain_streams(lambda: _run(arguments)) or 0


def _run(arguments: Sequence[str]) -> int:
    if arguments and arguments[0] in GONE:
        print(f"{PROGRAM}: error: {arguments[0]} {GONE[arguments[0]]}", file=sys.stderr)
        return USAGE_ERROR
    parser = make_parser()
    if "_ARGCOMPLETE" in os.environ:
        from .completion import complete

        complete(parser)
    if arguments and not arguments[0].startswith("-") and (near := unknown_verb(arguments[0])) is not None:
        print(
            f"{PROGRAM}: error: there is no verb {arguments[0]!r}{near}; {PROGRAM} --help lists them", file=sys.stderr
        )
        return USAGE_ERROR
    try:
        args = parser.parse_args(_with_negative_values(arguments))
    except SystemExit as leaving:  # argparse has printed help or what is wrong
        return leaving.code if isinstance(leaving.code, int) else USAGE_ERROR
    if args.called != args.verb:
        print(f"{PROGRAM}: note: {args.called} is now called {args.verb}", file=sys.stderr)
    try:
        with inputs_protected(args):
            return int(importlib.import_module(f".{args.verb}", __name__).run(args))
    except (HexapodError, ImportError) as error:
        if isinstance(error, ImportError) and error.name != "hexapod_comp.core._core":
            raise
        print(f"{PROGRAM}: error: {error}", file=sys.stderr)
    except MemoryError as error:
        print(f"{PROGRAM}: error: this needs more memory than there is: {error}", file=sys.stderr)
    except KeyboardInterrupt:
        return INTERRUPTED
    return USAGE_ERROR


def _with_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join ``--pose -5,0,400`` to ``--pose=-5,0,400``: argparse takes -5,0,400 for an option."""
    joined: list[str] = []
    for argument in arguments:
        after_option = joined and joined[-1].startswith("--") and "=" not in joined[-1]
        if after_option and NEGATIVE.match(argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined
