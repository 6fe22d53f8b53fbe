"""Comparison with v. Daake, Vetter, Böhm & Zirn: the ranked Table 1, Figure 2 and the iteration of chapter 1."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.workspace.budget import load_budget
from hexapod_comp.workspace.effects import effects
from hexapod_comp.workspace.pictures import shells_figure
from hexapod_comp.workspace.ranking import FACTORS, FIGURES, RankingRow
from hexapod_comp.workspace.reach import orientations, reach, reaches
from hexapod_comp.workspace.shells import TRANSLATION, Layer, shell
from hexapod_comp.workspace.study import LAYERS, RINGS, SECTORS, Study, classify

from .comparing import MET, MISSED, OPEN, SHOWN, Column, Exhibit, NumberTable, Paper, Statement, judged, within
from .iteration import compared

MACHINE, BUDGET = "positioning_unit", "error_budget"
"""Shipped files: a positioning unit of the paper's kind, and the sizes of its errors that the paper states."""

TILTS = tuple(np.radians([-4.0, 0.0, 4.0]).tolist())
"""Tilts about x and about y, rad, for which the machine's workspace is classified."""

COMPARED = 20  # Number of random poses at which the iteration is compared with the exact solution
PASSIVE = 1e-3  # The paper's bound for the movement of the passive legs divided by the travel of the active leg

OVER_WHAT = "the paper does not print the poses and struts over which each row was computed."

COLUMNS = (
    Column("transl. max", "µm", "µm", 1.0, 2),
    Column("transl. min", "µm", "µm", 1.0, 2),
    Column("rot. max", "m°", "m°", 1.0, 2),
    Column("rot. min", "m°", "m°", 1.0, 2),
)


class PaperRow(NamedTuple):
    """A row of Table 1 as printed; "≈ 0" is written as 0."""

    title: str  # this package's name of the error type; the paper prints "quantization"
    size: float  # size of the error in the paper's text, µm
    figures: tuple[float, ...]  # largest and smallest translation, µm; largest and smallest rotation, m°


TABLE_1 = (
    PaperRow("screw pitch", 20.0, (34.4, 22.4, 15.41, 10.71)),
    PaperRow("base-/platform joint (x/y)", 10.0, (13.68, 0.0, 6.16, 0.0)),
    PaperRow("base-/platform joint (z)", 10.0, (11.2, 11.18, 5.36, 3.84)),
    PaperRow("quantisation", 7.0, (10.85, 7.84, 4.39, 3.81)),
)


def study(cells: int = 30, progress: Callable[[int], object] = lambda poses: None) -> Study:
    """Classify the errors of the shipped positioning unit, as ``hexapod_comp classify`` does."""
    geometry = load_geometry(MACHINE)
    reached = reaches(geometry, orientations(geometry, (TILTS, TILTS, (0.0,))), cells)
    return classify(geometry, load_budget(BUDGET), reached, progress=progress)


def paper(cells: int = 30) -> Paper:
    """Return the comparison of the whole paper, computed for the shipped positioning unit."""
    case = study(cells)
    exhibits = (ranking(case), shells(case.geometry), iteration(case))
    return Paper(
        "v. Daake, Vetter, Böhm & Zirn",
        "Error Classification and Visualisation for Hexapod Positioning Units",
        exhibits,
    )


def ranking(case: Study) -> Exhibit:
    """Return Table 1 with the unit's ranking, and statements that hold for any machine."""
    computed = {row.title: row for row in case.rows}
    names = tuple(row.title for row in TABLE_1)
    digits = np.array([row.figures for row in TABLE_1])
    cells = tuple(tuple(f"{value:.2f}" if value else "≈ 0" for value in row) for row in digits)
    figures = np.array([computed[name].figures() * FACTORS for name in names])
    zero = digits == 0.0
    table = NumberTable(
        "Table 1: effects of error types on the tool",
        "Computed: the shipped unit of this kind, with the errors that the paper states. The paper does not print the "
        "geometry of its machine, and sixteen numbers do not determine it: only ≈ 0 can be met.",
        *(COLUMNS, names, cells, figures, judged(zero & (figures < 0.005), OPEN)),
    )
    statements = (_order({name: computed[name] for name in names}), *_scaling(computed))
    return Exhibit("Table 1: the ranking", f"{case.extremes.poses} poses.", (table,), statements)


