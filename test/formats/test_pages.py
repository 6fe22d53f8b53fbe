"""Pages that everybody can read: what a table says on a narrow screen, and what a picture of six screws shows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure
from strategies import paper_geometry

from hexapod_comp.calibration.pictures import _strut_panel
from hexapod_comp.formats.pages import _environment, render
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.machine.model_file import load_model


def test_cells_of_a_wide_table_carry_their_columns_names():
    """The style sheet puts them in front of the cells where the screen is narrow and the head is not shown."""
    table = _environment().get_template("parts.html").module.table
    text = table(("run", "readings", "RMS <σ>", "largest"), [("x1", 3, 0.5, 1.2)])
    assert '<table class="rows">' in text
    for cell in ('data-label="readings">3<', 'data-label="RMS &lt;σ&gt;">0.5<', 'data-label="largest">1.2<'):
        assert cell in text
    assert "attr(data-label)" in render("page.html", title="")
    assert "class" not in table(("", "name"), [("a", "b")]).partition("<table")[2].partition(">")[0]


def test_six_screw_waves_are_numbers_not_six_curves_on_top_of_each_other():
    """Truth: the shipped model's own pitch and wave, drawn over strokes that both have."""
    geometry = paper_geometry()
    model = load_model("paper_machine", geometry)
    commands = np.linspace(0.45, 0.6, 50)[:, None] + np.zeros(6)
    stations = SimpleNamespace(commands=commands)
    fit = SimpleNamespace(model=model, measurements=SimpleNamespace(geometry=geometry, stations=stations))
    axes = Figure().subplots()
    _strut_panel(axes, cast(Any, fit))
    struts = model.struts
    for strut, line in enumerate(axes.lines):
        at, errors = np.asarray(line.get_xdata()) * 1e-3, np.asarray(line.get_ydata()) * 1e-6
        right = struts.pitch[strut] * (at - struts.reference_length[strut])
        np.testing.assert_allclose(errors, right, rtol=0, atol=1e-9)
        amplitude = np.hypot(struts.cosine[strut], struts.sine[strut]).max() * 1e6
        assert amplitude > 1.0
        assert line.get_label() == f"{STRUT_NAMES[strut]}, wave ±{amplitude:.1f} µm"
