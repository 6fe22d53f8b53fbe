"""Mutation testing: the package is changed in one place at a time, and the tests must fail.

    python -m benchmarks.mutants [--count 300] [--seed 0] [--jobs 2] [--rooms ROOM ...] [--only N [N ...]]

The tests that executed the changed line in a recorded run are run, the most specific first; if there are none, those
of the line's room (a folder of the package) and file. ``--only`` repeats mutants by their numbers.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from multiprocessing import get_context
from multiprocessing.pool import ThreadPool
from pathlib import Path
from queue import SimpleQueue

# All tests' libraries are imported once: each mutant is tested in a fork of this process
import hypothesis  # noqa: F401
import pytest
import scipy.optimize
import scipy.spatial.transform  # noqa: F401
from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "hexapod_comp"
FOLDER = ROOT / "out" / "mutants"
# Not mutated: pictures and pages, which people check, and foreign code
NOT_DRAWN = {"pictures.py", "page.py", "shell_page.py", "__main__.py", "stable_abi"}
# Tests of rooms whose lines run in other processes only, and of rooms without a folder of tests
TESTS = {
    "core": ["core", "machine", "compensation", "export", "workspace", "test_pose.py", "virtual/test_physics.py"],
    "ros": ["ros", "loop"],
    "cli": ["cli", "test_doc_commands.py"],
    "testing": ["test_testing.py"], "viewer": ["ros/test_viewer.py"],
    "__init__.py": ["test_public_api.py"], "errors.py": ["test_errors.py"], "pose.py": ["test_pose.py"],
}  # fmt: skip

MOST_OTHERS = 200  # tests of a file's other lines, for a line that runs at import alone
LONGEST = 120  # wall clock time of a test, s
TARGET = 0.95  # share of mutants that must be killed
LIMIT = 20.0  # processor time of a test, s
FAILURES = ("FAILED", "ERROR")  # beginning of the lines that name a failed test in pytest's summary

SWAPS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,), ast.And: (ast.Or,), ast.Or: (ast.And,), ast.Add: (ast.Sub,), ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,), ast.Mod: (ast.Mult,), ast.Pow: (ast.Mult,),
    ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,), ast.USub: (ast.UAdd,),
}  # fmt: skip

Mutant = tuple[ast.AST, str, object]  # a node, the name of one of its fields, and the field's value in the mutant
CMutant = tuple[int, int, str]  # start and end of the replaced text in a C file, and the new text

C_SWAPS = {
    "<": ("<=", ">"), "<=": ("<", ">"), ">": (">=", "<"), ">=": (">", "<"), "==": ("!=",), "!=": ("==",),
    "&&": ("||",), "||": ("&&",), "+": ("-",), "-": ("+",), "*": ("/",), "/": ("*",), "+=": ("-=",), "-=": ("+=",),
}  # fmt: skip

# Changed places in C: operators between spaces, numbers, and assignments that fill a line
C_PLACES = re.compile(
    r"(?<= )(?P<operator><=?|>=?|[=!]=|&&|\|\||[-+]=?|[*/])(?= )"
    r"|(?<![\w.\]])(?P<number>\d+\.\d+(?:e[-+]?\d+)?|\d+)(?![\w.])"
    r"|^ +(?P<statement>[\w.>\[\]-]+ [-+*/]?= [^;{}]+;)$",
    re.MULTILINE,
)
# Declared arrays: a larger array changes no result
C_SIZES = re.compile(r"(?:\b(?:double|int|vec|mat|pair|hc_\w+) \*?\w+|\(\*\w*\))(?:\[\d+\])+")


def c_mutants(text: str) -> Iterator[CMutant]:
    """Yield all mutants of a C file, except in comments, strings, preprocessor lines and sizes of declared arrays."""
    hidden = re.compile(r"/\*.*?\*/|//[^\n]*|\"(?:\\.|[^\"\n])*\"|^#(?:[^\n]*\\\n)*[^\n]*", re.DOTALL | re.MULTILINE)
    code = hidden.sub(lambda found: re.sub(r"[^\n]", "_", found[0]), text)
    code = C_SIZES.sub(lambda found: re.sub(r"\d", "_", found[0]), code)
    begin = code.find("{")  # only declarations come before the first function body
    for found in C_PLACES.finditer(code, max(begin, 0)):
        kind = found.lastgroup or ""
        if kind == "statement":
            yield *found.span(kind), ";"
        elif kind == "number":
            number = found[kind]
            yield *found.span(kind), repr(2.0 * float(number) or 1.0) if "." in number else str(int(number) + 1)
        else:
            yield from ((*found.span(kind), other) for other in C_SWAPS[found[kind]])


def mutants(node: ast.AST) -> Iterator[Mutant]:
    """Yield all mutants of a node and its children, except in types, decorators, string literals and `strict`."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    if isinstance(node, ast.keyword) and node.arg == "strict":  # zip's check of lengths: valid code never fails it
        return
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".reshape"):
        yield from mutants(node.func)  # not its arguments: NumPy takes any negative length for -1
        return
    yield from changes(node)
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns", "decorator_list", "format_spec"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from mutants(child)


