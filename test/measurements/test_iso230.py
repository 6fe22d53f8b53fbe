"""Figures of ISO 230-2, -4 and -6 for examples calculated by hand; the standard that evaluates each run.

No published readings with all figures may be quoted freely, so the examples are ours; numbers are µm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from helpers import beside

from hexapod_comp.errors import InputFileError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.iso230 import (
    CircularTest,
    evaluate,
    evaluate_circle,
    every_target,
    judge,
    report,
    standards_json,
    standards_text,
)
from hexapod_comp.measurements.readings import BACKWARD, FORWARD, Reading
from hexapod_comp.measurements.runs import assemble
from hexapod_comp.pose import Pose

TARGETS = np.array([0.004, 0.103, 0.196, 0.305, 0.398, 0.501])  # m, unevenly spaced
# Of five readings two lie c below the mean, one on it, two c above it. So this is their mean, and
# s² = (c² + c² + 0 + c² + c²)/(5 − 1) = c², s = c. The order of the cycles differs from target to target.
#
#   target            1     2     3     4     5     6
#   mean ↑            0     2     5     3    −1     1
#   c = s ↑          0.5    1     1    0.5    2    0.5
#   mean ↓            3     4     9     8     1     4
#   c = s ↓          0.5    1    0.5   1.5  0.25   0.5
#
UP = np.array(
    [
        # one row per cycle
        [-0.5, 3.0, 5.0, 3.5, -3.0, 0.5],
        [0.5, 1.0, 4.0, 2.5, 1.0, 1.5],
        [0.0, 2.0, 6.0, 3.0, -1.0, 1.0],
        [-0.5, 1.0, 4.0, 3.5, -3.0, 1.5],
        [0.5, 3.0, 6.0, 2.5, 1.0, 0.5],
    ]
)
DOWN = np.array(
    [
        [3.5, 4.0, 8.5, 6.5, 0.75, 4.0],
        [2.5, 5.0, 9.5, 9.5, 1.25, 3.5],
        [3.0, 3.0, 9.0, 8.0, 0.75, 4.5],
        [2.5, 5.0, 8.5, 6.5, 1.25, 3.5],
        [3.5, 3.0, 9.5, 9.5, 1.0, 4.5],
    ]
)
MICROMETRE = 1e-6


def test_report() -> None:
    """Target 5 ↑: (−3 + 1 − 1 − 3 + 1)/5 = −1; from it −2, 2, 0, −2, 2, and (4 + 4 + 0 + 4 + 4)/4 = 4: s is 2.

    Repeatability: four times s; bidirectional the largest of 2s↑ + 2s↓ + |B|, R↑, R↓ at each target. 1: 1 + 1 + 3 = 5.
    2: 2 + 2 + 2 = 6.      3: 2 + 1 + 4 = 7. 4: 1 + 3 + 5 = 9.    5: 4 + 0.5 + 2 = 6.5, less than R↑ = 8: 8.    6: 1 + 1
    + 3 = 5. E: means ↑ from −1 to 5, ↓ from 1 to 9, together from −1 to 9. B̄: −(3 + 2 + 4 + 5 + 2 + 3)/6.

    A, mean ± 2s: ↑ −1…1, 0…4, 3…7, 2…4, −5…3, 0…2: from −5 to 7; ↓ 2…4, 2…6, 8…10, 5…11, 0.5…1.5, 3…5: from 0.5 to 11.
    M, of the mean of both directions, 1.5, 3, 7, 5.5, 0, 2.5: 7 − 0.
    """
    example = evaluate(TARGETS, np.array([UP, DOWN]) * MICROMETRE)
    assert report(example) + "\n" == beside(__file__)["report"]
    assert (example.notes, example.cycles) == ((), 5)
    assert report(evaluate(TARGETS[:2], np.array([UP, DOWN])[..., :2] * MICROMETRE)).splitlines()[-2:] == [
        "",
        "note: 2 targets over 99 mm; the standard asks for 5",
    ]


BOTH = np.array([UP, DOWN])
EXCHANGED = (
    "the reversal is positive at every target (mean {} µm), but backlash makes it negative: are directions or signs "
    "exchanged, or is backlash overcompensated?"
)


@pytest.mark.parametrize(
    ("targets", "deviations", "expected"),
    [
        (TARGETS, BOTH[:, :2], ["2 cycles; the standard asks for 5"]),
        (TARGETS[:4], BOTH[..., :4], ["4 targets over 301 mm; the standard asks for 5"]),
        (2.2 * TARGETS, BOTH, []),  # 1.0934 m: six targets are needed
        (4 * TARGETS, BOTH, ["6 targets over 1988 mm; the standard asks for 10"]),
        (5 * TARGETS, BOTH, ["6 targets over 2485 mm; the standard asks for 13",
                             "travel of 2.485 m; above 2 m the standard prescribes another test"]),
        (0.0254 * np.arange(6), BOTH, [
            "targets every 25.4 mm do not show errors with a period of 25.4 mm or 1/2, 1/3, … of it; "
            "the standard shifts each target by a random share of the expected period"]),
        (0.0254 * np.arange(6) + 2e-6 * np.eye(6)[3], BOTH, []),
        (TARGETS, BOTH[::-1], [EXCHANGED.format("3.167")]),
        (TARGETS, np.array([UP, UP - 0.8]), []),
        (TARGETS, np.array([UP, UP - 0.84]), [EXCHANGED.format("0.840")]),
        (TARGETS, np.array([UP, UP - 4.0 * (np.arange(6) > 0)]), []),
    ],
)  # fmt: skip
def test_notes(targets: np.ndarray, deviations: np.ndarray, expected: list[str]) -> None:
    """The standard asks for five cycles, five targets per metre and at least five, up to 2 m, and uneven spacing.

    Backlash makes every Bᵢ negative. The mean of six reversals has a standard error of √(2·6.75/5)/6 = 0.274 µm, three
    times which is 0.822 µm.
    """
    assert list(evaluate(targets, deviations * MICROMETRE).notes) == expected


RADIUS = 0.1
EIGHTHS = np.radians(45.0 * np.arange(8))  # angles of the readings: 0°, 45°, …, 315°
# A circle on which one axis goes 2 µm too far on both sides, and the other axis 2 µm too little
OVAL = np.array([2, 0, -2, 0, 2, 0, -2, 0]) * 1e-6
# Moving a centre by some µm changes radii by (µm)²/(0.1 m), about 0.01 nm, beside the calculation by hand
NEAR = {"abs": 1e-10}


def both_ways(ccw: np.ndarray, cw: np.ndarray, **options: bool) -> CircularTest:
    senses = np.repeat([1, -1], len(EIGHTHS))
    return evaluate_circle(RADIUS, np.tile(EIGHTHS, 2), np.concatenate([ccw, cw]), senses, **options)


def near(figures: dict[str, float]) -> dict[str, object]:
    return {name: pytest.approx(value * 1e-6, **NEAR) for name, value in figures.items()}


def test_an_oval_larger_one_way_than_the_other() -> None:
    """The path is 3 µm too large in ↺ and 1 µm in ↻. By symmetry the oval's own centre is the best: moving it lifts one
    end of each axis as much as it lowers the other.

    G ↺ = 2 − (−2) = 4, G ↻ the same. Both paths: from −2 + 1 = −1 to 2 + 3 = 5, so G(b) = 6. F ↺ from −2 + 3 = 1 to 2 +
    3 = 5; F ↻ from −2 + 1 = −1 to 2 + 1 = 3. D = (3 + 1)/2 = 2.
    """
    test = both_ways(OVAL + 3e-6, OVAL + 1e-6)
    of_radius = {"F_max_ccw": 5, "F_min_ccw": 1, "F_max_cw": 3, "F_min_cw": -1, "D": 2}
    assert test.figures == near({"G_ccw": 4, "G_cw": 4, "G_b": 6, **of_radius})
    assert test.readings == {"ccw": 8, "cw": 8}
    assert test.notes == ()


def test_a_single_bump() -> None:
    """3 µm at 0°, all else on the circle: the least distance is not that of the least-squares centre.

    With the centre moved by s towards the bump the deviations are 3 − s, −s/√2, 0, s/√2, s, s/√2, 0, −s/√2: from −s/√2
    to the larger of 3 − s and s. At s = 3/2 these are equal, and the distance 3/2 + 3/(2·√2) = 2.5607 is least.
    The least-squares circle has a mean of 3/8 and s = 2·3/8 = 3/4: its F is from −3/8 − 3/(4·√2) = −0.9053 to
    3 − 3/8 − 3/4 = 1.875, relative to its own radius; relative to the nominal radius 3/8 more.
    """
    bump = np.array([3e-6, 0, 0, 0, 0, 0, 0, 0])
    test = evaluate_circle(RADIUS, EIGHTHS, bump, np.ones(8))
    expected = {"G_ccw": 1.5 + 1.5 / np.sqrt(2.0), "F_max_ccw": 2.25, "F_min_ccw": -0.75 / np.sqrt(2.0)}
    assert test.figures == near(expected)
    assert test.notes == ("sense ccw only: G(b) and D are not computed; the standard asks for both senses",)


def test_what_a_circle_does_not_tell_is_left_out() -> None:
    unknown = both_ways(OVAL, OVAL, length_known=False)
    assert set(unknown.figures) == {"G_ccw", "G_cw", "G_b"}
    assert unknown.notes == ("the instrument's length is not calibrated: F and D are not computed",)
    for angles in (EIGHTHS[:5], np.radians(60.0 * np.arange(6))):
        arc = evaluate_circle(RADIUS, angles, OVAL[: len(angles)], np.ones(len(angles)))
        assert set(arc.figures) == {"G_ccw"}
        assert arc.notes == (
            "sense ccw only: G(b) and D are not computed; the standard asks for both senses",
            "the readings are on an arc: F and D are not computed, and G is smaller than on the full circle",
        )


@pytest.mark.parametrize(
    "change",
    [{"senses": np.array([1] * 6 + [-1] * 2)}, {"angles": EIGHTHS / 10.0}],
    ids=["two readings of one sense", "a short arc"],
)
def test_a_circle_that_cannot_be_judged_is_passed_by(change: dict[str, np.ndarray]) -> None:
    given = {"angles": EIGHTHS, "deviations": OVAL, "senses": np.ones(8), **change}
    assert evaluate_circle(RADIUS, **given) is None


def line(name: str, start: tuple[float, ...], stop: tuple[float, ...], rise: float, reversal: float) -> str:
    """Return two equal cycles with three targets, mm: forward 0, `rise`, 2·`rise` µm, backward `reversal` more."""
    rows = ""
    for cycle in (1, 2):
        for direction, more in (("forward", 0.0), ("backward", reversal)):
            for n in range(3):
                x, y, z = (a + 0.5 * n * (b - a) for a, b in zip(start, stop, strict=True))
                rows += f"{name},{direction},{cycle},{x},{y},{z},linear,{n * rise + more},um\n"
    return rows


def measured(folder: Path, rows: str) -> Path:
    path = folder / "lines.csv"
    path.write_text("run,direction,cycle,x_mm,y_mm,z_mm,channel,value,unit\n" + rows)
    return path


# Four body diagonals with E of 2·1 + 4, 2·2 + 3, 2·3 + 2 and 2·4 + 1 µm, and B of 4, 3, 2 and 1
DIAGONALS = "".join(
    line(f"d{n}", (-50.0, y, z), (50.0, -y, 900.0 - z), n, 5 - n)
    for n, (y, z) in enumerate([(-50, 400), (50, 400), (-50, 500), (50, 500)], start=1)
)


def test_each_standard_under_its_name(tmp_path: Path) -> None:
    """E goes from 0, the first mean forward, to 2·rise + reversal, the last backward; B is the reversal everywhere."""
    rows = line("x", (-50, 0, 450), (50, 0, 450), 1, 2) + DIAGONALS + line("f", (-50, -50, 450), (50, 50, 450), 3, 1)
    judged = judge(read_measurements(measured(tmp_path, rows), load_geometry(config_file("paper"))))
    found = standards_json(judged)
    for name, value in {"A": 4, "E": 4, "M": 2, "B": 2}.items():
        assert found["iso230_2"]["x"][f"{name}_m"] == pytest.approx(value * 1e-6, abs=1e-15)
    body = found["iso230_6"]["body"]
    assert [round(body[f"d{n}"]["E_m"] * 1e6, 9) for n in (1, 2, 3, 4)] == [6, 7, 8, 9]
    assert found["iso230_6"]["largest"] == {
        "body": {"E_d_m": pytest.approx(9e-6), "B_d_m": pytest.approx(4e-6)},
        "face": {"E_d_m": pytest.approx(7e-6), "B_d_m": pytest.approx(1e-6)},
    }
    assert standards_text(judged) + "\n" == beside(__file__)["standards"]
    runs = [f"{name}\n{standard}: 3 targets over {travel} mm" for name, standard, travel in (
        ("x", "ISO 230-2:2014", 100), *((f"d{n}", "ISO 230-6:2002", 173.205) for n in (1, 2, 3, 4)),
        ("f", "ISO 230-6:2002", 141.421))]  # fmt: skip
    assert [part.partition(",")[0] for part in every_target(judged).split("\n\n")[::4]] == runs


def ball_bar(ball: tuple[float, float, float], zero: str = "known", count: int = 12, tilt: float = 0.0) -> str:
    """Return a file of a ball bar on a circle of 50 mm about (10, 20, 450), 3 µm larger in ↺ and 1 µm in ↻.

    The circle has `count` points, 30° apart, in a plane tilted about y by `tilt`, rad. The bar reads the distance from
    the ball to the commanded point moved outwards by this much.
    """
    rows = "run,direction,cycle,x_mm,y_mm,z_mm,channel,value,unit,centre_x_mm,centre_y_mm,centre_z_mm,zero\n"
    for numbers, larger, cycle in ((range(count), 3e-3, 1), (range(count)[::-1], 1e-3, 2)):
        for turn in np.pi / 6 * np.array(numbers):
            out = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn), np.cos(turn) * np.sin(tilt)])
            middle = np.array([10.0, 20.0, 450.0])
            x, y, z = (middle + 50.0 * out).round(6)
            read = np.linalg.norm(middle + (50.0 + larger) * out - np.array(ball))
            rows += f"c,sequence,{cycle},{x},{y},{z},length,{read:.9f},mm,10,20,450,{zero}\n"
    return rows


@pytest.mark.parametrize(
    ("ball", "count", "tilt"),
    [((10.0, 20.0, 450.0), 12, 0.5), ((10.3, 19.6, 450.0), 12, 0.0), ((10.0, 20.0, 450.0), 7, 0.0)],
)
def test_circles_of_a_ball_bar(tmp_path: Path, ball: tuple[float, float, float], count: int, tilt: float) -> None:
    """Each path is round, so G is 0; both lie between circles 3 − 1 = 2 µm apart; they are 3, 1, on average 2 µm too
    large. An arc or an uncalibrated bar has no F and D.

    The ball may be 0.5 mm off. Places in the file are rounded to 1 nm.
    """
    (tmp_path / "c.csv").write_text(ball_bar(ball, "known", count, tilt))
    paper = load_geometry(config_file("paper"))
    found = judge(read_measurements(tmp_path / "c.csv", paper))
    wanted = {"G_ccw": 0, "G_cw": 0, "G_b": 2}
    if count == 12:
        wanted |= {"D": 2, "F_max_ccw": 3, "F_min_ccw": 3, "F_max_cw": 1, "F_min_cw": 1}
    expected = {f"{name}_m": pytest.approx(value * 1e-6, abs=3e-9) for name, value in wanted.items()}
    assert standards_json(found) == {"iso230_4": {"c": expected}}
    assert found.circles["c"].radius == pytest.approx(0.05, abs=1e-9)
    (tmp_path / "c.csv").write_text(ball_bar((10.0, 20.0, 450.0), "", count))
    judged = judge(read_measurements(tmp_path / "c.csv", paper))
    why = "the instrument's length is not calibrated: F and D are not computed"
    if count < 12:
        why = "the readings are on an arc: F and D are not computed, and G is smaller than on the full circle"
    assert standards_text(judged) == every_target(judged) == CIRCLE.format(2 * count, why)


CIRCLE = """\
ISO 230-4:2005, circles
run  radius mm  readings    G ↺    G ↻   G(b)  Fmax ↺  Fmin ↺  Fmax ↻  Fmin ↻  D
  c       50.0        {}  0.000  0.000  2.000       –       –       –       –  –  um
