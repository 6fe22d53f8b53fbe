"""How much the tests see: mutants of the core, each changed in one place, and whether a test fails.

    python -m benchmarks.mutants [--count 200] [--seed 0] [--only N [N ...]]

A mutant is a copy of the sources with one operator, ``not``, number, returned value or statement changed, drawn at
random from all such places. The tests that concern its file run until one fails: it is killed, also when they run out
of time. Mutants of kernels run as plain Python first, without the tests that need compiled code, since compiling takes
a minute; one that survives so is compiled. ``--only`` repeats mutants by their numbers, as after a new test.
Exits 1 when fewer than 95 % are killed. The figures, and why those that survive are equivalent: doc/benchmarks.md.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "hexapod_comp"
CORE = ("pose.py", "machine/*.py", "compensation/*.py", "kernels/*.py", *(f"calibration/{name}.py" for name in
        ("estimation", "sensitivity", "selection")))  # fmt: skip
NOT_CORE = {"pictures.py", "compiling.py"}

TESTS = {
    "pose.py": ["test_pose.py", "machine", "nodes/test_conversions.py"],
    "machine": ["machine", "test_errors.py", "compensation", "virtual/test_simulation.py", "cli/test_cli.py"],
    "compensation": [
        "compensation",
        "machine/test_limits.py",
        "virtual/test_simulation.py",
        "replay",
        "cli/test_cli.py",
    ],
    "kernels": ["machine/test_kinematics.py", "machine", "compensation", "kernels", "virtual/test_simulation.py"],
    "calibration": [
        "calibration/test_sensitivity.py",
        "calibration/test_fit.py",
        "calibration",
        "cli/test_fit_verb.py",
    ],
}
"""Where a room's tests are, from near to far; before them run those whose file has the mutated module's name."""

BAR = 0.95
LIMIT = 400.0
"""Seconds that the tests of one mutant may take."""

FAILURES = ("FAILED", "ERROR")
"""How the lines of pytest's summary begin that name a test."""

SWAPS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,), ast.And: (ast.Or,), ast.Or: (ast.And,), ast.Add: (ast.Sub,), ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,), ast.Mod: (ast.Mult,), ast.Pow: (ast.Mult,),
    ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,), ast.USub: (ast.UAdd,),
}  # fmt: skip

Mutant = tuple[ast.AST, str, object]
"""A node, the name of one of its fields, and what the field holds in the mutant."""


