"""One HTML page that shows the workspace study in any browser, without a network: shells to turn and to choose.

Everything is in the file: plotly's script, the meshes, and every value, as two bytes each. The page's own
security policy forbids it to load anything.
"""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import GeometryError, HexapodError
from ..formats.outputs import write_text
from ..machine.geometry import HexapodGeometry
from .pictures import VIEW_AZIMUTH, VIEW_ELEVATION, WEDGE, outline
from .shells import ROTATION, TRANSLATION, Quantity, Shell
from .study import LAYERS, Study, mesh_effects

MOST_BYTES = 7_000_000
"""Of values, two each, and coordinates, four each; as text a third more: with plotly's 5 MB the page stays below 15."""

LEVELS = 65535
"""Steps of a stored value between the ends of its colour scale."""


@dataclass(frozen=True)
class PageData:
    """What the page shows."""

    title: str  # Headline: the machine
    note: str  # What is seen and how the numbers came about; one paragraph
    # Each error's type and part, such as ("screw pitch ±20 µm", "strut 1"); errors of a type share a colour scale
    errors: Sequence[tuple[str, str]]
    quantities: Sequence[Quantity]  # Such as translation and rotation
    frame_title: str  # What the slider changes, such as "tilt about x"
    frames: Sequence[str]  # Its positions
    layers: Sequence[str]  # Names of the nested shells, inside to outside
    points: np.ndarray  # (F, S, H, A, 3): their meshes per frame, m in the work frame
    values: np.ndarray  # (F, E, Q, S, H, A): SI

    def __post_init__(self) -> None:
        counts = tuple(len(part) for part in (self.frames, self.errors, self.quantities, self.layers))
        wanted = (*counts, *self.points.shape[2:4])
        if 0 in counts or self.points.shape != (counts[0], counts[3], *wanted[4:], 3) or self.values.shape != wanted:
            shapes = f"points {self.points.shape}, values {self.values.shape}"
            problem = f"has {counts} frames, errors, quantities and layers, which does not fit"
            raise GeometryError("page", problem, shapes)
        size = 2 * self.values.size + 4 * self.points.size
        if size > MOST_BYTES:
            raise GeometryError("page", f"may have at most {MOST_BYTES} bytes of data; take a coarser mesh", size)
        for name in ("points", "values"):
            if not np.isfinite(getattr(self, name)).all():
                raise GeometryError(f"page.{name}", "must be finite")


def page_data(study: Study, bodies: tuple[Shell, ...], frames: tuple[str, ...], frame_title: str) -> PageData:
    """Return what the interactive page shows: one frame for each orientation."""
    meshes, errors = [mesh_effects(study, body) for body in bodies], study.errors
    return PageData(
        title=f"{study.geometry.name}: effect of single errors on the tool",
        note=(
            "Each shell is the boundary of the workspace at one orientation of the tool, or a smaller one inside it, "
            "coloured by how far one error alone moves or turns the tool there (exact, not to first order)."
        ),
        errors=[(errors.kinds[kind], label) for kind, label in zip(errors.kind, errors.labels, strict=True)],
        quantities=(TRANSLATION, ROTATION),
        frame_title=frame_title,
        frames=frames,
        layers=tuple(f"{100 * fraction:.0f} %" for fraction in LAYERS),
        points=np.stack([points for points, _ in meshes]),
        values=np.stack([values for _, values in meshes]),
    )


def write_page(path: str | Path, geometry: HexapodGeometry, data: PageData) -> None:
    """Write the page, all or nothing."""
    write_text(path, page_text(geometry, data))


def page_text(geometry: HexapodGeometry, data: PageData) -> str:
    """Return the page; see :func:`write_page`."""
    content = json.dumps(_content(geometry, data), ensure_ascii=False, allow_nan=False)
    parts = {
        "TITLE": html.escape(data.title),
        "NOTE": html.escape(data.note),
        "FRAME_TITLE": html.escape(data.frame_title),
        "DATA": content.replace("<", "\\u003c"),  # no text of the data can end the script
        "PLOTLY": _plotly_script(),
    }
    # In one pass, so that nothing is replaced within what is put in.
    return re.sub(f"@({'|'.join(parts)})@", lambda mark: parts[mark[1]], PAGE)


def _plotly_script() -> str:
    try:
        from plotly.offline import get_plotlyjs  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError as error:
        raise HexapodError("the interactive page needs plotly: pip install plotly") from error
    return get_plotlyjs().replace("</script", "<\\/script")


