"""The extension module that setup.py builds."""

from __future__ import annotations

from pathlib import Path

from hexapod_comp import core
from hexapod_comp.core.build import sources_hash


def test_the_core_was_built_of_these_very_sources():
    """Where it fails: python setup.py build_ext --inplace."""
    assert core.ffi.string(core.lib.hc_sources()).decode() == sources_hash(Path(core.__file__).parent)


def test_it_names_each_refusal():
    assert core.ffi.string(core.lib.hc_reason(core.lib.HC_BASE_CONE)) == b"base_cone"
