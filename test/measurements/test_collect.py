"""``collect``: the file holds what was observed, also after interruptions, and mistakes are found at once.

The truth is a stand-in whose tool is at a closed-form place, the machine's model run forwards, and known mistakes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from helpers import ALL_TESTS
from scipy.spatial.transform import Rotation

from benchmarks.live_machine import LiveMachine
from hexapod_comp.errors import InputFileError, LimitError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.machine.load import Payload
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements import collect as collecting
from hexapod_comp.measurements.campaign import Campaign, circle_run, template
from hexapod_comp.measurements.collect import Observation, SetUpError, collect
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.measurements.set_up import PoseCheck, TravelCheck, check_nudges
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.instruments import LiveFlaws, LiveInstrument, measure
from hexapod_comp.virtual.named import find_model

SHIFT = np.array([30e-6, -20e-6, 10e-6])  # displacement of the stand-in's tool along x, y, z of the base, m
TURN = np.array([40e-6, 10e-6, -25e-6])  # and its rotation, rad


def wrong(commanded: Pose) -> Pose:
    return Pose(commanded.position + SHIFT, Rotation.from_rotvec(TURN).as_matrix() @ commanded.rotation)


class StandIn:
    """A stand-in that moves to each pose with its error; observations in `blind` fail, `killed_at` ends it."""

    def __init__(self, geometry: HexapodGeometry, seen: Callable[[Pose], Pose] = wrong, killed_at: int = -1) -> None:
        self.geometry, self.seen, self.killed_at = geometry, seen, killed_at
        self.went: list[Pose] = []
        self.blind: set[int] = set()  # numbers of observations
        self.observed = 0

    def move(self, pose: Pose) -> None:
        if len(self.went) == self.killed_at:
            raise KeyboardInterrupt
        self.went.append(pose)

    def observe(self) -> Observation | None:
        self.observed += 1
        if self.observed - 1 in self.blind:
            return None
        tool = self.geometry.work @ self.went[-1]
        struts = strut_lengths(self.geometry, tool @ self.geometry.tool.inverse())
        warm = (21.0, 21.5, 22.0, 21.0, 20.5, 20.0, 20.0, 23.0 + 0.01 * len(self.went))
        return Observation(self.seen(tool), np.full(6, 1e-7), tuple(struts.tolist()), warm, float(self.observed))


def machine_of(name: str, folder: Path) -> HexapodGeometry:
    return load_geometry(machines()[name].write(folder / "machine.yaml"))


def campaign_of(geometry: HexapodGeometry, half: float = 0.02, **more: object) -> Campaign:
    """Return a campaign in a small box near home, by default four lines of a 5-D laser per direction."""
    home = geometry.tool_pose(geometry.home)
    box = home.position + half * np.array([[-1.0] * 3, [1.0] * 3])
    kept = {"cell": 2.0 * half, "step": half / 2.0, "diagonals": 0, "poses": 0, "level": home.rotation, **more}
    return Campaign(box, **kept)  # type: ignore[arg-type]


def small(geometry: HexapodGeometry, step: float = 0.01, poses: int = 8) -> Campaign:
    return campaign_of(geometry, 0.01, step=step, poses=poses)


def test_the_file_holds_what_was_seen(tmp_path: Path) -> None:
    """Each channel is the projection of one displacement and rotation; struts, times, temperatures are as read."""
    geometry, path = machine_of("inches", tmp_path), tmp_path / "out.csv"
    campaign, machine = small(geometry), StandIn(geometry)
    done = collect(campaign, geometry, machine, path)
    assert (done.resumed, done.missing) == (0, ())
    read, plan = read_measurements(path, geometry), template(campaign, geometry)
    assert len(read) == len(plan) == len(done.measurements)
    expected = plan.directions() @ np.concatenate([SHIFT, TURN])
    assert np.abs(read.value - expected).max() < 2e-11, "turns of 1e-4 rad are no vectors, to their square"
    assert np.allclose(read.uncertainty, 1e-7, rtol=1e-3)
    assert np.allclose(np.diff(read.stations.temperatures[:, :7], axis=0), 0.0)
    assert (np.diff(read.stations.temperatures[:, 7]) > 0.0).all()
    assert np.isfinite(read.stations.times).all()
    assert np.abs(read.stations.commands - [strut_lengths(geometry, read.stations.pose(n)) for n in
                                            range(len(read.stations))]).max() < 1e-12  # fmt: skip


def test_where_a_limit_forbids_it_a_pass_begins_at_its_first_point(tmp_path: Path) -> None:
    geometry, campaign = load_geometry("paper"), small(load_geometry("paper"), poses=0)

    class Narrow(StandIn):
        def move(self, pose: Pose) -> None:
            if (pose.position < campaign.box[0] - 1e-9).any() or (pose.position > campaign.box[1] + 1e-9).any():
                error = LimitError("stroke", "too long", 0.7, 0.6, 0, "nominal")
                error.reason = "limit"
                raise error
            super().move(pose)

    done = collect(campaign, geometry, Narrow(geometry), tmp_path / "out.csv")
    assert len(done.measurements) == len(template(campaign, geometry))


def test_a_killed_run_goes_on_where_it_stopped_wherever_that_was(tmp_path: Path, monkeypatch) -> None:
    """A run killed after any move, with every stop saved, continues to the same file, to the last bit."""
    geometry, campaign = load_geometry("paper"), small(load_geometry("paper"), step=0.02)
    machine = StandIn(geometry)
    whole = collect(campaign, geometry, machine, tmp_path / "whole.csv").measurements
    monkeypatch.setattr(collecting, "SAVE_EVERY", 0.0)
    for killed_at in range(6, len(machine.went), 5 if ALL_TESTS else 50):
        path = tmp_path / f"{killed_at}.csv"
        with pytest.raises(KeyboardInterrupt):
            collect(campaign, geometry, StandIn(geometry, killed_at=killed_at), path)
        rest = StandIn(geometry)
        done = collect(campaign, geometry, rest, path)
        assert len(rest.went) <= len(machine.went) - killed_at + 2, "but for the way to where a pass begins"
        assert done.resumed + rest.observed == machine.observed
        ours = read_measurements(path, geometry)
        assert np.array_equal(ours.value, whole.value)
        assert np.array_equal(ours.direction, whole.direction)


def test_what_is_left_of_a_pass_is_reached_in_its_direction(tmp_path: Path) -> None:
    """A run continues within a pass or at its last stop, from any place of the machine: each stop is reached from the
    direction in the file, over the place before it."""
    geometry, campaign = load_geometry("paper"), small(load_geometry("paper"), poses=0)
    first = StandIn(geometry)
    collect(campaign, geometry, first, tmp_path / "out.csv", going_on=lambda: first.observed < 5)
    rest = StandIn(geometry)
    rest.went.append(geometry.tool_pose(geometry.home))
    reached: list[np.ndarray] = []
    observe = rest.observe

    def noting() -> Observation | None:
        reached.append(rest.went[-1].position - rest.went[-2].position)
        return observe()

    rest.observe = noting  # type: ignore[method-assign]
    again = collect(campaign, geometry, rest, tmp_path / "out.csv")
    places = template(campaign, geometry)
    new = len(again.measurements) // 5 - again.resumed
    assert len(reached) == new
    directions = places.direction[::5][-new:]
    lines = np.array([run.axis for run in places.runs])[places.run[::5][-new:]]
    assert (np.sign((np.array(reached) * lines).sum(axis=1)) == directions).all()


def test_a_beam_that_is_broken_for_a_moment_is_asked_again_and_else_the_stop_is_left_out(tmp_path: Path) -> None:
    geometry, campaign = load_geometry("paper"), small(load_geometry("paper"))
    machine = StandIn(geometry)
    machine.blind = {0, 1, 5, *range(9, 12)}
    done = collect(campaign, geometry, machine, tmp_path / "out.csv")
    assert len(done.missing) == 1
    assert "line at" in done.missing[0]
    again = collect(campaign, geometry, StandIn(geometry), tmp_path / "out.csv")
    assert again.missing == ()
    assert len(again.measurements) == len(template(campaign, geometry)), "the next run takes what is missing"


HOME = np.array([0.0, 0.0, 0.4])
MIRRORED = np.diag([-1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("seen", "text"),
    [
        (lambda p: Pose(p.position / 25.4, p.rotation), "0.03937 times as long as commanded: mm read as inches?"),
        (lambda p: Pose(p.position * 1.1 - 0.1 * HOME, p.rotation), "1.1 times as long as commanded"),
        (lambda p: Pose(MIRRORED @ p.position, p.rotation), "the measured moves are opposite"),
        (lambda p: Pose(p.position[[1, 0, 2]], p.rotation), "the measured moves are turned by about 90.0°"),
        (lambda p: Pose(p.position + np.array([0.0, 0.03, 0.0]), p.rotation), "is 0.0, 30.0, 0.0 mm in base"),
        (lambda p: Pose(p.position, p.rotation @ Rotation.from_rotvec([0, 0, 0.1]).as_matrix()), "turned by 5.7°"),
    ],
)
def test_a_mistake_is_reported_after_the_first_line(seen: Callable[[Pose], Pose], text: str, tmp_path: Path) -> None:
    geometry, path = load_geometry("paper"), tmp_path / "out.csv"
    machine = StandIn(geometry, seen)
    with pytest.raises(SetUpError, match=text.replace("?", r"\?")):
        collect(small(geometry, step=0.005), geometry, machine, path)
    assert machine.observed <= 2 * 5, "of 125 stops: one line there and back"


def test_a_file_of_another_campaign_is_refused_and_kept(tmp_path: Path) -> None:
    geometry, path = load_geometry("paper"), tmp_path / "out.csv"
    collect(small(geometry), geometry, StandIn(geometry), path)
    before = path.read_bytes()
    moved = replace(small(geometry), box=small(geometry).box + 0.001)
    machine = StandIn(geometry)
    with pytest.raises(InputFileError, match="is not a reading of this campaign; begin a new file"):
        collect(moved, geometry, machine, path)
    assert (path.read_bytes(), machine.went) == (before, [])


QUIET = LiveFlaws(length_noise=0.0, angle_noise=0.0, beam_slope=0.0, centre_off=0.0)
STANDS = Pose.from_angles([2.0, -1.0, 0.5], [0.3, 1.0, 2.5])  # place of the tracker in base, m and rad


def circle(geometry: HexapodGeometry, radius: float, count: int) -> Campaign:
    home = geometry.tool_pose(geometry.home)
    run = circle_run("circle", home.position, radius, count, np.eye(3)[:2], home.rotation)
    return campaign_of(geometry, instrument=None, runs=(run,))


def live(geometry: HexapodGeometry, kind: str = "laser", flaws: LiveFlaws = QUIET, **more: object) -> LiveMachine:
    return LiveMachine(geometry, find_model("random:3", geometry), LiveInstrument(geometry, kind, flaws=flaws, **more))


def test_a_lasers_file_is_that_of_the_whole_campaign_measured_at_once(tmp_path: Path) -> None:
    """Signs, zeros and channels are those of :func:`measure`; rotations of 1e-4 rad add as vectors, to their square."""
    geometry = machine_of("hanging", tmp_path)
    campaign, truth = campaign_of(geometry, step=0.02, diagonals=4), find_model("random:3", geometry)
    still = replace(truth, struts=replace(truth.struts, backlash=np.zeros(6)))
    machine = LiveMachine(geometry, still, LiveInstrument(geometry, "laser", flaws=QUIET))
    set_up, path, there = machine.set_up, tmp_path / "out.csv", list[bool]()
    machine.set_up = lambda run: there.append(path.exists()) or set_up(run)  # type: ignore[method-assign,func-returns-value]
    done = collect(campaign, geometry, machine, path)
    assert there == [False] + [True] * 15, "once for each run; it may take long, so what was read before is written"
    exact = replace(campaign, noise=(0.0,) * len(KINDS), beam_slope=0.0)
    expected = measure(template(campaign, geometry), exact, RealMachine(geometry, still), 0)
    assert (done.resumed, done.missing) == (0, ())
    assert np.abs(read_measurements(path, geometry).value - expected.value).max() < 1e-7


def test_a_ball_bars_file_has_distances_from_any_zero(tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    campaign, machine = circle(geometry, 0.02, 12), live(geometry, "ball_bar")
    collect(campaign, geometry, machine, tmp_path / "out.csv")
    read = read_measurements(tmp_path / "out.csv", geometry)
    centre = campaign.runs[0].centres[0]
    far = []
    for pose in [*zip(*(getattr(campaign.runs[0], part) for part in ("positions", "rotations")), strict=True)]:
        machine.move(Pose(*pose))
        far.append(np.linalg.norm(machine.tool.position - centre) - 0.02)
    forward = np.array(far) - far[0]
    backlash = 4e-5  # each strut's direction differs from the direction of the pass
    assert np.abs(read.value[:12] - forward).max() < backlash
    assert read.value[0] == 0.0


def test_a_finished_circle_is_not_measured_again(tmp_path: Path) -> None:
    """A circle of both senses begins and ends at one place, so four of its stops have the same pose."""
    geometry, path = load_geometry("paper"), tmp_path / "out.csv"
    campaign = circle(geometry, 0.02, 12)
    whole = collect(campaign, geometry, live(geometry, "ball_bar"), path).measurements
    again, stops = live(geometry, "ball_bar"), len(whole)
    done = collect(campaign, geometry, again, path)
    assert (done.resumed, again.stops) == (stops, 0)
    assert np.array_equal(done.measurements.value, whole.value)
    poses = tmp_path / "poses.csv"  # by a tracker, a run that is interrupted or lacks a stop continues there
    machine = live(geometry, "tracker")
    collect(campaign, geometry, machine, poses, going_on=lambda: machine.observed < 7)
    assert collect(campaign, geometry, live(geometry, "tracker"), poses).resumed == 7
    rows = poses.read_text().splitlines(keepends=True)
    place = rows[1].split(",")[3:6]
    ends = [n for n, row in enumerate(rows) if row.split(",")[3:6] == place and ",length," in row]
    poses.write_text("".join(row for n, row in enumerate(rows) if n != ends[0]))
    left = live(geometry, "tracker")
    assert (collect(campaign, geometry, left, poses).resumed, left.observed) == (stops - 1, 1)


WRONG_UNITS = {
    "linear": {1e3: "mm read as m", 1e-3: "m read as mm", 25.4: "inches read as mm", 1 / 25.4: "mm read as inches",
               1e6: "µm read as m", 1e9: "nm read as m", 1 / 0.0254: "inches read as m",
               0.5: "laser wrongly set for double-pass optics",
               2.0: "laser not set for its double-pass optics"},
    "rotation_y": {180 / np.pi: "degrees read as rad", 648000 / np.pi: "arcsec read as rad", 1e3: "mrad read as rad",
                   1e6: "µrad read as rad", 1e-3: "rad read as mrad"},
}  # fmt: skip


@pytest.mark.parametrize(("channel", "moved"), [("linear", "0.5 mm"), ("rotation_y", "2 mrad")])
def test_wrong_units_and_jumps_are_named(channel: str, moved: str) -> None:
    """The truth is the units' sizes; a jump is a change of the error above 1 mm, 5 mrad, or a length's 10 mm."""
    for scale, unit in WRONG_UNITS[channel].items():
        for factor, more in ((scale, ""), (-scale, ", and reversed")):
            seen = np.array([[factor * float(moved.partition(" ")[0]) * 1e-3]])
            with pytest.raises(SetUpError) as error:
                check_nudges([channel], np.zeros((1, 6)), seen, [0.15])
            text = f"{channel} reads {factor:.4g} times the {moved} by which the tool was moved: {unit}{more}?"
            assert str(error.value) == text
    check_nudges([channel], np.zeros((1, 6)), np.array([[1.14e-3 * float(moved.partition(" ")[0])]]), [0.15])
    for name, most in (("linear", 1e-3), ("length", 0.01), ("straightness_x", 1e-3), ("rotation_x", 5e-3)):
        for size, jump in ((0.99 * most, 0.0), (1.01 * most, 1.01 * most)):
            commanded, follows = 1e-3, name in ("linear", "length")
            check, unsure = TravelCheck(name, nudged=True), TravelCheck(name, nudged=False)
            assert check.jump(0.0, 0.0) == unsure.jump(0.0, 0.0) == 0.0
            assert check.jump(commanded, follows * commanded - size) == pytest.approx(jump)
            assert unsure.jump(commanded, follows * commanded - size) == 0.0


LIMITS = [  # scale, turn and tilt in degrees, m away, message
    (1.0199, 0.0, 0.0, 0.0, ""),
    (1.0201, 0.0, 0.0, 0.0, "the measured moves are 1.02 times as long as commanded$"),
    (1.0, 2.57, 0.0, 0.0, ""),
    (1.0, 2.58, 0.0, 0.0, r"moves are turned by about 2\.6° from the commanded moves: does each axis"),
    (1.0, 0.0, 1.99, 0.0, ""),
    (1.0, 0.0, 2.01, 0.0, r"attitude is turned by 2\.0° from the command \(0\.0, 0\.0, 2\.0° about x, y, z of the"),
    (1.0, 0.0, 0.0, 9.99e-3, ""),
    (1.0, 0.0, 0.0, 10.1e-3, r"measured minus commanded position is 0\.0, 0\.0, 10\.1 mm in base, allowed are 10 mm"),
]


@pytest.mark.parametrize(("scale", "turn", "tilt", "away", "said"), LIMITS)
def test_limits_of_measured_moves_and_poses(scale: float, turn: float, tilt: float, away: float, said: str) -> None:
    """By hand: two stops 0.1 m apart are 0.05 m from their mean, so errors of 0.5 mm are 1 % of the travel: 1 % and 1 %
    of scale are allowed, and 2° and 0.01 rad of turn; 2° of attitude, and 10 mm."""
    about, far = np.array([0.0, 0.0, 1.0]), np.array([0.1, 0.0, 0.0])
    check, tool = PoseCheck(0.1), Rotation.from_rotvec(np.radians(tilt) * about).as_matrix()
    seen = scale * Rotation.from_rotvec(np.radians(turn) * about).apply(far)
    with pytest.raises(SetUpError, match=said) if said else nullcontext():
        check.plausible(Pose(HOME, np.eye(3)), Pose(HOME + away * about, tool))
        assert check.plausible(Pose(HOME + far, np.eye(3)), Pose(HOME + away * about + seen, tool))


def test_in_base_the_mean_position_error_is_compared() -> None:
    check, far = PoseCheck(0.1), Pose(HOME + np.array([1.0, 0.0, 0.0]), np.eye(3))
    assert not check.plausible(Pose(HOME, np.eye(3)), Pose(HOME + np.array([0.0, 0.0, 0.015]), np.eye(3)))
    assert check.plausible(far, far), "7.5 mm in the mean"


def test_with_a_free_frame_a_stop_whose_attitude_disagrees_with_the_others_is_reported() -> None:
    """The frame takes up an eighth of the turn of one of eight stops."""
    check, turned = PoseCheck(0.1, "free"), Rotation.from_rotvec([0.0, 0.0, np.radians(4.0)]).as_matrix()
    stops = [Pose(HOME + 0.1 * np.array(way), np.eye(3)) for way in np.ndindex(2, 2, 2)]
    assert all(check.plausible(stop, STANDS @ stop) for stop in stops[:-1])
    with pytest.raises(SetUpError, match=r"attitude is turned by 3\.\d° from the command"):
        check.plausible(stops[-1], STANDS @ Pose(stops[-1].position, turned))


SLOPES = [
    ("linear", 1.0171, ""),
    ("linear", 1.0173, r"linear reads 1\.017 times the commanded travel: is the beam along the line, and is the scale"),
    ("linear", -1.0, "linear reads -1 times the commanded travel: its sign is reversed: change the sign"),
    ("straightness_x", 0.0420, ""),
    (
        "straightness_x",
        -0.0421,
        r"straightness_x changes by -0\.0421 m per m of travel, allowed is ±0\.042: is the beam",
    ),
]


@pytest.mark.parametrize(("channel", "slope", "said"), SLOPES)
def test_limits_of_a_channels_slope(channel: str, slope: float, said: str) -> None:
    """Of six stops 20 mm apart those 50 mm or more apart are 70 mm apart in the median: 0.5 mm are 0.00714 of it."""
    check = TravelCheck(channel, nudged=True)
    with pytest.raises(SetUpError, match=said) if said else nullcontext():
        for n in range(6):
            check.jump(0.02 * n, slope * 0.02 * n)


def turned(c: dict[str, float], angle: float = np.radians(15.0)) -> dict[str, float]:
    y, z = c["straightness_y"], c["straightness_z"]
    cos, sin = np.cos(angle), np.sin(angle)
    return {"straightness_y": cos * y - sin * z, "straightness_z": sin * y + cos * z}


# Mistakes of an instrument, and of a driver or a set-up as changes of the published channels c
WRONG: dict[str, dict | Callable] = {
    "linear reads with reversed sign": {"scale": -1.0},
    "linear reads 1.05 times the commanded travel": {"scale": 1.05},
    "linear follows a move along straightness_y: are the two channels exchanged": {"exchanged": True},
    "rotation_z reads with reversed sign": lambda c: {"rotation_z": -c["rotation_z"]},
    "rotation_y reads 5[67].* degrees read as rad": lambda c: {
        n: 57.29578 * v for n, v in c.items() if n[:8] == "rotation"
    },
    "rotation_y follows a move along": lambda c: {"rotation_y": c["rotation_z"], "rotation_z": c["rotation_y"]},
    "straightness_y follows a move along straightness_z": lambda c: turned(c, np.pi / 2.0),
    "is the instrument turned relative to the work frame": turned,
    "as if the target were 4. mm off: is": lambda c: {"linear": c["linear"] + 0.04 * c["rotation_y"]},
    "straightness_z changes by 0.0[89].* m per m of travel": lambda c: {
        "straightness_z": c["straightness_z"] + 0.09 * c["linear"]
    },
    "straightness_z reads .* times the 0.5 mm by which the tool was moved": lambda c: {"straightness_z": 1.234e-3},
}


@pytest.mark.parametrize("text", WRONG)
def test_what_a_laser_or_its_driver_gets_wrong_is_reported_on_the_first_line(text: str, tmp_path: Path) -> None:
    geometry, mistake = load_geometry("paper"), WRONG[text]
    flaws, change = (mistake, lambda c: {}) if isinstance(mistake, dict) else ({}, mistake)
    machine = live(geometry, flaws=LiveFlaws(**flaws))
    observe = machine.observe

    def published() -> Observation | None:
        seen = observe()
        c = {name: value for name, (value, _) in seen.channels.items()}
        return seen._replace(channels={name: (value, 1e-7) for name, value in {**c, **change(c)}.items()})

    machine.observe = published  # type: ignore[method-assign]
    with pytest.raises(SetUpError, match=text):
        collect(campaign_of(geometry), geometry, machine, tmp_path / "out.csv")
    assert machine.observed <= 6 + 9, "six of the small moves, and one pass"


def test_a_run_whose_zero_was_lost_begins_anew_and_comes_out_the_same(tmp_path: Path) -> None:
    """Broken beams are reported by NaN; one that the driver does not report is noticed by a jump of the reading."""
    geometry = load_geometry("paper")
    campaign = campaign_of(geometry, step=0.02)
    whole = collect(campaign, geometry, live(geometry), tmp_path / "whole.csv").measurements
    machine = live(geometry)
    machine.broken, machine.silent, go = {9, 34}, {40}, machine.move

    def move(pose: Pose) -> None:
        go(pose)
        if machine.stops == 90:
            machine.instrument.zero()

    machine.move = move  # type: ignore[method-assign]
    again = collect(campaign, geometry, machine, tmp_path / "broken.csv")
    assert again.missing == ()
    assert np.abs(again.measurements.value - whole.value).max() < 1e-9


def test_a_tracker_that_stands_anywhere_reads_what_one_in_base_reads_up_to_a_motion(tmp_path: Path) -> None:
    """Both files differ by one rigid motion, which four stations cannot determine better."""
    geometry = machine_of("hanging", tmp_path)
    campaign = campaign_of(geometry, instrument=None, poses=12, tilt=0.05)
    near = collect(campaign, geometry, live(geometry, "tracker"), tmp_path / "near.csv").measurements
    machine = live(geometry, "tracker", stands=STANDS)
    path, stop = tmp_path / "far.csv", lambda: machine.observed < 7
    collect(campaign, geometry, machine, path, going_on=stop, tracker_frame="free")
    remark, _, rows = path.read_text().partition("\n")
    path.write_bytes(f'"{remark}",,,\n# Prüfer: Müller\n{rows}'.encode("cp1252"))  # as a spreadsheet may save it
    done = collect(campaign, geometry, machine, path, tracker_frame="free")
    assert (done.resumed, done.missing) == (7, ())
    assert path.read_text().startswith("# tracker frame in base")
    read = read_measurements(path, geometry)
    turned = near.directions()[:, 3:].any(axis=1)
    assert np.abs(read.value).max() < 3e-3
    off = (read.value - near.value)[turned].reshape(-1, 3)
    assert np.ptp(off, axis=0).max() < 1e-5, "turns differ by one, to second order"
    assert np.abs(off).max() < 0.02, "of places within 40 mm, off by 0.3 mm"


@pytest.mark.parametrize(("lengths", "angles"), [(0.0, 1e-3), (1e-3, 0.0)])
def test_a_trackers_noise_of_lengths_moves_positions_and_that_of_angles_turns_attitudes(lengths, angles) -> None:
    geometry = load_geometry("paper")
    flaws = replace(QUIET, length_noise=lengths, angle_noise=angles)
    tool = geometry.tool_pose(geometry.home)
    read = LiveInstrument(geometry, "tracker", flaws=flaws).pose(tool)
    assert (not np.array_equal(read.position, tool.position)) == (lengths > 0.0)
    assert (not np.allclose(read.rotation, tool.rotation, rtol=0.0, atol=1e-12)) == (angles > 0.0)


def test_gravity_and_payload_stand_in_the_file(tmp_path: Path) -> None:
    geometry = load_geometry("paper").carrying(Payload(2.5, (0.0, 0.01, 0.02)))

    class Tilted(LiveMachine):
        def observe(self) -> Observation | None:
            return super().observe()._replace(gravity=(1.0, 0.0, -9.7))

    machine = Tilted(geometry, find_model("random:3", geometry), LiveInstrument(geometry, "tracker", flaws=QUIET))
    collect(campaign_of(geometry, instrument=None, poses=3), geometry, machine, tmp_path / "out.csv")
    read = read_measurements(tmp_path / "out.csv", geometry)
    assert (read.stations.loads == [2.5, 0.0, 0.01, 0.02, 1.0, 0.0, -9.7]).all()


def test_a_centre_that_is_known_to_5_mm_is_no_mistake_and_one_far_off_is_named(tmp_path: Path) -> None:
    """40 mm from the socket, √(60² + 40² − 2·60·40·cos 30°) − (60 − 40) = 12.3 mm more is read 30° further on."""
    geometry = load_geometry("paper")
    campaign = circle(geometry, 0.06, 13)
    for seed in range(4):
        near = live(geometry, "ball_bar", replace(QUIET, centre_off=5e-3), seed=seed)
        assert collect(campaign, geometry, near, tmp_path / f"{seed}.csv").missing == ()
    machine = live(geometry, "ball_bar")
    set_up = machine.instrument.set_up
    machine.instrument.set_up = lambda place: set_up(Pose(place.position + np.array([0.04, 0.0, 0.0]), np.eye(3)))  # type: ignore[method-assign]
    with pytest.raises(SetUpError, match=r"length jumps by 12\.[23] mm .* in each of 3 attempts: is the centre"):
        collect(campaign, geometry, machine, tmp_path / "far.csv")


def test_a_tracker_that_was_moved_between_two_calls_is_reported(tmp_path: Path) -> None:
    geometry, path = load_geometry("paper"), tmp_path / "out.csv"
    campaign = campaign_of(geometry, instrument=None, poses=12, tilt=0.05)
    first = live(geometry, "tracker", stands=STANDS)
    collect(campaign, geometry, first, path, going_on=lambda: first.observed < 6, tracker_frame="free")
    moved = live(geometry, "tracker", stands=Pose(STANDS.position + np.array([0.003, 0.0, 0.0]), STANDS.rotation))
    with pytest.raises(SetUpError, match=r"the tracker was moved by about [23]\.\d mm .*, allowed are 1 mm"):
        collect(campaign, geometry, moved, path, tracker_frame="free")
    assert moved.observed == 4


def test_a_damaged_remark_about_the_tracker_is_refused(tmp_path: Path) -> None:
    geometry, path = load_geometry("paper"), tmp_path / "out.csv"
    campaign = campaign_of(geometry, instrument=None, poses=6, tilt=0.05)
    collect(campaign, geometry, live(geometry, "tracker", stands=STANDS), path, tracker_frame="free")
    remark, _, rows = path.read_text().partition("\n")
    for damaged in (remark.rpartition(",")[0], remark + "x", remark + ", 0"):
        path.write_text(f"{damaged}\n{rows}")
        with pytest.raises(InputFileError, match="tracker frame: must be a position, mm, and a quaternion"):
            collect(campaign, geometry, live(geometry, "tracker", stands=STANDS), path, tracker_frame="free")
