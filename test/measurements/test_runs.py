"""Assembly of readings: lines, stations, directions of motion, joined sets, and the vector w of each channel.

The truth is the readings themselves, and closed-form strut lengths from the paper's two hexagons (plane geometry,
written here), not the package's kinematics.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import Machine, machines
from scipy.spatial.transform import Rotation
from strategies import paper_geometry

from hexapod_comp.errors import InputFileError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.readings import (
    BACKWARD,
    CHANNELS,
    FORWARD,
    FROM_PREVIOUS,
    KINDS,
    UNKNOWN,
    FileLine,
    MeasurementSet,
    Reading,
)
from hexapod_comp.measurements.runs import assemble
from hexapod_comp.pose import Pose, attitude_error


def geometry_with(work: Pose | None = None, tool: Pose | None = None) -> HexapodGeometry:
    """Return the paper's machine with a work frame and a tool."""
    paper = paper_geometry()
    frames = {"work": work or Pose.identity(), "tool": tool or Pose.identity()}
    return HexapodGeometry("paper", paper.base_joints, paper.platform_joints, paper.home, paper.limits, **frames)


def test_w_is_what_a_displaced_pose_shows() -> None:
    """The truth is the probe's place and the tool's attitude before and after a small displacement, in the work frame.

    Rotations compose to first order only, so 1e-6 rad leave up to 1e-12; measured 2e-13.
    """
    work = Pose.from_angles([0.02, -0.01, 0.03], np.deg2rad([5.0, -8.0, 30.0]))
    tool = Pose.from_angles([0.01, 0.02, -0.05], np.deg2rad([4.0, 3.0, -20.0]))
    geometry = geometry_with(work, tool)
    pose = work.inverse() @ Pose([0.01, -0.02, 0.42], np.eye(3)) @ tool
    channels = [c for c in CHANNELS if c.startswith(("position", "attitude"))]
    found = assemble(geometry, [Reading("p", 1, UNKNOWN, pose, c, 0.0) for c in channels])
    e = 1e-6 * np.array([3.0, -2.0, 1.0, 0.4, -0.7, 0.5])
    platform = found.stations.pose(0)
    rotation = Rotation.from_rotvec(e[3:]).as_matrix() @ platform.rotation
    point = platform.position + platform.rotation @ found.probe + e[:3]  # e displaces the measured point
    moved = work.inverse() @ Pose(point - rotation @ found.probe, rotation) @ tool
    expected = [*(moved.position - pose.position), *attitude_error(moved.rotation, pose.rotation)]
    np.testing.assert_allclose(found.directions() @ e, expected, rtol=0.0, atol=2e-12)


PAPER = paper_geometry()
LEVEL = np.eye(3)
HEADER = "run,direction,x_mm,y_mm,z_mm,channel,value,unit,temperature_degC\n"
FIRST = HEADER + (
    "x line,forward,-100,0,400,linear,0,um,20\n"
    "x line,forward,0,0,400,linear,3,um,20\n"
    "x line,forward,100,0,400,linear,5,um,21\n"
    "x line,backward,100,0,400,linear,4,um,21\n"
)
SECOND = HEADER + (
    "tracker,sequence,10,20,420,position_x,10.001,mm,22\n"
    "tracker,sequence,10,20,420,position_y,19.998,mm,22\n"
    "tracker,sequence,30,20,420,position_x,30.002,mm,22\n"
    "x line,,50,0,400,linear,1,um,20\n"
    "x line,,90,0,400,linear,2,um,20\n"
)


def lengths_at(points: np.ndarray) -> np.ndarray:
    """Return the paper machine's strut lengths of level poses, (n, 6) m, from sides of 300, 572 and 243 mm."""
    radius = np.sqrt((0.572**2 + 0.572 * 0.243 + 0.243**2) / 3.0)
    half = np.arcsin(0.243 / (2.0 * radius))
    corners = np.deg2rad([0.0, 120.0, 120.0, 240.0, 240.0, 360.0]) + half * np.array([1, -1, 1, -1, 1, -1])
    tips = np.deg2rad([60.0, 60.0, 180.0, 180.0, 300.0, 300.0])
    across = 0.3 / np.sqrt(3.0) * np.stack([np.cos(tips), np.sin(tips)], axis=1)
    across -= radius * np.stack([np.cos(corners), np.sin(corners)], axis=1)
    legs = points[:, None] + np.append(across, np.zeros((6, 1)), axis=1)
    return np.linalg.norm(legs, axis=2)


