"""The command ``hexapod_comp <verb>``; every verb lives in a module of :mod:`hexapod_comp.cli`."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence

from ..errors import HexapodError
from ..formats.outputs import inputs_protected
from ..formats.texts import accept_any_terminal

PROGRAM = "hexapod_comp"

DESCRIPTION = """Error compensation for hexapod machine tools: tool poses in, compensated strut lengths out.

Lengths are shown in mm, corrections in µm, angles in degrees. A pose is the tool's pose in the work frame:
x, y, z and the angles α, β, γ with R = Ry(β)·Rx(α)·Rz(γ). A machine or model is a file, or the name of a
shipped one (paper, paper_machine, …)."""

NEGATIVE = re.compile(r"-[.\d]")
"""What follows an option and looks like this is its value, not another option."""

USAGE_ERROR, INTERRUPTED, BROKEN_PIPE = 2, 130, 141
"""Exit codes: bad input; Ctrl-C and a closed pipe as shells count them, 128 + signal."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments after the program's name; those of this process by default.

    Returns
    -------
    int
        Exit code: 0 fine, 1 the verb's own "no", 2 bad input, 130 interrupted.
    """
    arguments = sys.argv[1:] if argv is None else argv
    accept_any_terminal()
    try:
        args = make_parser().parse_args(_with_negative_values(arguments))
    except SystemExit as leaving:  # argparse has printed help or what is wrong
        return leaving.code if isinstance(leaving.code, int) else USAGE_ERROR
    try:
        with inputs_protected(args):
            code = int(args.run(args))
        sys.stdout.flush()
        return code
    except HexapodError as error:
        print(f"{PROGRAM}: error: {error}", file=sys.stderr)
        return USAGE_ERROR
    except ImportError as error:
        if error.name != "numba":
            raise
        print(f"{PROGRAM}: error: {error}", file=sys.stderr)
        return USAGE_ERROR
    except MemoryError as error:
        print(f"{PROGRAM}: error: this needs more memory than there is: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has gone (| head); the interpreter must not complain when it flushes at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE


def make_parser() -> argparse.ArgumentParser:
    """Return the parser with all verbs; importing them must stay cheap: ``--help`` answers at once."""
    from . import assess, check, classify, demo, export, fit, fk, ik, iso230, measure, plan, replay, run

    parser = argparse.ArgumentParser(
        PROGRAM, description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and leave")
    subparsers = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    for verb in (ik, fk, check, assess, run, demo, plan, measure, fit, iso230, export, classify, replay):
        verb.add_parser(subparsers)
    return parser


class _Version(argparse.Action):
    """Print the version of the code that runs."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from ..formats.paths import version

        print(f"{PROGRAM} {version()}")
        parser.exit()


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
