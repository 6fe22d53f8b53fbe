"""The command ``hexapod_comp <verb>``: the parser, made from the table of verbs, and the call of the verb."""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from collections.abc import Iterable, Sequence
from itertools import groupby, takewhile
from typing import Any

from ..errors import CommandError, HexapodError, InputFileError
from ..formats.outputs import protected
from ..formats.texts import did_you_mean, run_with_plain_streams
from .verbs import DESCRIPTION, EPILOG, VERBS, Verb

PROGRAM = "hexapod_comp"

NEGATIVE = re.compile(r"-[.\d]")  # Beginning of a negative number, in contrast to an option

NUMBERS = re.compile(r"[-+.\d]+(,[-+.\d]+)+")  # Text that is not a file's name but numbers
TYPED = {"poses": "--pose", "lengths": "--lengths"}  # Option that takes numbers, by the kind of file that it replaces

ROLES = ("reads", "writes", "folder")  # of options that name a file or folder

# Verbs with small matrices, which are faster with one thread: threads of BLAS wait for each other on busy cores
ONE_THREAD = ("fit", "verify", "demo")

USAGE_ERROR, INTERRUPTED = 2, 130  # exit codes: bad input; Ctrl-C (128 + signal number, as in shells)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, by default with this process's arguments, and return the exit code: 0, success; 1, negative
    result of the verb; 2, bad input, or an output cannot be written; 130, interrupted; 141, nobody reads the output."""
    arguments = sys.argv[1:] if argv is None else argv
    return run_with_plain_streams(lambda: _run(arguments)) or 0


def _run(arguments: Sequence[str]) -> int:
    name = arguments[0] if arguments and not arguments[0].startswith("-") else ""
    if name and name not in VERBS:
        return _fail(f"there is no verb {name!r}{_suggestion(name, VERBS)}; {PROGRAM} --help lists them")
    completing = "_ARGCOMPLETE" in os.environ
    parser = make_parser([name] if name and not completing else VERBS)  # one verb's options: all take 20 ms
    if completing:
        complete(parser)
    try:
        args = parser.parse_args(arguments)
    except SystemExit as leaving:  # argparse has printed help or the error
        return int(leaving.code or 0)
    verb = VERBS[args.verb]
    named = {role: {o.label: getattr(args, o.dest) for o in verb.options if o.role == role} for role in ROLES}
    try:
        _check_conflicts(verb, args)
        _refuse_numbers_as_files(verb, args)
        with protected(*named.values()):
            if args.verb in ONE_THREAD:  # before the import of NumPy, which reads this variable
                os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
            run = getattr(importlib.import_module(f".{verb.module}", __package__), args.verb)
            result = run(args)
            return result if isinstance(result, int) else int(result.finish(args))
    except (HexapodError, ImportError) as error:
        if isinstance(error, ImportError) and error.name != "hexapod_comp.core._core":
            raise
        return _fail(str(error))
    except MemoryError as error:
        return _fail(f"not enough memory: {error}")
    except KeyboardInterrupt:
        return INTERRUPTED


def _fail(problem: str) -> int:
    print(f"{PROGRAM}: error: {problem}", file=sys.stderr)
    return USAGE_ERROR


def _suggestion(name: str, names: Iterable[str]) -> str:
    # Without the dashes, which all options have in common
    return did_you_mean(name.lstrip("-"), {one.lstrip("-"): one for one in names})


def _check_conflicts(verb: Verb, args: argparse.Namespace) -> None:
    options = {option.name: option for option in verb.options}

    def given(names: str) -> bool:
        found = [(options[name.partition(" ")[0]], name.partition(" ")[2]) for name in names.split(" or ")]
        return any(str(getattr(args, one.dest)) == word if word else one.given(args) for one, word in found)

    def label(names: str) -> str:
        return " or ".join(options[name].label if name in options else name for name in names.split(" or "))

    for rule in verb.rules:
        if problem := rule.problem(given, label):
            raise CommandError("usage", problem)


def _refuse_numbers_as_files(verb: Verb, args: argparse.Namespace) -> None:
    """Raise an InputFileError that names the right option if numbers stand in place of a file's name."""
    names = {option.name for option in verb.options}
    for option in verb.options:
        typed, name = TYPED.get(option.kind), getattr(args, option.dest)
        if typed in names and name and NUMBERS.fullmatch(name) and not os.path.exists(name):
            raise InputFileError(name, "", f"there is no such file; give numbers by an option: {typed} {name}")