def at(*points: tuple[float, float, float]) -> list[Pose]:
    """Return level poses at points given in mm."""
    return [Pose((np.array(point) * 1e-3).round(9), LEVEL) for point in points]


def tracked(poses: list[Pose], channels: tuple[str, ...] = ("position_x",), run: str = "tracker") -> MeasurementSet:
    """Return a set of poses measured one after the other, each in some channels."""
    readings = [
        Reading(run, 1, FROM_PREVIOUS, pose, channel, 1e-6 * n, source=FileLine("test", n))
        for n, pose in enumerate(poses)
        for channel in channels
    ]
    return assemble(PAPER, readings)


def file_of(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_runs_of_equal_names_stay_apart(tmp_path: Path) -> None:
    """A line of another day with the same name has its own zero, so three runs stay three."""
    paths = [file_of(tmp_path, name, text) for name, text in (("a.csv", FIRST), ("b.csv", SECOND))]
    together = read_measurements(paths, PAPER)
    assert [run.name for run in together.runs] == ["x line [a.csv]", "tracker", "x line [b.csv]"]
    assert together.files[0] == ("a.csv", hashlib.sha256(paths[0].read_bytes()).hexdigest())
    with pytest.raises(InputFileError, match=r"b\.csv: is the same file as"):
        read_measurements([paths[1], paths[1]], PAPER)
    assert list(together.run) == [0, 0, 0, 0, 1, 1, 1, 2, 2]
    np.testing.assert_allclose([run.origin[0] for run in together.runs], [-0.1, 0.01, 0.05], atol=1e-15)


def test_one_door_for_tidy_and_wide_files(tmp_path: Path) -> None:
    """Rows of one channel and rows of one pose give the same readings; a wide file becomes one run."""
    columns = file_of(
        tmp_path,
        "columns.yaml",
        "format: hexapod_comp/columns\nversion: 1\norder: sequence\n"
        "commanded: {position: [x, y, z], unit: mm}\nmeasured: {position: [mx, my, mz], unit: mm}\n",
    )
    wide = "x,y,z,mx,my,mz\n10,20,420,10.001,19.998,420\n30,20,420,30.002,20,420.003\n"
    paths = [file_of(tmp_path, "monday.csv", wide), file_of(tmp_path, "tuesday.csv", wide.replace("30", "35"))]
    found = read_measurements(paths, PAPER, columns)
    assert [run.name for run in found.runs] == ["monday", "tuesday"]
    assert [name for name, _ in found.files] == ["monday.csv", "tuesday.csv"]
    assert (len(found), len(found.stations)) == (12, 4)
    np.testing.assert_allclose(found.value[:6] * 1e6, [1.0, -2.0, 0.0, 2.0, 0.0, 3.0], atol=1e-9)
    assert len(read_measurements(paths[:1], PAPER, columns)) == 6


def test_directions_of_a_sequence_follow_from_the_row_before() -> None:
    """Axes follow from the commanded positions, struts from closed-form lengths; the first row has no direction."""
    points = np.array([[0, 0, 400], [10, 0, 400], [10, -20, 430], [0, 0, 400], [0, 0, 380]]) * 1e-3
    found = tracked(at(*(points * 1e3)))
    assert list(found.station) == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(found.stations.sense[0], np.zeros(9))
    moved = np.concatenate([np.diff(points, axis=0), np.diff(lengths_at(points), axis=0)], axis=1)
    assert (np.abs(moved[:, 3:]) > 1e-5).all(), "no strut stands still here: signs are no rounding"
    np.testing.assert_array_equal(found.stations.sense[1:], np.sign(moved.round(12)))


def test_sorted_rows_of_a_sequence_are_noted_if_their_times_tell(tmp_path: Path) -> None:
    """Sorted by x, the stops have the times 60, 180, 0 and 120 s: by hand, one of three steps goes back in time."""
    header = "run,direction,x_mm,y_mm,z_mm,channel,value,unit,time_s\n"
    xs = (30, 10, 40, 20)
    rows = [f"t,sequence,{x},0,420,position_{a},0,um,{60 * n}\n" for n, x in enumerate(xs) for a in "xy"]
    measured = read_measurements([file_of(tmp_path, "a.csv", header + "".join(rows))], PAPER)
    assert not measured.notes
    ordered = sorted(rows, key=lambda row: row.split(",")[2])
    found = read_measurements([file_of(tmp_path, "b.csv", header + "".join(ordered))], PAPER)
    assert [note.partition("b.csv: ")[2].partition(":")[0] for note in found.notes] == [
        "1 of 3 stops of a sequence have an earlier time than the stop in the row before"
    ]


def test_a_strut_that_turns_on_the_way_has_the_direction_in_which_it_arrives() -> None:
    """On the way across the point below its base joint the strut becomes shorter, then longer by less."""
    joint = PAPER.base_joints[0, :2] - PAPER.platform_joints[0, :2]
    across = np.array([-joint[1], joint[0]]) / np.linalg.norm(joint)
    first, last = ((share * joint + way * across) * 1e3 for share, way in ((0.2, -0.06), (0.2, 0.03)))
    found = tracked(at((*first, 420.0), (*last, 420.0)))
    lengths = lengths_at(np.array([[*first, 420.0], [*last, 420.0]]) * 1e-3)[:, 0]
    assert lengths[1] < lengths[0] - 1e-5, "shorter in all"
    assert found.stations.sense[1, 3] == 1.0


def test_strut_readings_tell_directions_even_where_the_pose_stands_still() -> None:
    """Encoders 1 µm longer at the same pose are struts that extend, without a motion of the axes; 1 nm is no motion."""
    pose = at((0, 0, 400))[0]
    struts = lengths_at(pose.position[None])[0]
    told = [struts, struts + 1e-6, struts + 1e-6 + 1e-10]
    readings = [
        Reading("r", 1, FROM_PREVIOUS, pose, "position_x", 0.0, commands=tuple(c.tolist()), source=FileLine("test", n))
        for n, c in enumerate(told)
    ]
    sense = assemble(PAPER, readings).stations.sense
    np.testing.assert_array_equal(sense, [np.zeros(9), np.repeat([0.0, 1.0], [3, 6]), np.zeros(9)])


def test_directions_of_a_line_are_those_of_its_axis() -> None:
    """Forward is along the first axis that moves, whichever end is read first; unknown is neither direction.

    Forward rows that run backward, and backward rows that run forward, get a note."""
    poses = at((50, 0, 400), (-50, 0, 500))
    readings = [
        Reading("diagonal", 1, direction, pose, "linear", 0.0, source=FileLine("test", 3))
        for direction in (FORWARD, BACKWARD, UNKNOWN)
        for pose in poses
    ]
    found = assemble(PAPER, readings)
    np.testing.assert_allclose(found.runs[0].axis, np.array([1.0, 0.0, -1.0]) / np.sqrt(2.0), atol=1e-12)
    axes = found.stations.sense[found.station, :3]
    np.testing.assert_array_equal(axes[:2], [[1.0, 0.0, -1.0]] * 2)
    np.testing.assert_array_equal(axes[2:4], -axes[:2])
    np.testing.assert_array_equal(axes[4:], 0.0)
    assert found.runs[0].base_axis is None
    assert found.notes == ()
    there_and_back = [readings[0], readings[1], readings[3], readings[2]]
    assert assemble(PAPER, there_and_back).notes == (
        "test: line 3: run diagonal: rows with direction forward travel backward, and vice versa: "
        "are the directions exchanged?",
    )
    assert assemble(PAPER, there_and_back[2:]).notes == ()


def test_repeated_passes_share_stations_and_temperatures_part_them() -> None:
    """Two cycles over three places in both directions are six stations; at another temperature there are six more."""
    plan = Campaign(np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.6]]), 0.2, 0.1, "1-D", 0, cycles=2)
    found = template(plan, PAPER)
    assert len(found) == 2 * 2 * 3 * 12
    assert len(found.stations) == 2 * 3 * 12
    first = found.station[(found.run == 0) & (found.cycle == 1)]
    np.testing.assert_array_equal(first, found.station[(found.run == 0) & (found.cycle == 2)])
    cold = [Reading("line", 1, FORWARD, pose, "linear", 0.0) for pose in at((0, 0, 400), (10, 0, 400))]
    warm = [reading._replace(cycle=2, temperatures=(21.0,) * 8) for reading in cold]
    assert len(assemble(PAPER, cold + warm).stations) == 4