note: {}"""


def test_lengths_that_are_no_circle_are_left_out(tmp_path: Path) -> None:
    """A run is no circle with a point off the circle, or about a centre 15 mm away."""
    paper = load_geometry(config_file("paper"))
    for old, new in ((",60.0,20.0,450.0,", ",61.0,20.0,450.0,"), (",10,20,450,known", ",10,20,465,known")):
        text = ball_bar((10.0, 20.0, 450.0))
        assert old in text
        (tmp_path / "c.csv").write_text(text.replace(old, new))
        assert not judge(read_measurements(tmp_path / "c.csv", paper))


def test_axes_are_those_of_the_work_frame(tmp_path: Path) -> None:
    """On a machine whose work frame is turned in its base, a line along x of work is no diagonal."""
    framed = load_geometry(machines()["framed"].write(tmp_path / "framed.yaml"))
    start = framed.tool_pose(Pose(framed.home.position, framed.home.rotation)).position
    readings = [
        Reading("x", cycle, way, Pose(start + np.array([x, 0.0, 0.0]), np.eye(3)), "linear", x * 1e-5)
        for cycle in (1, 2)
        for way in (FORWARD, BACKWARD)
        for x in (0.0, 0.01, 0.02)
    ]
    judged = judge(assemble(framed, readings, in_reach=False))
    assert judged
    assert list(judged.axes) == ["x"]
    assert not judged.diagonals


def test_figures_need_no_reach(tmp_path: Path) -> None:
    """A line half a metre above the stroke has figures, although a fit cannot use it."""
    path, paper = measured(tmp_path, line("x", (-50, 0, 950), (50, 0, 950), 1, 2)), load_geometry(config_file("paper"))
    with pytest.raises(InputFileError, match="out of the machine's reach"):
        read_measurements(path, paper)
    judged = judge(read_measurements(path, paper, in_reach=False))
    assert judged.axes["x"].figures["E"] == pytest.approx(4e-6, abs=1e-15)