def changes(node: ast.AST) -> Iterator[Mutant]:
    """Yield the mutants that change one field of this node, without its children."""
    for swapped in SWAPS.get(type(getattr(node, "op", None)), ()):
        yield node, "op", swapped()
    if isinstance(node, ast.Compare):
        for i, operator in enumerate(node.ops):
            for swapped in SWAPS.get(type(operator), ()):
                yield node, "ops", [*node.ops[:i], swapped(), *node.ops[i + 1 :]]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node, "operand", ast.UnaryOp(ast.Not(), node.operand)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield node, "value", not node.value
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield node, "value", node.value * 2 if isinstance(node.value, float) and node.value else node.value + 1
    elif isinstance(node, ast.Return) and node.value is not None and ast.unparse(node.value) not in ("None", "False"):
        yield node, "value", None
    for field in ("body", "orelse", "finalbody"):
        statements = getattr(node, field, None)
        for i, line in enumerate(statements if isinstance(statements, list) else ()):
            documents = isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)
            # An assignment to a name is not removed, because every test would fail.
            local = isinstance(line, ast.Assign) and all(isinstance(target, ast.Name) for target in line.targets)
            if isinstance(line, ast.Expr | ast.Assign | ast.AugAssign | ast.Raise) and not documents and not local:
                yield node, field, [*statements[:i], ast.copy_location(ast.Pass(), line), *statements[i + 1 :]]


def describe(path: Path, mutant: Mutant | CMutant) -> str:
    """Return file, line number, source line and change of a mutant as text."""
    if isinstance(mutant[0], int):
        text = path.read_text(encoding="utf-8")
        begin, end, new = mutant
        number = text.count("\n", 0, begin)
        line = text.splitlines()[number].strip()
        return f"{path.relative_to(PACKAGE)}:{number + 1}: {line}  [{text[begin:end]} → {new}]"
    node, field, value = mutant
    was = getattr(node, field)
    if field in ("body", "orelse", "finalbody"):
        number = next(old for old, new in zip(was, value, strict=True) if old is not new).lineno
        change = "removed"
    else:
        number, change = node.lineno, ast.unparse(node)  # type: ignore[attr-defined]
        setattr(node, field, value)
        change += f" → {ast.unparse(node)}"
        setattr(node, field, was)
    line = path.read_text(encoding="utf-8").splitlines()[number - 1].strip()
    return f"{path.relative_to(PACKAGE)}:{number}: {line}  [{change}]"


class ProcessorTime:
    """A pytest plugin: a test fails if its processor time exceeds a limit, s."""

    def __init__(self, limit: float) -> None:
        self.limit = limit
        signal.signal(signal.SIGPROF, self._end)

    def _end(self, number: int, frame: object) -> None:
        pytest.fail(f"took {self.limit} s")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self) -> Iterator[None]:
        """Limit the processor time of a test and its fixtures."""
        signal.setitimer(signal.ITIMER_PROF, self.limit)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)


