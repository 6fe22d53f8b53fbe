"""What every picture shares: colours, and how it is saved."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from ..errors import InputFileError
from .outputs import refuse_replacing_input

WITHOUT, WITH = "#c1432e", "#20639b"
"""Colours of the machine without and with compensation, the same in every picture."""


NOTHING = 1e-3
"""Lower end of logarithmic error axes, µm: below a nanometre nothing is claimed."""


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, making the folder when it is missing.

    Raises
    ------
    InputFileError
        It cannot be written.
    """
    refuse_replacing_input(path)
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(target, dpi=140)
    except OSError as error:
        raise InputFileError(path, "", f"cannot be written: {error.strerror}") from error
