"""The interactive HTML page of the workspace study: 3-D shells, which the reader turns and selects offline."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import GeometryError, HexapodError
from ..formats.pages import render
from ..machine.geometry import HexapodGeometry
from .pictures import VIEW_AZIMUTH, VIEW_ELEVATION, WEDGE, outline
from .shells import ROTATION, TRANSLATION, Shell
from .study import LAYERS, Study, mesh_effects

# Bytes of the data (2 a value, 4 a coordinate), so that the page with plotly is below 15 MB
MOST_BYTES = 7_000_000
QUANTITIES = (TRANSLATION, ROTATION)
LEVELS = 65535  # steps of a colour scale; each value is stored as an integer from 0 to LEVELS


@dataclass(frozen=True)
class PageData:
    """Content of the page: effects of E single errors at the points of S nested shells, for F tool orientations."""

    title: str
    errors: Sequence[tuple[str, str]]  # E: type and part, such as ("screw pitch", "strut_1")
    frames: Sequence[str]  # F: names of the tool's orientations, which the slider selects
    layers: Sequence[str]  # S: names of the nested shells, from the inside out
    points: np.ndarray  # (F, S, H, A, 3): m in the work frame
    values: np.ndarray  # (F, E, Q, S, H, A): effect of each error on each of Q quantities, m and rad

    def __post_init__(self) -> None:
        size = 2 * self.values.size + 4 * self.points.size
        if size > MOST_BYTES:
            raise GeometryError("page", f"must have at most {MOST_BYTES} bytes of data: take fewer orientations", size)
        for name in ("points", "values"):
            if not np.isfinite(getattr(self, name)).all():
                raise GeometryError(f"page.{name}", "must be finite")


def page_data(study: Study, bodies: tuple[Shell, ...], frames: tuple[str, ...]) -> PageData:
    """Return the content of the page; each orientation of the tool has a shell in `bodies` and a name in `frames`."""
    meshes, errors = [mesh_effects(study, body) for body in bodies], study.errors
    return PageData(
        title=f"{study.geometry.name}: effect of single errors on the tool",
        errors=[(errors.kinds[kind], label) for kind, label in zip(errors.kind, errors.labels, strict=True)],
        frames=frames,
        layers=tuple(f"{100 * fraction:.0f} %" for fraction in LAYERS),
        points=np.stack([points for points, _ in meshes]),
        values=np.stack([values for _, values in meshes]),
    )


def page_text(geometry: HexapodGeometry, data: PageData) -> str:
    from markupsafe import Markup

    content = json.dumps(_content(geometry, data), ensure_ascii=False, allow_nan=False)
    return render(
        "shells.html",
        title=data.title,
        data=Markup(content.replace("<", "\\u003c")),  # text in the data cannot end the script
        plotly=Markup(_plotly_script()),
    )


def _plotly_script() -> str:
    try:
        from plotly.offline import get_plotlyjs  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError as error:
        raise HexapodError("the interactive page needs plotly: pip install plotly") from error
    return get_plotlyjs().replace("</script", "<\\/script")


def _content(geometry: HexapodGeometry, data: PageData) -> dict[str, object]:
    """Return the data for the page's script; lengths are in mm."""
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
    """Return the effects as integers 0…LEVELS, and the two ends of the colour scale of each error and quantity."""
    factors = np.array([quantity.factor for quantity in QUANTITIES])
    low = data.values.min(axis=(0, 3, 4, 5)) * factors
    high = data.values.max(axis=(0, 3, 4, 5)) * factors
    types = np.array([kind for kind, _ in data.errors])
    for kind in set(types):  # all errors of one type have the same colour scale
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