def _order(rows: dict[str, RankingRow]) -> Statement:
    """Compare the printed order of the rows with the computed order."""
    here = sorted(rows, key=lambda name: -rows[name].extremes[0].value)
    first = here[0] == next(iter(rows))
    return Statement(
        "order by largest translation",
        " > ".join(rows),
        " > ".join(here),
        MET if first and here == list(rows) else OPEN if first else MISSED,
        "Screw pitch is first in both orders. The two rows of joints and the row of quantisation differ little; their "
        "order depends on the geometry.",
    )


def _scaling(computed: dict[str, RankingRow]) -> tuple[Statement, ...]:
    """Compare the effects of two errors that lengthen a strut: screw pitch of 20 µm and quantisation of 7 µm."""
    pitch, step = TABLE_1[0], TABLE_1[-1]
    statements = []
    for n, name in enumerate(FIGURES):
        printed = pitch.figures[n] / step.figures[n]
        here = computed[pitch.title].figures()[n] / computed[step.title].figures()[n]
        wanted = pitch.size / step.size
        good = abs(here / wanted - 1.0) < 1e-3
        same = abs(printed / wanted - 1.0) < 2e-3
        statements.append(
            Statement(
                f"{name.replace('_', ' ')}: screw pitch over quantisation",
                f"{printed:.3f}",
                f"{here:.3f}",
                MET if good and same else OPEN if good else MISSED,
                f"Both lengthen a strut, by 20 and 7 µm: the effects' ratio is {wanted:.3f} at each pose (first order)."
                + ("" if same else f" The printed ratio differs by {100 * (printed / wanted - 1):+.0f} %; {OVER_WHAT}"),
            )
        )
    return tuple(statements)


def shells(geometry: HexapodGeometry) -> Exhibit:
    """Return Figure 2: shells of the workspace, coloured by the tool's translation due to one screw's pitch error."""
    errors = load_budget(BUDGET).single_errors(geometry)
    first = errors.select((errors.kind == errors.kinds.index("screw pitch")) & errors.struts[:, 0])
    body = shell(reach(geometry), RINGS, SECTORS)
    layers = []
    for share in LAYERS:
        moved = effects(geometry, first, *body.platform_poses(share))[:, 0, 0]
        layers.append(Layer(body.scaled(share), moved.reshape(body.points.shape[:2])))
    title = "positioning unit, screw pitch of strut 1 off by 20 µm, tool level"
    values = np.concatenate([layer.values.ravel() for layer in layers]) * 1e6
    statement = Statement(
        "translation of the tool on the shells",
        "a coloured picture",
        f"{values.min():.2f} … {values.max():.2f} µm",
        SHOWN,
        "The machine's geometry is not printed.",
    )
    figures = {"Figure 2: shells of the workspace": shells_figure(geometry, layers, TRANSLATION, title)}
    text = "The tool is level; the outer shells are cut open. hexapod_comp classify --pictures writes shells that turn."
    return Exhibit("Figure 2: shells", text, (), (statement,), figures)


def iteration(case: Study) -> Exhibit:
    """Return the comparison of the tangential iteration of chapter 1 with the exact solution."""
    agreement = compared(case.geometry, case.errors, case.reaches, COMPARED, seed=0)
    statements = (
        Statement(
            "motion of the passive legs over the travel of the active leg, steps of 0.01 mm",
            "less than 0.1 %",
            f"at most {agreement.drift:.3%}",
            within(agreement.drift < PASSIVE),
            f"The shipped unit at {COMPARED} random poses, with the errors of every strut.",
        ),
        Statement(
            "result of the iteration minus the exact solution",
            "marginal errors",
            f"within {agreement.tangential:.1e} of the error type's largest effect",
            within(agreement.tangential < PASSIVE),
            f"{agreement.effects} effects; legs of wrong length are corrected as the paper describes. "
            f"The linear method differs by {agreement.linear:.1e}.",
        ),
    )
    text = "A joint or leg moves to its wrong place in steps of 0.01 mm along tangents (the paper's equations 1 to 4)."
    return Exhibit("Chapter 1: the iteration", text, (), statements)
