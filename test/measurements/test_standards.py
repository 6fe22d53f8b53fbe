"""Which standard judges which run, and the figures of ISO 230-4 and 230-6 worked out by hand; all in µm.

No published readings with all figures could be quoted freely: the examples are our own, small enough for a pencil.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from hypothesis import given, settings
from strategies import fixed, seeds

from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.iso230 import CircularTest, evaluate_circle, judge, standards_json, standards_text
from hexapod_comp.measurements.readings import BACKWARD, FORWARD, Reading
from hexapod_comp.measurements.runs import assemble
from hexapod_comp.pose import Pose

RADIUS = 0.1
EIGHTHS = np.radians(45.0 * np.arange(8))  # Where a circle is read: 0°, 45°, …, 315°

# A circle in which one axis goes 2 µm too far on both sides, the other as much too little
OVAL = np.array([2, 0, -2, 0, 2, 0, -2, 0]) * 1e-6

# Shifting a centre by some µm changes radii by (µm)²/(0.1 m), about 0.01 nm, beside what the pencil has
NEAR = {"abs": 1e-10}


def both_ways(ccw: np.ndarray, cw: np.ndarray, **options: bool) -> CircularTest:
    senses = np.repeat([1, -1], len(EIGHTHS))
    return evaluate_circle(RADIUS, np.tile(EIGHTHS, 2), np.concatenate([ccw, cw]), senses, **options)


def um(figures: dict[str, float]) -> dict[str, object]:
    return {name: pytest.approx(value * 1e-6, **NEAR) for name, value in figures.items()}


def test_an_oval_larger_one_way_than_the_other() -> None:
    """↺ 3 µm and ↻ 1 µm too large. No centre is better for an oval than its own, by symmetry: a shift lifts one end of
    each axis by what it lowers the other.

    G ↺ = 2 − (−2) = 4, G ↻ the same. Both paths: from −2 + 1 = −1 to 2 + 3 = 5, so G(b) = 6.
    F ↺ from −2 + 3 = 1 to 2 + 3 = 5; F ↻ from −2 + 1 = −1 to 2 + 1 = 3. D = (3 + 1)/2 = 2.
    """
    test = both_ways(OVAL + 3e-6, OVAL + 1e-6)
    of_radius = {"F_max_ccw": 5, "F_min_ccw": 1, "F_max_cw": 3, "F_min_cw": -1, "D": 2}
    assert test.figures == um({"G_ccw": 4, "G_cw": 4, "G_b": 6, **of_radius})
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
    assert test.figures == um(expected)
    assert test.notes == ("run ccw only: no G(b), no D; the standard's test runs both senses",)


@settings(fixed, max_examples=10)
@given(seeds)
def test_circles_within_circles(seed: int) -> None:
    """G(b) looks at both paths; no centre leaves less than the best; turning the plane changes nothing."""
    paths = np.random.default_rng(seed).normal(0.0, 3e-6, (2, 8))
    figures = both_ways(*paths).figures
    rounding = 1e-9  # of searching a centre along straight lines: its shift of some µm, squared, over 0.1 m
    assert figures["G_b"] + rounding >= max(figures["G_ccw"], figures["G_cw"])
    for name in ("ccw", "cw"):
        assert figures[f"G_{name}"] <= figures[f"F_max_{name}"] - figures[f"F_min_{name}"] + rounding
    turned = evaluate_circle(RADIUS, np.tile(EIGHTHS + 1.0, 2), paths.ravel(), np.repeat([1, -1], 8))
    assert turned.figures == pytest.approx(figures, abs=rounding)


def test_what_a_circle_does_not_tell_is_left_out() -> None:
    unknown = both_ways(OVAL, OVAL, length_known=False)
    assert set(unknown.figures) == {"G_ccw", "G_cw", "G_b"}
    assert unknown.notes == ("the instrument's length is not calibrated: no F, no D",)
    half = evaluate_circle(RADIUS, EIGHTHS[:5], OVAL[:5], np.ones(5))
    assert set(half.figures) == {"G_ccw"}
    assert "no full circle: F and D need one, and G of an arc is smaller" in half.notes


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"radius": 0.0}, "radius: must be finite and above zero"),
        ({"deviations": OVAL[:7]}, "must be lists of one length"),
        ({"deviations": np.append(OVAL[:7], np.nan)}, "deviations: must be finite"),
        ({"senses": np.zeros(8)}, "senses: must be 1 or -1"),
        ({"senses": np.array([1] * 6 + [-1] * 2)}, r"circle, cw: needs at least 5 readings \(found 2\)"),
        ({"angles": EIGHTHS / 10.0}, "circle, ccw: readings must span at least 90°"),
        ({"angles": EIGHTHS[:0], "deviations": OVAL[:0], "senses": OVAL[:0]}, "needs at least 5 readings"),
    ],
)
def test_a_circle_that_cannot_be_judged_is_refused(change: dict[str, object], says: str) -> None:
    given = {"radius": RADIUS, "angles": EIGHTHS, "deviations": OVAL, "senses": np.ones(8)}
    with pytest.raises(ModelError, match=says):
        evaluate_circle(**{**given, **change})  # type: ignore[arg-type]


# Lines: which standard they come under.


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
    """E: from 0, the first mean forward, to 2·rise + reversal, the last backward; B the reversal, at every target."""
    rows = line("x", (-50, 0, 450), (50, 0, 450), 1, 2) + DIAGONALS + line("f", (-50, -50, 450), (50, 50, 450), 3, 1)
    judged = judge(read_measurements(measured(tmp_path, rows), load_geometry(config_file("paper"))))
    found = standards_json(judged)
    assert found["iso230_2"]["x"] == um_of({"A": 4, "E": 4, "M": 2, "B": 2}, found["iso230_2"]["x"])
    body = found["iso230_6"]["body"]
    assert [round(body[f"d{n}"]["E_m"] * 1e6, 9) for n in (1, 2, 3, 4)] == [6, 7, 8, 9]
    assert found["iso230_6"]["largest"] == {
        "body": {"E_d_m": pytest.approx(9e-6), "B_d_m": pytest.approx(4e-6)},
        "face": {"E_d_m": pytest.approx(7e-6), "B_d_m": pytest.approx(1e-6)},
    }
    text = standards_text(judged)
    titles = [row for row in text.splitlines() if row.startswith("ISO")]
    assert titles == [
        "ISO 230-2:2014, lines along the axes, both directions",
        "ISO 230-6:2002, body diagonals, both directions",
        "ISO 230-6:2002, face diagonals, both directions",
    ]
    assert "largest of the 4: E_d 9.000 µm, B_d 4.000 µm" in text


def um_of(some: dict[str, float], found: dict[str, float]) -> dict[str, object]:
    """Return figures with those in µm that are known by hand, and all others as they are."""
    return {**found, **{f"{name}_m": pytest.approx(value * 1e-6, abs=1e-15) for name, value in some.items()}}


def ball_bar(ball: tuple[float, float, float], zero: str = "known") -> str:
    """Return a file of a ball bar on a circle of 50 mm about (10, 20, 450): ↺ 3 µm and ↻ 1 µm larger than commanded.

    What it reads is the distance of two points, the commanded one moved outwards by so much, and the ball.
    """
    rows = "run,direction,cycle,x_mm,y_mm,z_mm,channel,value,unit,centre_x_mm,centre_y_mm,centre_z_mm,zero\n"
    for sense, larger, cycle in ((1, 3e-3, 1), (-1, 1e-3, 2)):
        for n in range(12):
            out = np.array([np.cos(sense * n * np.pi / 6), np.sin(sense * n * np.pi / 6), 0.0])
            middle = np.array([10.0, 20.0, 450.0])
            x, y, z = (middle + 50.0 * out).round(6)
            read = np.linalg.norm(middle + (50.0 + larger) * out - np.array(ball))
            rows += f"c,sequence,{cycle},{x},{y},{z},length,{read:.9f},mm,10,20,450,{zero}\n"
    return rows


@pytest.mark.parametrize("ball", [(10.0, 20.0, 450.0), (10.3, 19.6, 450.0)])
def test_circles_of_a_ball_bar(tmp_path: Path, ball: tuple[float, float, float]) -> None:
    """Each path is round, so G is 0; both lie between circles 3 − 1 = 2 µm apart; 3, 1 and on average 2 µm too large.

    The ball may stand half a millimetre off. Places in the file are rounded to 1 nm.
    """
    (tmp_path / "c.csv").write_text(ball_bar(ball))
    paper = load_geometry(config_file("paper"))
    found = judge(read_measurements(tmp_path / "c.csv", paper))
    wanted = {"G_ccw": 0, "G_cw": 0, "G_b": 2, "D": 2}
    wanted |= {"F_max_ccw": 3, "F_min_ccw": 3, "F_max_cw": 1, "F_min_cw": 1}
    expected = {f"{name}_m": pytest.approx(value * 1e-6, abs=3e-9) for name, value in wanted.items()}
    assert standards_json(found) == {"iso230_4": {"c": expected}}
    assert found.circles["c"].radius == pytest.approx(0.05, abs=1e-9)
    rows = standards_text(found).splitlines()
    assert rows[0] == "ISO 230-4:2005, circles"
    assert rows[2].split()[:3] == ["c", "50.0", "24"]
    (tmp_path / "c.csv").write_text(ball_bar(ball, ""))
    assert set(judge(read_measurements(tmp_path / "c.csv", paper)).circles["c"].figures) == {"G_ccw", "G_cw", "G_b"}


def test_lengths_that_are_no_circle_are_left_out(tmp_path: Path) -> None:
    """A point off the circle, and a station a metre away."""
    paper = load_geometry(config_file("paper"))
    for old, new in ((",60.0,20.0,450.0,", ",61.0,20.0,450.0,"), (",10,20,450,known", ",10,20,1450,known")):
        text = ball_bar((10.0, 20.0, 450.0))
        assert old in text
        (tmp_path / "c.csv").write_text(text.replace(old, new))
        assert not judge(read_measurements(tmp_path / "c.csv", paper))


def test_axes_are_those_of_the_work_frame(tmp_path: Path) -> None:
    """On a machine whose work frame is turned in its base, a line along its x is no diagonal."""
    framed = load_geometry(machines()["framed"].write(tmp_path / "framed.yaml"))
    start = framed.tool_pose(Pose(framed.home.position, framed.home.rotation)).position
    readings = [
        Reading("x", cycle, way, Pose(start + np.array([x, 0.0, 0.0]), np.eye(3)), "linear", x * 1e-5)
        for cycle in (1, 2)
        for way in (FORWARD, BACKWARD)
        for x in (0.0, 0.01, 0.02)
    ]
    judged = judge(assemble(framed, readings, in_reach=False))
    assert list(judged.axes) == ["x"]
    assert not judged.diagonals


def test_figures_need_no_reach(tmp_path: Path) -> None:
    """A line half a metre above what the struts allow: a fit cannot use it, its figures are what they are."""
    path, paper = measured(tmp_path, line("x", (-50, 0, 950), (50, 0, 950), 1, 2)), load_geometry(config_file("paper"))
    with pytest.raises(InputFileError, match="out of the machine's reach"):
        read_measurements(path, paper)
    judged = judge(read_measurements(path, paper, in_reach=False))
    assert judged.axes["x"].figures["E"] == pytest.approx(4e-6, abs=1e-15)
