"""Reads measured files, tidy or wide CSV, into one MeasurementSet."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import InputFileError
from ..formats.paths import config_file, input_file
from ..machine.geometry import HexapodGeometry
from .readings import MeasurementSet
from .runs import assembled
from .tidy import read_tidy
from .wide_csv import read_wide


def read_measurements(
    paths: str | Path | Sequence[str | Path],
    geometry: HexapodGeometry,
    columns: str | Path | None = None,
    probe: np.ndarray | None = None,
    in_reach: bool = True,
) -> MeasurementSet:
    """Read measured files of any instrument into one set of readings.

    Parameters
    ----------
    paths : path or sequence of paths
        CSV files.
    geometry : HexapodGeometry
        The machine that was measured.
    columns : path, optional
        Columns file that describes the columns of wide CSV files, or the name of a shipped columns file. None: the
        measured files are tidy CSV, with one reading in each row.
    probe : array_like, shape (3,), optional
        The measured point in ``platform``, m; the tool's tip by default.
    in_reach : bool
        Whether to refuse readings whose commanded pose the nominal machine cannot reach.

    Raises
    ------
    InputFileError
        A file cannot be read; the error names the file, the line and the column.
    """
    paths = [paths] if isinstance(paths, str | Path) else paths
    if not paths:
        raise InputFileError("measurements", "", "no file is given")
    files = [input_file(path, "readings") for path in paths]
    columns = None if columns is None else config_file(columns, "columns", beside=True)
    if columns is not None and probe is not None:
        raise InputFileError(files[0], "", "a wide file holds poses of the tool's tip, so leave out --probe-mm (probe)")
    with _garbage_collector_disabled():
        if columns is None:
            read = [read_tidy(path, geometry, probe) for path in files]
        else:
            read = [read_wide(path, columns, geometry) for path in files]
        return assembled(geometry, read, probe, in_reach)


@contextmanager
def _garbage_collector_disabled() -> Iterator[None]:
    """Disable Python's garbage collector, which would take a quarter of the reading time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
