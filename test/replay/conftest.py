"""Each model and machine is read once for all tests, instead of at its first use in each replay."""

from __future__ import annotations

from functools import lru_cache

import pytest

from hexapod_comp.compensation.journal import Source

READ = {name: lru_cache(16)(getattr(Source, name)) for name in ("model", "geometry")}


@pytest.fixture(autouse=True)
def read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, read in READ.items():
        monkeypatch.setattr(Source, name, read)
