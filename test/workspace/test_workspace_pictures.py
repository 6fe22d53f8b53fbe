"""Pictures and page of the workspace study: their contents, and that the page works without a network."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_reach import unit

from hexapod_comp.errors import GeometryError
from hexapod_comp.formats.figures import save
from hexapod_comp.workspace.page import MOST_BYTES, PageData, page_text
from hexapod_comp.workspace.pictures import TRANSLATION, Layer, shells_figure

RINGS, SECTORS = 9, 16
PAGE_LIMIT = 15e6


def mesh(radius: float = 0.05) -> np.ndarray:
    """Return a ball above the unit's platform as a mesh."""
    up, around = np.linspace(-np.pi / 2, np.pi / 2, RINGS)[:, None], np.linspace(0, 2 * np.pi, SECTORS + 1)
    unit_ball = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up) + 0 * around], axis=-1)
    unit_ball[[0, -1], :, :2] = 0.0  # poles are points, as in shells
    return radius * unit_ball + [0.0, 0.0, 0.25]


def test_shells_say_what_they_show(tmp_path):
    """The values are 1 µm to 1 µm + 10⁻³·0.05² m = 3.5 µm; six struts, base, platform and tool are drawn as well."""
    layers = [Layer(mesh(radius), 1e-6 + 1e-3 * mesh(radius)[..., 0] ** 2) for radius in (0.02, 0.035, 0.05)]
    figure = shells_figure(unit(), layers, TRANSLATION, "unit: screw pitch on strut 1")
    written = "\n".join(text.get_text() for text in figure.findobj(lambda part: hasattr(part, "get_text")))
    for part in ("unit: screw pitch on strut 1", "translation of the tool, µm", "x in work, mm", "3.5", "1", "at home"):
        assert part in written
    context, near, bar = figure.axes
    assert len(context.lines) == 9
    assert bar.get_ylim() == pytest.approx((1.0, 3.5))
    assert [len(axes.collections) for axes in (context, near)] == [1, 1]
    save(figure, tmp_path / "shells.png")
    assert (tmp_path / "shells.png").stat().st_size > 20_000


TYPES = [("pitch <±20 µm>", "strut 1"), ("pitch <±20 µm>", "strut 2"), ("joint", "base 1 x")]


def page_data(title: str = "unit & errors @NOTE@", **other: object) -> PageData:
    """Return two frames, three errors, two quantities, two shells; each value encodes its place."""
    points = np.array([[mesh(0.03), mesh(0.05)], [mesh(0.02), mesh(0.04)]])
    values = np.linspace(1e-6, 9e-6, 2 * 3 * 2 * 2 * RINGS * (SECTORS + 1)).reshape(2, 3, 2, 2, RINGS, SECTORS + 1)
    given = {"title": title, "errors": TYPES, "frames": ("−5°", "</script>5°"), "layers": ("60 %", "100 %")}
    return PageData(**{**given, "points": points, "values": values, **other})


def test_the_page_loads_nothing():
    """By HTML only src, href and the like load anything, and the policy default-src 'none' forbids everything else."""
    pytest.importorskip("plotly", reason="the page needs plotly")
    text = page_text(unit(), page_data())
    markup = re.sub(r"(<script.*?>).*?</script>", r"\1", text, flags=re.DOTALL)
    assert markup.count("<script") == 3
    assert not re.search(r"<(?:link|iframe|img|object|embed|base)\b|\s(?:src|href|srcset|data)=", markup)
    assert "@import" not in text[: text.index("<script>")]
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)[1]
    assert "default-src 'none'" in policy
    assert "http" not in policy
    assert "unit &amp; errors @NOTE@</h1>" in text
    assert len(text.encode()) < PAGE_LIMIT


def test_the_largest_page_that_is_allowed_is_below_its_limit():
    """The size is that of a page with the largest number of frames: two bytes per value, four per coordinate."""
    pytest.importorskip("plotly", reason="the page needs plotly")
    count = MOST_BYTES // (2 * RINGS * (SECTORS + 1) * (2 * 3 * 2 + 4 * 3))
    points = np.broadcast_to(page_data().points[:1], (count, 2, RINGS, SECTORS + 1, 3))
    values = np.ones((count, 3, 2, 2, RINGS, SECTORS + 1))
    page = page_text(unit(), page_data(frames=["level"] * count, points=points, values=values))
    assert len(page.encode()) < PAGE_LIMIT
    with pytest.raises(GeometryError, match="at most 7000000 bytes"):
        page_data(frames=["level"] * (2 * count), points=np.tile(points, (2, 1, 1, 1, 1)),
                  values=np.tile(values, (2, 1, 1, 1, 1, 1)))  # fmt: skip


def test_no_picture_or_page_of_effects_that_are_not_known():
    with pytest.raises(GeometryError, match=r"values: .*finite"):
        shells_figure(unit(), [Layer(mesh(), np.full((9, 17), np.nan))], TRANSLATION, "")
    with pytest.raises(GeometryError, match=r"page.points: .*finite"):
        page_data(points=np.full((2, 2, RINGS, SECTORS + 1, 3), np.nan))


def chromium() -> str:
    found = filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome")))
    return next(found, "") or pytest.skip("no Chromium here; Debian: apt install chromium")


def rendered(page: Path, profile: Path) -> tuple[str, str]:
    """Open a page in headless Chromium without a network; return the final document without scripts, and the log."""
    options = "--headless --no-sandbox --disable-dev-shm-usage --use-angle=swiftshader --enable-unsafe-swiftshader"
    command = [chromium(), *options.split(), "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={profile}"]
    command += ["--virtual-time-budget=5000", "--enable-logging=stderr", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    document = re.sub(r"<script.*?</script>", "", done.stdout, flags=re.DOTALL)
    return document, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


@pytest.mark.skipif(not os.environ.get("LONG_TESTS"), reason="make test-docs runs it (LONG_TESTS=1)")
def test_the_page_runs_in_a_browser_and_its_selectors_choose(tmp_path):
    """The page shows the smallest and largest of the given values for the chosen frame, error and quantity."""
    pytest.importorskip("plotly", reason="the page needs plotly")
    data, page = page_data(), tmp_path / "page.html"
    act = """<pre id="at_first"></pre><script>get("at_first").textContent = get("found").textContent;
      get("type").value = "joint"; get("type").onchange(); get("quantity").value = 1;
      get("quantity").onchange(); get("frame").value = 1; get("frame").oninput(); get("play").onclick();</script>"""
    page.write_text(page_text(unit(), data).replace("</body>", act + "</body>"), encoding="utf-8")
    found, log = rendered(page, tmp_path / "profile")
    assert 'data-ready="yes"' in found, log
    assert not re.search("Refused|Uncaught", log)
    assert "WebGL is not supported" not in found
    assert "gl-container" in found
    assert ">pause<" in found
    assert says(found, "at_first") == shown(data.values[0, 0, 0] * 1e6, "µm")
    played = [shown(data.values[frame, 2, 1] * 1e3 * 180 / np.pi, "m°") for frame in (0, 1)]
    assert says(found, "found") in played


def says(document: str, where: str) -> tuple[str, str]:
    """Return largest and smallest value with unit, as the page shows them."""
    line = re.search(rf' id="{where}">([^<]*)</', document)[1]
    return re.search(r"largest (\S+ \S+) at", line)[1], re.search(r"smallest (\S+ \S+) at", line)[1]


def shown(values: np.ndarray, unit_name: str) -> tuple[str, str]:
    """Return the same from the given values, with four digits like JavaScript's toPrecision."""
    return f"{values.max():#.4g} {unit_name}", f"{values.min():#.4g} {unit_name}"