def mutants(node: ast.AST) -> Iterator[Mutant]:
    """Yield all mutants of a node and of what is in it; types, decorators and texts have none."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    yield from changes(node)
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns", "decorator_list", "format_spec"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from mutants(child)


def changes(node: ast.AST) -> Iterator[Mutant]:
    """Yield the mutants that change one field of this very node."""
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
    elif isinstance(node, ast.Return) and node.value is not None:
        yield node, "value", None
    for field in ("body", "orelse", "finalbody"):
        statements = getattr(node, field, None)
        for i, line in enumerate(statements if isinstance(statements, list) else ()):
            documents = isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant)
            # Without a first `name = …` all would fail.
            local = isinstance(line, ast.Assign) and all(isinstance(target, ast.Name) for target in line.targets)
            if isinstance(line, ast.Expr | ast.Assign | ast.AugAssign | ast.Raise) and not documents and not local:
                yield node, field, [*statements[:i], ast.copy_location(ast.Pass(), line), *statements[i + 1 :]]


def describe(path: Path, mutant: Mutant) -> str:
    """Return file, line, what stands there, and what changes."""
    node, field, value = mutant
    was = getattr(node, field)
    if field in ("body", "orelse", "finalbody"):
        number = next(old for old, new in zip(was, value, strict=True) if old is not new).lineno
        change = "removed"
    else:
        number, change = node.lineno, ast.unparse(node)
        setattr(node, field, value)
        change += f" → {ast.unparse(node)}"
        setattr(node, field, was)
    line = path.read_text(encoding="utf-8").splitlines()[number - 1].strip()
    return f"{path.relative_to(PACKAGE)}:{number}: {line}  [{change}]"


class Copy:
    """A copy of sources and tests in which one file at a time is a mutant."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.left_out: list[str] = []
        self.cache = "compiled"
        for path in ROOT.iterdir():
            if path.is_dir() and path.name[0] != "." and path.name not in ("out", "build", "install", "log"):
                shutil.copytree(path, folder / path.name, ignore=shutil.ignore_patterns("__pycache__"))
            elif path.is_file():
                shutil.copy2(path, folder)

    def check(self, room: str) -> None:
        """Run a room's tests without a mutant; leave out those that fail as plain Python, or take long."""
        if room == "kernels":
            done = self._run(TESTS[room], False, None, "--tb=no", "-o", "timeout=10")
            self.left_out = [f"--deselect={line.split()[1]}" for line in done.splitlines() if line.startswith(FAILURES)]
            print(f"{len(self.left_out)} tests of kernels left out as plain Python", flush=True)
        failed = self.failure(TESTS[room], True)
        if failed:
            raise SystemExit(f"no mutants before all tests pass: {failed}")

    def failure(self, tests: list[str], compiled: bool) -> str:
        """Return what failed first, or "" where nothing does."""
        try:
            done = self._run(tests, compiled, LIMIT, "-x", "--tb=no", *([] if compiled else self.left_out))
        except subprocess.TimeoutExpired:
            return "out of time"
        lines = done.splitlines()
        failed = [line for line in lines if line.startswith(FAILURES)]
        return failed[0] if failed else "" if " passed" in lines[-1] and "error" not in lines[-1] else lines[-1]

    def _run(self, tests: list[str], compiled: bool, limit: float | None, *options: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(self.folder), "OPENBLAS_NUM_THREADS": "1"}
        environment |= {"NUMBA_DISABLE_JIT": "0" if compiled else "1", "NUMBA_CACHE_DIR": str(self.folder / self.cache)}
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
        command += dict.fromkeys(f"test/{test}" for test in tests)
        return subprocess.run(
            command, cwd=self.folder, env=environment, check=False, stdout=subprocess.PIPE, text=True, timeout=limit
        ).stdout

    def killed_by(self, path: Path, tree: ast.Module, mutant: Mutant) -> str:
        """Put a mutant in its file's place, run the tests, and put the file back."""
        node, field, value = mutant
        was, place = getattr(node, field), self.folder / path.relative_to(ROOT)
        room = path.relative_to(PACKAGE).parts[0]
        tests = [str(own.relative_to(ROOT / "test")) for own in (ROOT / "test").rglob(f"test_{path.stem}.py")]
        self.cache = "compiled" if room != "kernels" else "compiled-mutant"
        setattr(node, field, value)
        try:
            place.write_text(ast.unparse(ast.fix_missing_locations(tree)), encoding="utf-8")
            plain = room == "kernels" and self.failure(tests + TESTS[room], False)
            return plain or self.failure(tests + TESTS[room], True)
        finally:
            setattr(node, field, was)
            shutil.copy2(path, place)


def main() -> int:
    """Draw mutants, try them and say which survive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200, metavar="N", help="how many mutants (default 200)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the draw (default 0)")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="only the mutants of these numbers")
    args = parser.parse_args()
    files = [path for pattern in CORE for path in sorted(PACKAGE.glob(pattern)) if path.name not in NOT_CORE]
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}
    every = [(path, mutant) for path, tree in trees.items() for mutant in mutants(tree)]
    drawn = list(enumerate(random.Random(args.seed).sample(every, args.count), 1))
    print(f"{len(every)} mutants of {len(files)} files; {len(drawn)} drawn with seed {args.seed}", flush=True)
    chosen = [one for one in drawn if not args.only or one[0] in args.only]
    survived = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for room in sorted({path.relative_to(PACKAGE).parts[0] for _, (path, _) in chosen}):
            copy.check(room)
        for number, (path, mutant) in chosen:
            began, what = time.monotonic(), describe(path, mutant)
            by = copy.killed_by(path, trees[path], mutant)
            survived += not by
            outcome = f"killed   {what}  {by}" if by else f"SURVIVED {what}"
            print(f"{number:4} {outcome}  {time.monotonic() - began:.0f} s", flush=True)
    killed = len(chosen) - survived
    print(f"{killed} of {len(chosen)} killed, {killed / len(chosen):.1%}")
    return 0 if killed >= BAR * len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
