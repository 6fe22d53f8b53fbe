"""Completion in the shell, by argcomplete: verbs, options, files, and the names of shipped files of the right kind."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from typing import Any

from ..formats.outputs import FOLDERS, READ, WRITTEN
from ..formats.paths import shipped_names
from .parsers import ALIASES

KINDS = {
    "machine": "geometry",
    "model": "model",
    "truth": "model",
    "campaign": "campaign",
    "budget": "error_budget",
    "columns": "columns",
    "poses": "poses",
}
"""What a file says that it is, by the argument that names it."""


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell, which waits for completions, and leave; without argcomplete this does nothing."""
    try:
        import argcomplete
    except ImportError:  # an extra; nobody reads what is printed now
        return
    for action in _actions(parser):
        if action.dest in (*READ, *WRITTEN, *FOLDERS):
            action.completer = _Names(action.dest, argcomplete.FilesCompleter())  # type: ignore[attr-defined]
    old = [name for names in ALIASES.values() for name in names]
    argcomplete.autocomplete(parser, exclude=old, default_completer=argcomplete.completers.SuppressCompleter())


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                yield from verb._actions
        yield action


class _Names:
    """Completes an argument that names a file: with files, and with the shipped ones that it takes."""

    def __init__(self, argument: str, files: Any) -> None:
        self._argument, self._files = argument, files

    def __call__(self, prefix: str, **_: object) -> list[str]:
        return [name for name in self._shipped() if name.startswith(prefix)] + self._files(prefix)

    def _shipped(self) -> Iterable[str]:
        kind = KINDS.get(self._argument)
        own = ["ideal", "random"] if kind == "model" else []
        return own + shipped_names(kind) if kind else []