def _content(geometry: HexapodGeometry, data: PageData) -> dict[str, object]:
    """Return what the page's script reads."""
    codes, scales = _coded(data)
    return {
        "errors": [list(error) for error in data.errors],
        "quantities": [[quantity.name, quantity.unit] for quantity in data.quantities],
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
    """Return the values as steps of their scales, uint16, and the scales, (E, Q, 2) in shown units.

    The errors of one type have one scale for all frames, so that colours can be compared.
    """
    factors = np.array([quantity.factor for quantity in data.quantities])
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


PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline';
 style-src 'unsafe-inline'; img-src data: blob:">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>@TITLE@</title>
<style>
 body { font: 15px/1.4 sans-serif; margin: 0; display: flex; flex-direction: column; height: 100vh; color: #222 }
 header { padding: 10px 16px 0 } h1 { font-size: 19px; margin: 0 0 2px } p { margin: 0 0 8px; max-width: 110ch }
 #controls { padding: 0 16px 6px; display: flex; flex-wrap: wrap; gap: 6px 18px; align-items: center }
 #controls label { white-space: nowrap } #found { padding: 0 16px 6px; font-weight: bold }
 #frame { vertical-align: middle; width: 180px } #plot { flex: 1; min-height: 360px }
</style>
</head>
<body>
<header><h1>@TITLE@</h1><p>@NOTE@</p></header>
<div id="controls">
 <label>error type <select id="type"></select></label>
 <label>part <select id="part"></select></label>
 <label>quantity <select id="quantity"></select></label>
 <label>@FRAME_TITLE@ <input id="frame" type="range" min="0" step="1" value="0"> <span id="frame_name"></span></label>
 <button id="play" type="button">play</button>
 <label><input id="cut" type="checkbox" checked> cut open</label>
 <label><input id="machine" type="checkbox" checked> machine</label>
 <span id="shown">shells: </span>
</div>
<div id="found"></div>
<div id="plot"></div>
<script>@PLOTLY@</script>
<script id="data" type="application/json">@DATA@</script>
<script>
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const [H, A] = data.mesh, S = data.layers.length, E = data.errors.length, Q = data.quantities.length;
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
const points = new Float32Array(bytes(data.points)), codes = new Uint16Array(bytes(data.codes));
const get = id => document.getElementById(id);
const option = (list, value, text) => list.add(new Option(text, value));

[...new Set(data.errors.map(e => e[0]))].forEach(type => option(get("type"), type, type));
data.quantities.forEach((q, i) => option(get("quantity"), i, q[0]));
get("frame").max = data.frames.length - 1;
get("frame").value = Math.floor((data.frames.length - 1) / 2);
if (data.frames.length < 2) { get("frame").disabled = get("play").disabled = true; }
const boxes = data.layers.map(name => {
  const label = document.createElement("label"), box = document.createElement("input");
  box.type = "checkbox"; box.checked = true; box.onchange = draw;
  label.append(box, " " + name + " "); get("shown").append(label);
  return box;
});

function fillParts() {
  const part = get("part"), before = part.selectedIndex;
  part.length = 0;
  data.errors.forEach((e, i) => { if (e[0] === get("type").value) option(part, i, e[1]); });
  part.selectedIndex = Math.min(Math.max(before, 0), part.length - 1);
}

// One nested shell: coordinates (mm) and values in shown units, as rows of the mesh.
function layer(frame, error, quantity, s) {
  const [low, high] = data.scales[error][quantity], size = H * A;
  const p = 3 * (frame * S + s) * size, v = (((frame * E + error) * Q + quantity) * S + s) * size;
  const rows = { x: [], y: [], z: [], value: [] };
  for (let i = 0; i < H; i++) {
    for (const name in rows) rows[name].push(new Array(A));
    for (let j = 0; j < A; j++) {
      const k = i * A + j;
      rows.x[i][j] = points[p + 3 * k]; rows.y[i][j] = points[p + 3 * k + 1]; rows.z[i][j] = points[p + 3 * k + 2];
      rows.value[i][j] = low + codes[v + k] / 65535 * (high - low);
    }
  }
  return rows;
}

// All but the innermost shell have a wedge left out on the side where the eye stands at first.
function opened(rows, wedge) {
  let cx = 0, cy = 0;
  rows.x.forEach((row, i) => row.forEach((x, j) => { cx += x / (H * A); cy += rows.y[i][j] / (H * A); }));
  return rows.z.map((row, i) => row.map((z, j) => {
    const dx = rows.x[i][j] - cx, dy = rows.y[i][j] - cy;
    const turn = Math.atan2(dy, dx) * 180 / Math.PI - data.view[0];
    const off = Math.abs(((turn + 180) % 360 + 360) % 360 - 180);
    return Math.hypot(dx, dy) > 1e-6 && off < wedge / 2 ? null : z;
  }));
}

function traces() {
  const frame = +get("frame").value, error = +get("part").value, quantity = +get("quantity").value;
  const [name, unit] = data.quantities[quantity], [low, high] = data.scales[error][quantity];
  let least = null, most = null;
  const found = boxes.map((box, s) => {
    const rows = layer(frame, error, quantity, s);
    rows.value.forEach((row, i) => row.forEach((value, j) => {
      const at = { value, x: rows.x[i][j], y: rows.y[i][j], z: rows.z[i][j] };
      if (!least || value < least.value) least = at;
      if (!most || value > most.value) most = at;
    }));
    const wedge = get("cut").checked ? data.wedge * s / Math.max(1, S - 1) : 0;
    return { type: "surface", x: rows.x, y: rows.y, z: wedge ? opened(rows, wedge) : rows.z,
      surfacecolor: rows.value, cmin: low, cmax: high, colorscale: "Viridis", visible: box.checked,
      showscale: s === S - 1, colorbar: { title: { text: name + ", " + unit, side: "right" }, len: 0.85 },
      lighting: { ambient: 0.85, diffuse: 0.25, specular: 0.0 }, name: data.layers[s],
      contours: { x: { highlight: false }, y: { highlight: false }, z: { highlight: false } },
      hovertemplate: "x %{x:.1f}, y %{y:.1f}, z %{z:.1f} mm in work<br>%{surfacecolor:.4g} " + unit };
  });
  const mm = value => String(Math.round(10 * value) / 10 + 0);
  const say = e => `${e.value.toPrecision(4)} ${unit} at x ${mm(e.x)}, y ${mm(e.y)}, z ${mm(e.z)} mm in work`;
  get("found").textContent = `${name}: largest ${say(most)}; smallest ${say(least)}`;
  found.forEach((t, s) => { t.showscale = boxes[s].checked && !boxes.slice(s + 1).some(b => b.checked); });
  const lines = get("machine").checked ? data.outline : data.outline.slice(1, 2);  // of it only the platform
  return found.concat(lines.map(line => ({ type: "scatter3d", mode: "lines", x: line[0], y: line[1],
    z: line[2], line: { width: line[0].length > 2 ? 5 : 3, color: line[0].length > 2 ? "#222" : "#888" },
    hoverinfo: "skip", showlegend: false })));
}

const around = data.view[0] * Math.PI / 180, up = data.view[1] * Math.PI / 180;
const layout = { margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: "kept", showlegend: false,
  scene: { aspectmode: "data", xaxis: { title: { text: "x in work, mm" } },
    yaxis: { title: { text: "y in work, mm" } }, zaxis: { title: { text: "z in work, mm" } }, uirevision: "kept",
    camera: { eye: { x: 1.6 * Math.cos(up) * Math.cos(around), y: 1.6 * Math.cos(up) * Math.sin(around),
      z: 1.6 * Math.sin(up) }, center: { x: 0, y: 0, z: -0.05 } } } };

// The same room for every frame, or it would jump: x, y, z of all meshes and of the lines that are drawn.
function room() {
  const lines = get("machine").checked ? data.outline : data.outline.slice(1, 2);
  return [0, 1, 2].map(axis => {
    let low = Infinity, high = -Infinity;
    const take = value => { low = Math.min(low, value); high = Math.max(high, value); };
    for (let k = axis; k < points.length; k += 3) take(points[k]);
    lines.forEach(line => line[axis].forEach(take));
    const margin = 0.03 * (high - low);
    return [low - margin, high + margin];
  });
}

function draw() {
  room().forEach((range, axis) => { layout.scene["xyz"[axis] + "axis"].range = range; });
  get("frame_name").textContent = data.frames[+get("frame").value];
  return Plotly.react("plot", traces(), layout, { responsive: true, displaylogo: false });
}

let timer = null, way = 1;
function step() {
  const last = data.frames.length - 1, next = +get("frame").value + way;
  if (next < 0 || next > last) way = -way;
  get("frame").value = +get("frame").value + way;
  draw();
}
get("play").onclick = () => {
  if (timer) clearInterval(timer);
  timer = timer ? null : setInterval(step, 700);
  get("play").textContent = timer ? "pause" : "play";
};
get("type").onchange = () => { fillParts(); draw(); };
["part", "quantity", "cut", "machine"].forEach(id => { get(id).onchange = draw; });
get("frame").oninput = draw;
fillParts();
draw().then(() => { document.body.dataset.ready = "yes"; });
</script>
</body>
</html>
"""
