"""One HTML page that shows the workspace study in any browser, without a network: shells to turn and to choose."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import GeometryError, HexapodError
from ..formats.outputs import write_text
from ..formats.pages import render
from ..machine.geometry import HexapodGeometry
from .pictures import VIEW_AZIMUTH, VIEW_ELEVATION, WEDGE, outline
from .shells import ROTATION, TRANSLATION, Shell
from .study import LAYERS, Study, mesh_effects

# Of values, two each, and coordinates, four each; as text a third more: with plotly's 5 MB the page stays below 15
MOST_BYTES = 7_000_000
QUANTITIES = (TRANSLATION, ROTATION)
LEVELS = 65535  # Steps of a stored value between the ends of its colour scale


@dataclass(frozen=True)
class PageData:
    """Content of the page."""

    title: str  # Headline: the machine
    # Each error's type and part, such as ("screw pitch ±20 µm", "strut 1"); errors of a type share a colour scale
    errors: Sequence[tuple[str, str]]
    frames: Sequence[str]  # Orientations, the positions of the slider
    layers: Sequence[str]  # Names of the nested shells, inside to outside
    points: np.ndarray  # (F, S, H, A, 3): their meshes per frame, m in the work frame
    values: np.ndarray  # (F, E, Q, S, H, A): SI

    def __post_init__(self) -> None:
        size = 2 * self.values.size + 4 * self.points.size
        if size > MOST_BYTES:
            raise GeometryError("page", f"may have at most {MOST_BYTES} bytes of data; take a coarser mesh", size)
        for name in ("points", "values"):
            if not np.isfinite(getattr(self, name)).all():
                raise GeometryError(f"page.{name}", "must be finite")


def page_data(study: Study, bodies: tuple[Shell, ...], frames: tuple[str, ...]) -> PageData:
    """Return the content of the interactive page: one frame for each orientation."""
    meshes, errors = [mesh_effects(study, body) for body in bodies], study.errors
    return PageData(
        title=f"{study.geometry.name}: effect of single errors on the tool",
        errors=[(errors.kinds[kind], label) for kind, label in zip(errors.kind, errors.labels, strict=True)],
        frames=frames,
        layers=tuple(f"{100 * fraction:.0f} %" for fraction in LAYERS),
        points=np.stack([points for points, _ in meshes]),
        values=np.stack([values for _, values in meshes]),
    )


def write_page(path: str | Path, geometry: HexapodGeometry, data: PageData) -> None:
    """Write the page, completely or not at all."""
    write_text(path, page_text(geometry, data))


def page_text(geometry: HexapodGeometry, data: PageData) -> str:
    """Return the page; see :func:`write_page`."""
    from markupsafe import Markup

    content = json.dumps(_content(geometry, data), ensure_ascii=False, allow_nan=False)
    return render(
        "shells.html",
        title=data.title,
        data=Markup(content.replace("<", "\\u003c")),  # no text of the data can end the script
        plotly=Markup(_plotly_script()),
    )


def _plotly_script() -> str:
    try:
        from plotly.offline import get_plotlyjs  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError as error:
        raise HexapodError("the interactive page needs plotly: pip install plotly") from error
    return get_plotlyjs().replace("</script", "<\\/script")


def _content(geometry: HexapodGeometry, data: PageData) -> dict[str, object]:
    """Return the data for the page's script."""
    codes, scales = _coded(data)
    return {
        "errors": [list(error) for error in data.errors],
        "quantities": [[quantity.name, quantity.unit] for quantity in QUANTITIES],
        "frames": list(data.frames),
        "layers": list(data.layers),
        "mesh": list(data.points.shape[2:4]),
        "points": _base64((data.points * 1e3).astype("<f4")),
        "codes": _base64(codes),
        "scales": scales.tolist(),
        "outline": [(line * 1e3).round(4).T.tolist() for line in outline(geometry)],
        "view": [VIEW_AZIMUTH, VIEW_ELEVATION],
        "wedge": WEDGE,
    }


def _coded(data: PageData) -> tuple[np.ndarray, np.ndarray]:
    """Return the values as 16-bit integers, and the least value and step of each scale, (E, Q, 2), in shown units."""
    factors = np.array([quantity.factor for quantity in QUANTITIES])
    low = data.values.min(axis=(0, 3, 4, 5)) * factors
    high = data.values.max(axis=(0, 3, 4, 5)) * factors
    types = np.array([kind for kind, _ in data.errors])
    for kind in set(types):
        same = types == kind
        low[same], high[same] = low[same].min(axis=0), high[same].max(axis=0)
    width = np.where(high > low, high - low, 1.0)

    def spread(array: np.ndarray) -> np.ndarray:
        return array[None, :, :, None, None, None]

    shown = data.values * factors[None, None, :, None, None, None]
    codes = np.rint((shown - spread(low)) / spread(width) * LEVELS).astype("<u2")
    return codes, np.stack([low, low + width], axis=-1)


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
