"""Errors keep their arguments on the way from worker processes to the caller."""

from __future__ import annotations

import importlib
import inspect
import pickle
from collections.abc import Iterator
from pathlib import Path

from hexapod_comp.errors import HexapodError

PACKAGE = Path(__file__).resolve().parents[1] / "hexapod_comp"
# Arguments that are no text
GIVEN = {"path": Path("mine.yaml"), "value": 0.25, "limit": 0.2, "strut": 3, "status": 1}


def classes() -> list[type[HexapodError]]:
    """Return every error class of the package."""
    for path in PACKAGE.rglob("*.py"):
        if "Error):" in path.read_text(encoding="utf-8"):
            importlib.import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts))
    found = list(_below(HexapodError))
    assert len(found) > 15  # fewer would mean that the search failed
    return [HexapodError, *found]


def _below(kind: type[HexapodError]) -> Iterator[type[HexapodError]]:
    for child in kind.__subclasses__():
        yield child
        yield from _below(child)


def made(kind: type[HexapodError]) -> HexapodError:
    """Return an error with an argument for each parameter."""
    names = [name for name in inspect.signature(kind.__init__).parameters if name not in ("self", "args", "kwargs")]
    return kind(*(GIVEN.get(name, f"some {name}\nof it") for name in names)).with_lines("two\nlines")


def test_every_error_comes_out_of_a_worker_as_it_was_raised():
    """A process pool pickles an error in the worker and unpickles it in the caller."""
    for error in [made(kind) for kind in dict.fromkeys(classes())]:
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error)
        assert (str(again), again.args, again.reason) == (str(error), error.args, error.reason)
        assert vars(again) == vars(error)