class Coverage:
    """The tests that execute each line, recorded in a run of all tests after a file has changed."""

    def __init__(self) -> None:
        recorded = FOLDER / "coverage"
        newest = max(path.stat().st_mtime for room in (PACKAGE, ROOT / "test") for path in room.rglob("*.py"))
        if not recorded.exists() or recorded.stat().st_mtime < newest:
            recorded.unlink(missing_ok=True)
            command = ["pytest", "-q", "-n2", "--dist=loadfile", "--ignore=test/packaging", "--cov=hexapod_comp"]
            own = {"COVERAGE_FILE": str(recorded), "OPENBLAS_NUM_THREADS": "1"}
            output = FOLDER / "recording.txt"
            print(f"recording which tests execute which lines, output in {output}; this takes minutes", flush=True)
            subprocess.run([sys.executable, "-m", *command, "--cov-context=test", "--cov-report="],
                           cwd=ROOT, env=os.environ | own, check=True, stdout=output.open("w"))  # fmt: skip
        data = CoverageData(str(recorded))
        data.read()
        self.tests = {
            path: {
                line: {context.rpartition("|")[0] for context in contexts} - {""}
                for line, contexts in data.contexts_by_lineno(path).items()
            }
            for path in data.measured_files()
        }
        self.passed = Counter(test for lines in self.tests.values() for tests in lines.values() for test in tests)

    def of(self, path: Path, first: int, last: int) -> list[str]:
        """Return the tests of lines `first` to `last`, the most specific first, file by file."""
        lines, room = self.tests.get(str(path), {}), path.relative_to(PACKAGE).parts[0]
        found: Iterable[str] = set[str]().union(*(lines.get(line, ()) for line in range(first, last + 1)))
        of_room: list[str] = []
        if not found:  # the lines run at import alone
            of_room = [f"test/{one}" for one in TESTS.get(room, [room]) if (ROOT / "test" / one).exists()]
            others = [test for test in set[str]().union(*lines.values()) if not test.startswith(tuple(of_room))]
            found = sorted(others, key=lambda one: (self.passed[one], one))[:MOST_OTHERS]
        by_file: dict[str, list[str]] = {}
        for test in sorted(found, key=lambda one: self.passed[one]):
            by_file.setdefault(test.partition("::")[0], []).append(test)
        return [*of_room, *(test for tests in by_file.values() for test in tests)]


class Copy:
    """A copy of the sources and tests, in which one mutant at a time is tested."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for path in ROOT.iterdir():
            if path.is_dir() and path.name[0] != "." and path.name not in ("out", "build", "install", "log"):
                shutil.rmtree(folder / path.name, ignore_errors=True)
                shutil.copytree(path, folder / path.name, ignore=shutil.ignore_patterns("__pycache__"))
            elif path.is_file():
                shutil.copy2(path, folder)

    def failure(self, tests: list[str]) -> str:
        """Return the first failure of the tests, run in a fork that has not imported the project; "" if all pass."""
        arguments = ["-q", "-x", "--tb=no", "-p", "no:cacheprovider", "-o", f"timeout={LONGEST}", *tests]
        with tempfile.TemporaryFile("w+") as output:
            child = get_context("fork").Process(target=self._in_child, args=(arguments, output.fileno()))
            child.start()
            child.join()
            output.seek(0)
            lines = output.read().splitlines()
        failed = [line for line in lines if line.startswith(FAILURES)]
        last = lines[-1] if lines else "no output"
        return failed[0] if failed else "" if " passed" in last and "error" not in last else last

    def _in_child(self, arguments: list[str], output: int) -> None:
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(self.folder)
        os.environ["PYTHONPATH"] = str(self.folder)
        sys.path.insert(0, str(self.folder))
        code = pytest.main(arguments, plugins=[ProcessorTime(LIMIT)])
        sys.stdout.flush()
        os._exit(int(code))

    def killed_by(self, path: Path, text: str, tests: list[str]) -> str:
        """Write a mutant into the copy, run the tests, and restore the file."""
        place = self.folder / path.relative_to(ROOT)
        try:
            place.write_text(text, encoding="utf-8")
            command = [sys.executable, "setup.py", "-q", "build_ext", "--inplace", "--force"]
            if path.suffix == ".c" and subprocess.run(command, cwd=self.folder, capture_output=True).returncode:
                return "the compiler"
            return self.failure(tests) if tests else ""
        finally:
            shutil.copy2(path, place)
            if path.suffix == ".c":
                (library,) = (PACKAGE / "core").glob("*.so")
                (self.folder / library.relative_to(ROOT)).unlink(missing_ok=True)
                shutil.copy2(library, self.folder / library.relative_to(ROOT))


def mutated(tree: ast.Module | str, mutant: Mutant | CMutant) -> str:
    """Return the file's text with the mutant."""
    if isinstance(tree, str):
        begin, end, new = mutant
        return f"{tree[:begin]}{new}{tree[end:]}"  # type: ignore[index,misc]
    node, field, value = mutant
    was = getattr(node, field)  # type: ignore[arg-type]
    setattr(node, field, value)  # type: ignore[arg-type]
    try:
        return ast.unparse(ast.fix_missing_locations(tree))
    finally:
        setattr(node, field, was)  # type: ignore[arg-type]


