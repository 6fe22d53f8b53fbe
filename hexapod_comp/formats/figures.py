"""Shared by all pictures: colours, and saving."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from ..errors import printable
from .outputs import make_folder, new_file

# Colours of the machine without and with compensation, the same in every picture
WITHOUT, WITH = "#c1432e", "#20639b"

# Of the six struts: Okabe and Ito's, which the colour-blind can tell apart too
SIX_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#000000")

NOTHING = 1e-3  # lower end of logarithmic error axes, µm: errors below a nanometre are not claimed


def picture_text(text: str, limit: int = 200) -> str:
    """Return a foreign text, such as a machine's name, for a picture: on one line, and with $ not read as a formula."""
    return printable(text, limit).replace("$", r"\$")


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, making the folder when it is missing."""
    make_folder(Path(path).parent)
    with new_file(path, "wb") as stream:
        figure.savefig(stream, dpi=140, format="png")
