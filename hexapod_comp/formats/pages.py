"""HTML pages without references to other files, so that they open offline in any browser.

:func:`render` puts every value of a page on one line, cut at `LONGEST_TEXT` characters and escaped, unless the value is
:class:`markupsafe.Markup`.
"""

from __future__ import annotations

import base64
import io
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import printable

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup
    from matplotlib.figure import Figure

TEMPLATES = Path(__file__).resolve().parents[1] / "templates"

RESOLUTION = 110  # resolution of embedded pictures, dots per inch
LONGEST_CELL, LONGEST_TEXT = 300, 2000  # longest text in a table's cell, and longest other text, characters


def render(template: str | Path, **values: Any) -> str:
    """Return the HTML of a template with `values`; `template` is a Path, or a file's name in hexapod_comp/templates."""
    environment = _environment()
    if isinstance(template, Path):
        return environment.from_string(template.read_text(encoding="utf-8")).render(values)
    return environment.get_template(template).render(values)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def one_line(value: Any) -> Any:
        return value if isinstance(value, Markup | int) or value is None else printable(str(value), LONGEST_TEXT)

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, finalize=one_line, undefined=StrictUndefined
    )
    environment.filters["cell"] = lambda value: printable(str(value), LONGEST_CELL)
    environment.filters["lines"] = lambda text: Markup("\n").join(printable(x, LONGEST_TEXT) for x in text.splitlines())
    environment.filters["as_png"] = png
    environment.globals |= {"style": "", "body": ""}
    return environment


def png(figure: Figure) -> Markup:
    """Return a figure as a data URL, so that the page itself contains the picture."""
    from markupsafe import Markup

    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=RESOLUTION, metadata={"Software": None})
    return Markup(f"data:image/png;base64,{base64.b64encode(stream.getvalue()).decode('ascii')}")
