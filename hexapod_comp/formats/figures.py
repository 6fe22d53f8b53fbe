"""The colours of all pictures, texts in pictures, and writing of PNG files."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from ..errors import printable
from .outputs import make_folder, new_file

# Colours of errors without compensation and with compensation in every picture
WITHOUT, WITH = "#c1432e", "#20639b"

# Colours of the six struts, from the palette of Okabe and Ito, which colour-blind people can distinguish
SIX_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#000000")

LEAST_SHOWN = 1e-3  # lowest error, µm, that a picture with a logarithmic error axis shows


def picture_text(text: str, limit: int = 200) -> str:
    """Prepare a text, such as a machine's name, for a picture: put the text on one line and escape $."""
    return printable(text, limit).replace("$", r"\$")


def save(figure: Figure, path: str | Path) -> None:
    make_folder(Path(path).parent)
    with new_file(path, "wb") as stream:
        figure.savefig(stream, dpi=140, format="png")