def lines_of(tree: ast.Module | str, mutant: Mutant | CMutant) -> tuple[int, int]:
    """Return the first and last line of the mutant's statement; 0, 0 for C, which is not recorded."""
    if isinstance(tree, str):
        return 0, 0
    node, field, value = mutant
    if isinstance(value, list) and field != "ops":  # a statement was removed
        node = next(old for old, new in zip(getattr(node, field), value, strict=True) if old is not new)  # type: ignore[arg-type]
    first = node.lineno  # type: ignore[union-attr]
    around = [
        one for one in ast.walk(tree) if isinstance(one, ast.stmt) and one.lineno <= first <= (one.end_lineno or 0)
    ]
    body = max(around, key=lambda one: one.lineno)
    return body.lineno, first if hasattr(body, "body") else body.end_lineno or first


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300, metavar="N", help="number of mutants (default 300)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random choice (default 0)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="number of processes (default 2)")
    parser.add_argument("--rooms", nargs="+", metavar="ROOM", help="mutate these rooms only, such as ros or core")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="test only the mutants with these numbers")
    args = parser.parse_args()
    files = [path for path in sorted(PACKAGE.rglob("*.[cp]*")) if path.suffix in (".c", ".py")]
    files = [path for path in files if not NOT_DRAWN & set(path.relative_to(PACKAGE).parts)]
    files = [path for path in files if not args.rooms or path.relative_to(PACKAGE).parts[0] in args.rooms]
    texts = {path: path.read_text(encoding="utf-8") for path in files}
    trees = {path: text if path.suffix == ".c" else ast.parse(text) for path, text in texts.items()}
    every: list[tuple[Path, Mutant | CMutant]] = []
    for path, tree in trees.items():
        every += [(path, one) for one in (c_mutants(tree) if isinstance(tree, str) else mutants(tree))]
    drawn = list(enumerate(random.Random(args.seed).sample(every, args.count), 1))
    print(f"{len(every)} mutants of {len(files)} files; {len(drawn)} drawn with seed {args.seed}", flush=True)
    FOLDER.mkdir(parents=True, exist_ok=True)
    coverage, start = Coverage(), time.monotonic()
    chosen = [
        (number, path, describe(path, one), mutated(trees[path], one), coverage.of(path, *lines_of(trees[path], one)))
        for number, (path, one) in drawn
        if not args.only or number in args.only
    ]
    copies = SimpleQueue[Copy]()
    for number in range(args.jobs):
        (FOLDER / f"{number}").mkdir(exist_ok=True)
        copies.put(Copy(FOLDER / f"{number}"))

    def judged(one: tuple[int, Path, str, str, list[str]]) -> tuple[str, bool]:
        number, path, what, text, tests = one
        copy, began = copies.get(), time.monotonic()
        by = copy.killed_by(path, text, tests)
        copies.put(copy)
        outcome = f"killed   {what}  {by}" if by else f"SURVIVED {what}"
        print(f"{number:4} {outcome}  {time.monotonic() - began:.0f} s", flush=True)
        return path.relative_to(PACKAGE).parts[0], bool(by)

    with ThreadPool(args.jobs) as pool:
        rooms = Counter(pool.map(judged, chosen, chunksize=1))
    for room in sorted({name for name, _ in rooms}):
        print(f"{room}: {rooms[room, True]} of {rooms[room, True] + rooms[room, False]} killed")
    killed = sum(number for (_, by), number in rooms.items() if by)
    print(f"{killed} of {len(chosen)} killed, {killed / len(chosen):.1%}; {time.monotonic() - start:.0f} s")
    return 0 if killed >= TARGET * len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
