"""The command line of a node's program: ``--help``, and a refusal of what nobody would read."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from rclpy.utilities import remove_ros_args

from ..errors import LONGEST_TEXT, printable
from ..formats.texts import run_with_plain_streams
from .parameters import Parameter, shown

ROS_ARGUMENTS, END_OF_ROS_ARGUMENTS = "--ros-args", "--"

USAGE_ERROR = 2

WIDTH = 118
"""Of the help, characters."""


@dataclass(frozen=True)
class Program:
    """A node as a program.

    Parameters
    ----------
    name : str
        Of the executable.
    summary : str
        What it does, one sentence.
    parameters : sequence of Parameter
        Its ROS parameters.
    topics : str
        Its topics and services in brief, one on a line.
    example : str
        What stands behind ``--ros-args`` in the example.
    """

    name: str
    summary: str
    parameters: Sequence[Parameter]
    topics: str = ""
    example: str = "-p autostart:=false"

    def refusal(self, arguments: Sequence[str]) -> int | None:
        """Return the exit code of a program that must not start with these arguments, having said why; else None.

        0 after ``--help``, 2 where an argument is not understood. What follows ``--ros-args`` is ROS's to read.
        rcl itself would take a stray ``name:=value`` for a rename, and leave everything else unread.
        """
        return run_with_plain_streams(lambda: self._refusal(arguments))

    def _refusal(self, arguments: Sequence[str]) -> int | None:
        parser = argparse.ArgumentParser(
            self.name,
            usage=f"{self.name} [-h] [--ros-args -p NAME:=VALUE … -r TOPIC:=OTHER … --params-file FILE …]",
            description=self.summary,
            epilog=self._epilog(),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        try:
            _, strange = parser.parse_known_args(outside_ros(arguments))
            if strange:
                shown = printable(" ".join(strange), LONGEST_TEXT)
                parser.error(
                    f"arguments not understood: {shown}. Parameters follow --ros-args: "
                    f"{self.name} {ROS_ARGUMENTS} {self.example}"
                )
            remove_ros_args(list(arguments))
        except RuntimeError as error:
            parser.print_usage(sys.stderr)
            text = f"{self.name}: error: ROS arguments not understood: {error}"
            print(printable(text, LONGEST_TEXT), file=sys.stderr)
            return USAGE_ERROR
        except SystemExit as leaving:
            return leaving.code if isinstance(leaving.code, int) else USAGE_ERROR
        return None

    def _epilog(self) -> str:
        lines = ["parameters (-p NAME:=VALUE behind --ros-args; default in brackets):"]
        for parameter in self.parameters:
            text = f"{parameter.name}  [{shown(parameter.default)}]  {parameter.described()}"
            lines += textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="      ")
        topics = ["", "topics and services:", *textwrap.indent(self.topics.strip(), "  ").splitlines()]
        example = ["", f"example: {self.name} {ROS_ARGUMENTS} {self.example}"]
        return "\n".join([*lines, *(topics if self.topics else ()), *example])


def outside_ros(arguments: Sequence[str]) -> list[str]:
    """Return the arguments that do not stand between ``--ros-args`` and ``--`` or the end."""
    left, inside = [], False
    for argument in arguments:
        if argument == ROS_ARGUMENTS:
            inside = True
        elif inside:
            inside = argument != END_OF_ROS_ARGUMENTS
        else:
            left.append(argument)
    return left