def went(machine: Machine, tips: np.ndarray, written: np.ndarray, counted_from: float | None = 0.0) -> list[Reading]:
    """Return readings of a level tool with wrong places in the file, with or without commanded strut lengths."""
    rotations = np.tile(machine.level(), (len(tips), 1, 1))
    lengths = machine.lengths(machine.platforms(tips), rotations)
    commands = [None if counted_from is None else tuple(row - counted_from) for row in lengths]
    poses = [Pose(tip, LEVEL) for tip in written]
    rows = zip(poses, commands, strict=True)
    return [Reading("all", 1, FROM_PREVIOUS, pose, "position_x", 0.0, commands=struts) for pose, struts in rows]


def in_box(machine: Machine) -> np.ndarray:
    """Return 10 random tips, (10, 3) m: the fewest from which a misreading is named."""
    return machine.box[0] + np.random.default_rng(1).random((10, 3)) * np.ptp(machine.box, axis=0)


@pytest.mark.parametrize(
    ("name", "change", "way", "counted_from"),
    [
        ("framed", lambda tips: tips[:, [2, 1, 0]], "with x and z exchanged", None),
        ("hanging", lambda tips: tips[:, [0, 2, 1]], "with y and z exchanged", 0.0),
        ("unit", lambda tips: tips / 25.4, "with coordinates in inches", None),
        ("mirror", lambda tips: tips * [1.0, 1.0, -1.0], "with the sign of z reversed", None),
    ],
)
def test_what_poses_may_mean_is_named(name, change, way: str, counted_from: float | None, tmp_path: Path) -> None:
    """The wrong machine or frame is named, with and without commanded strut lengths."""
    machine = machines()[name]
    geometry, tips = load_geometry(machine.write(tmp_path / "machine.yaml")), in_box(machine)
    with pytest.raises(InputFileError, match=f"are refused; none would be refused .*{way}"):
        assemble(geometry, went(machine, tips, change(tips), counted_from))


