"""Which terms of a model each export can represent; an export refuses a model with a term that it cannot."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..errors import ModelError
from ..machine.model import MachineModel
from ..machine.terms import Row

PROVENANCE = ("machine", "name", "origin", "region")  # Fields of a model that have no effect on the tool
IN_CORE = frozenset({"field.grid", "field.lines", "field.outside", "late_growth.thermometer"})
"""Terms of the C core that have no row in the model's table of terms; the core has all rows except ``outside``."""


def refuse_unknown(model: MachineModel, export: str, without: tuple[str, ...] = ()) -> None:
    """Raise ModelError for a term that the C core lacks, or whose name begins with one of the prefixes in `without`.

    Exports to LinuxCNC and to a table accept models with some terms that they omit; their reports name these terms.
    """
    for name, row, value in terms(model):
        in_core = name in IN_CORE if row is None else row.place != "outside"
        if not in_core or name.startswith(without):
            other = "export it as C (--c)" if in_core else "run the model in the compensator"
            problem = f"cannot be exported: {export} has no such term. Remove the term, or {other}"
            written = (name, np.asarray(value).tolist())
            if row is not None:
                key, number = row.numbers.write(row.key or name.rpartition(".")[2], value)
                written = (f"{row.place}.{key}", number)
            raise ModelError(written[0], problem, written[1])


def terms(model: MachineModel) -> Iterator[tuple[str, Row | None, Any]]:
    """Yield name (such as ``struts.pitch``), row (None: no key of a model file) and value of each non-ideal term."""
    for name, row, value in _differences(model, MachineModel(model.machine)):
        if name.partition(".")[0] not in PROVENANCE:
            yield name, row, value


def _differences(
    value: Any, ideal: Any, path: str = "", row: Row | None = None
) -> Iterator[tuple[str, Row | None, Any]]:
    """Yield name, row and value of each field in which the dataclass `value` differs from `ideal`."""
    if not dataclasses.is_dataclass(value):
        if not _same(value, ideal):
            yield path, row, value
        return
    for entry in dataclasses.fields(value):
        made = entry.default if entry.default_factory is dataclasses.MISSING else entry.default_factory()
        here = f"{path}.{entry.name}" if path else entry.name
        own = getattr(value, entry.name), getattr(ideal, entry.name, made)
        yield from _differences(*own, here, entry.metadata.get("row"))


def _same(value: Any, ideal: Any) -> bool:
    if isinstance(value, tuple) and isinstance(ideal, tuple):
        return len(value) == len(ideal) and all(map(_same, value, ideal))
    return np.array_equal(value, ideal)