class _Parser(argparse.ArgumentParser):
    """Parser that suggests the right name for a misspelled option, refuses an option given twice, and takes numbers
    such as -5,0,400 as the value of an option, although they begin with a hyphen.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._negative_number_matcher = NEGATIVE

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        options = [option for option in self._option_string_actions if option.startswith("--")]
        own = args if self._subparsers is None else takewhile(lambda one: one.startswith("-"), args)
        given = set[str]()
        for one in takewhile(lambda one: one != "--", own):
            name = one.partition("=")[0]
            if not name.startswith("--"):
                continue
            meant = [name] if name in options else [option for option in options if option.startswith(name)]
            if not meant:
                where = _suggestion(name, options) if self._subparsers is None else " before the verb"
                self.error(f"there is no option {name}{where}")
            if meant[0] in given:
                self.error(f"{meant[0]} is given twice")
            if not isinstance(self._option_string_actions[meant[0]], argparse._AppendAction):
                given.add(meant[0])
        found, unexpected = super().parse_known_args(args, namespace)
        if unexpected:
            self.error(f"unexpected argument: {' '.join(unexpected)}")
        return found, unexpected


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from ..formats.paths import version

        print(f"{PROGRAM} {version()}")
        parser.exit()


def make_parser(names: Iterable[str] = VERBS) -> argparse.ArgumentParser:
    """Return a parser of the verbs `names`; its help lists all verbs."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(PROGRAM, description=DESCRIPTION, epilog=EPILOG, formatter_class=raw)
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    listed = []
    for group, verbs in groupby(VERBS.items(), lambda item: item[1].group):
        listed += [f"{group}:", *(f"  {name:<9} {verb.summary}" for name, verb in verbs)]
    subparsers = parser.add_subparsers(
        title="verbs",
        description="\n".join(listed),
        dest="verb",
        metavar="VERB",
        required=True,
        help="VERB --help prints the verb's options, units and an example",
    )
    for name in names:
        verb = VERBS[name]
        own = subparsers.add_parser(name, description=verb.summary, epilog=verb.text, formatter_class=raw)
        groups: dict[str, Any] = {"": own}
        for option in verb.options:
            if option.heading not in groups:
                groups[option.heading] = own.add_argument_group(option.heading)
            action = groups[option.heading].add_argument(option.name, help=option.help, **option.keywords)
            # nargs of optional files is "+": with "*" argparse would refuse `MODEL --compensated FILE`
            if option.keywords.get("default") == []:
                action.required = False
            action.declared = option
    return parser


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell's request for completions and exit; without argcomplete do nothing."""
    try:
        import argcomplete
    except ImportError:
        return
    from ..formats.paths import shipped_names

    files = argcomplete.FilesCompleter()

    def names(prefix: str, parsed_args: Any = None, action: Any = None, **_: object) -> list[str]:
        """Return the names of the files, and of the shipped files that the option accepts, that begin with `prefix`."""
        kind = action.declared.kind
        shipped = ["ideal", "random"] * (kind == "model") + (
            shipped_names(kind) if kind not in ("", "readings") else []
        )
        return [name for name in shipped if name.startswith(prefix)] + files(prefix)

    (verbs,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for verb in verbs.choices.values():
        for action in verb._actions:
            if (declared := getattr(action, "declared", None)) is not None and declared.role:
                action.completer = names
    argcomplete.autocomplete(parser, default_completer=argcomplete.completers.SuppressCompleter())