@pytest.mark.parametrize(("counted_from", "fine"), [(-0.0119, True), (-0.0120, False), (0.25, False)])
def test_strut_lengths_that_do_not_belong_to_the_pose_are_refused(
    counted_from: float, fine: bool, tmp_path: Path
) -> None:
    """2 % of the shortest strut are 11.9 mm; a control with another zero of lengths is off by more."""
    machine = machines()["inches"]
    geometry, tips = load_geometry(machine.write(tmp_path / "machine.yaml")), in_box(machine)
    readings = went(machine, tips, tips, counted_from)
    if fine:
        assert len(assemble(geometry, readings)) == len(tips)
        return
    lengths = 1e3 * machine.lengths(machine.platforms(tips), np.tile(machine.level(), (len(tips), 1, 1)))
    off = np.abs(counted_from) * 1e3 / lengths
    needed, n = lengths[(off > 0.02).any(axis=1)][0], off[(off > 0.02).any(axis=1)][0].argmax()
    text = f"strut_{n + 1}: {needed[n] - 1e3 * counted_from:.4f} mm was commanded, the pose needs {needed[n]:.4f} mm"
    with pytest.raises(InputFileError, match=re.escape(f"{text} (they may differ by 2 %)") + "$"):
        assemble(geometry, readings)


def test_readings_off_by_more_than_their_noise_and_coarse_ones_are_named(tmp_path: Path) -> None:
    """A laser's usual noise is 1 µm; the file states 299 or 301 µm for the line, and none for the tracker's 10 µm."""
    m = read_measurements(
        [file_of(tmp_path, name, text) for name, text in (("a.csv", FIRST), ("b.csv", SECOND))], PAPER
    )
    linear, position = KINDS.index("linear"), KINDS.index("position")
    off = "readings scatter by more than 5 times their noise"
    assumed = "position by 51 µm, 5.1 times the 10 µm assumed, since the file states none"
    assert m.misfit({linear: 4.9e-6, position: 49e-6}, 5.0) == ""
    assert m.misfit({linear: 4.9e-6, position: 51e-6}, 5.0) == f"{off}: {assumed}"
    beyond = "; stated uncertainties are too large for any such instrument (is the unit right?)"
    beyond += ": linear 301 µm, usual is 1 µm"
    for size, coarse in ((299e-6, ""), (301e-6, beyond)):
        stated = replace(m, uncertainty=np.where(m.kind == linear, size, np.nan))
        found = stated.misfit({linear: 5.5 * size, position: 51e-6}, 5.0)
        text = f"linear by {5.5e6 * size:.3g} µm, 5.5 times the {1e6 * size:.0f} µm stated"
        assert found == f"{off}: {text}; {assumed}{coarse}"
