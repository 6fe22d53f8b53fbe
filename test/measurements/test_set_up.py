"""Instruments of single readings and trackers that stand anywhere, on machines with hidden errors.

Truth: the machine's own model run forwards, as :func:`measure` runs it for whole campaigns; mistakes by construction.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from helpers import long_test

from benchmarks.live_machine import LiveMachine
from hexapod_comp.errors import HexapodError, InputFileError, LimitError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.load import Payload
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements.campaign import Campaign, circle_run, template
from hexapod_comp.measurements.collect import Observation, collect
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.measurements.set_up import SetUpError
from hexapod_comp.measurements.tidy import read_tidy
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.instruments import LiveFlaws, LiveInstrument, measure
from hexapod_comp.virtual.named import find_model

QUIET = LiveFlaws(length_noise=0.0, angle_noise=0.0, beam_slope=0.0, centre_off=0.0)

STANDS = Pose.from_angles([2.0, -1.0, 0.5], [0.3, 1.0, 2.5])  # Where a tracker stands, in base, m and rad

LARGER = ["inches", "hanging", *(pytest.param(name, marks=long_test) for name in ("paper", "example_6_6"))]


def machine_of(name: str, folder: Path) -> HexapodGeometry:
    return load_geometry("example_6_6" if name == "example_6_6" else machines()[name].write(folder / "machine.yaml"))


def campaign_of(geometry: HexapodGeometry, half: float = 0.02, **more: object) -> Campaign:
    """Return a campaign in a small box about home: four lines a direction, or what is asked for."""
    home = geometry.tool_pose(geometry.home)
    box = home.position + half * np.array([[-1.0] * 3, [1.0] * 3])
    kept = {"cell": 2.0 * half, "step": half / 2.0, "diagonals": 0, "poses": 0, "level": home.rotation, **more}
    return Campaign(box, **kept)  # type: ignore[arg-type]


def circle(geometry: HexapodGeometry) -> Campaign:
    home = geometry.tool_pose(geometry.home)
    run = circle_run("circle", home.position, 0.02, 12, np.eye(3)[:2], home.rotation)
    return campaign_of(geometry, instrument=None, runs=(run,))


def live(geometry: HexapodGeometry, kind: str = "laser", flaws: LiveFlaws = QUIET, **more: object) -> LiveMachine:
    return LiveMachine(geometry, find_model("random:3", geometry), LiveInstrument(geometry, kind, flaws=flaws, **more))


@pytest.mark.parametrize("name", LARGER)
def test_a_lasers_file_is_that_of_the_whole_campaign_measured_at_once(name: str, tmp_path: Path) -> None:
    """Signs, zeros and channels are those of :func:`measure`; turns of 1e-4 rad are no vectors, to their square."""
    geometry = machine_of(name, tmp_path)
    campaign, truth = campaign_of(geometry, diagonals=4), find_model("random:3", geometry)
    still = replace(truth, struts=replace(truth.struts, backlash=np.zeros(6)))
    machine = LiveMachine(geometry, still, LiveInstrument(geometry, "laser", flaws=QUIET))
    done = collect(campaign, geometry, machine, tmp_path / "out.csv")
    exact = replace(campaign, noise=(0.0,) * len(KINDS), beam_slope=0.0)
    expected = measure(template(campaign, geometry), exact, RealMachine(geometry, still), 0)
    read = read_tidy([tmp_path / "out.csv"], geometry)
    assert (done.resumed, done.missing) == (0, ())
    assert np.abs(read.value - expected.value).max() < 1e-7


def test_a_ball_bars_file_has_distances_from_any_zero(tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    campaign, machine = circle(geometry), live(geometry, "ball_bar")
    collect(campaign, geometry, machine, tmp_path / "out.csv")
    read = read_tidy([tmp_path / "out.csv"], geometry)
    centre = campaign.runs[0].centres[0]
    far = []
    for pose in [*zip(*(getattr(campaign.runs[0], part) for part in ("positions", "rotations")), strict=True)]:
        machine.move(Pose(*pose))
        far.append(np.linalg.norm(machine.tool.position - centre) - 0.02)
    forward = np.array(far) - far[0]
    backlash = 4e-5  # as drawn: each strut's direction differs from that of the pass in the campaign
    assert np.abs(read.value[:12] - forward).max() < backlash
    assert read.value[0] == 0.0


MISTAKES = [
    ({"scale": -1.0}, "linear reads reversed: its sign"),
    ({"scale": 1e3}, "mm read as m"),
    ({"scale": 1e6}, "µm read as m"),
    ({"scale": 2.0}, "twice the way"),
    ({"scale": 1.0 / 25.4}, "mm read as inches"),
    ({"scale": 1.05}, "linear reads 1.05 times the commanded way"),
    ({"exchanged": True}, "linear reads what straightness_y should: are the channels exchanged"),
]


@pytest.mark.parametrize(("flaws", "text"), MISTAKES)
def test_a_mistake_of_a_laser_is_reported_on_the_first_line(flaws: dict, text: str, tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    machine = live(geometry, flaws=LiveFlaws(**flaws))
    with pytest.raises(SetUpError, match=text):
        collect(campaign_of(geometry), geometry, machine, tmp_path / "out.csv")
    assert machine.observed <= 6 + 9, "six of the small moves, and one pass"


class Changed(LiveMachine):
    """Publishes other channels than its instrument reads: what a driver or a set-up may get wrong."""

    def __init__(self, of: LiveMachine, change: str) -> None:
        super().__init__(of.geometry, find_model("random:3", of.geometry), of.instrument)
        self._change = change

    def observe(self) -> Observation | None:
        seen = super().observe()
        c = {name: value for name, (value, _) in seen.channels.items()}
        if self._change == "sign of rotation_z":
            c["rotation_z"] *= -1.0
        elif self._change == "degrees":
            c = {name: np.degrees(value) if name.startswith("rotation") else value for name, value in c.items()}
        elif self._change == "arcsec":
            c = {name: np.degrees(v) * 3600.0 if name.startswith("rotation") else v for name, v in c.items()}
        elif self._change == "rotations exchanged":
            c["rotation_y"], c["rotation_z"] = c["rotation_z"], c["rotation_y"]
        elif self._change == "straightness exchanged":
            c["straightness_y"], c["straightness_z"] = c["straightness_z"], c["straightness_y"]
        elif self._change == "turned":
            y, z, a = c["straightness_y"], c["straightness_z"], np.radians(15.0)
            c["straightness_y"], c["straightness_z"] = np.cos(a) * y - np.sin(a) * z, np.sin(a) * y + np.cos(a) * z
        elif self._change == "target":
            c["linear"] += 0.04 * c["rotation_y"]
        elif self._change == "beam":
            c["straightness_z"] += 0.09 * c["linear"]
        elif self._change == "dead":
            c["straightness_z"] = 1.234e-3
        return seen._replace(channels={name: (value, 1e-7) for name, value in c.items()})


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("sign of rotation_z", "rotation_z reads reversed"),
        ("degrees", "rotation_y reads 5[67].* degrees read as rad"),
        ("arcsec", "arcsec read as rad"),
        ("rotations exchanged", "rotation_y reads what rotation_z should"),
        ("straightness exchanged", "straightness_y reads what straightness_z should"),
        ("turned", "is the instrument turned against the work frame"),
        ("target", "as if 4. mm from it: is the target at the tool's tip"),
        ("beam", "straightness_z changes by 0.0[89].* of the way"),
        ("dead", "straightness_z reads .* times the 0.5 mm by which the tool was moved"),
    ],
)
def test_what_a_driver_gets_wrong_is_reported_on_the_first_line(change: str, text: str, tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    machine = Changed(live(geometry, flaws=LiveFlaws()), change)
    with pytest.raises(SetUpError, match=text):
        collect(campaign_of(geometry), geometry, machine, tmp_path / "out.csv")
    assert machine.observed <= 6 + 9


@pytest.mark.parametrize("scale", [-1.0, 1e3, 0.5])
def test_a_mistake_of_a_ball_bar_is_reported_at_once(scale: float, tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    machine = live(geometry, "ball_bar", LiveFlaws(scale=scale))
    with pytest.raises(SetUpError, match="length reads"):
        collect(circle(geometry), geometry, machine, tmp_path / "out.csv")
    assert machine.observed == 2


def test_a_run_whose_zero_was_lost_begins_anew_and_comes_out_the_same(tmp_path: Path) -> None:
    """Broken beams told by NaN, and one that no driver tells of: what is read jumps."""
    geometry, campaign = load_geometry("paper"), campaign_of(load_geometry("paper"))
    whole = collect(campaign, geometry, live(geometry), tmp_path / "whole.csv").measurements
    machine = live(geometry)
    machine.broken, machine.silent = {9, 30}, {50}
    again = collect(campaign, geometry, machine, tmp_path / "broken.csv")
    assert again.missing == ()
    assert np.abs(again.measurements.value - whole.value).max() < 1e-9
    untold = live(geometry)
    go = untold.move

    def move(pose: Pose) -> None:
        go(pose)
        if untold.moves == 40:
            untold.instrument.zero()

    untold.move = move  # type: ignore[method-assign]
    assert (
        np.abs(collect(campaign, geometry, untold, tmp_path / "untold.csv").measurements.value - whole.value).max()
        < 1e-9
    )


def test_a_run_that_loses_its_zero_each_time_is_left_for_the_next_call(tmp_path: Path) -> None:
    geometry, campaign, path = load_geometry("paper"), campaign_of(load_geometry("paper")), tmp_path / "out.csv"
    machine = live(geometry)
    machine.broken = {8, 12, 16}
    done = collect(campaign, geometry, machine, path)
    assert done.missing == ("x line at y -20.0, z 380.0, whose zero was lost 3 times",)
    again = collect(campaign, geometry, live(geometry), path)
    assert (again.missing, len(again.measurements)) == ((), len(template(campaign, geometry)))


def test_an_interrupted_run_begins_anew_and_finished_ones_stay(tmp_path: Path) -> None:
    geometry, campaign, path = load_geometry("paper"), campaign_of(load_geometry("paper")), tmp_path / "out.csv"
    first = live(geometry)
    collect(campaign, geometry, first, path, going_on=lambda: first.observed < 30)
    again = live(geometry)
    done = collect(campaign, geometry, again, path)
    assert done.resumed == 20, "two lines of five places, there and back"
    assert len(done.measurements) == len(template(campaign, geometry))
    whole = collect(campaign, geometry, live(geometry), tmp_path / "whole.csv").measurements
    assert np.abs(done.measurements.value - whole.value).max() < 1e-9


@pytest.mark.parametrize("name", ["paper", "hanging"])
def test_a_tracker_that_stands_anywhere_reads_what_one_in_base_reads_up_to_a_motion(name: str, tmp_path: Path) -> None:
    """The motion that is left between both files is one rigid motion: four stations cannot know it better."""
    geometry = machine_of(name, tmp_path)
    campaign = campaign_of(geometry, instrument=None, poses=12, tilt=0.05)
    near = collect(campaign, geometry, live(geometry, "tracker"), tmp_path / "near.csv").measurements
    machine = live(geometry, "tracker", stands=STANDS)
    path, stop = tmp_path / "far.csv", lambda: machine.observed < 7
    collect(campaign, geometry, machine, path, going_on=stop, tracker_frame="free")
    done = collect(campaign, geometry, machine, path, tracker_frame="free")
    assert (done.resumed, done.missing) == (7, ())
    assert path.read_text().startswith("# tracker frame in base")
    read = read_tidy([path], geometry)
    turned = near.directions()[:, 3:].any(axis=1)
    assert np.abs(read.value).max() < 3e-3
    off = (read.value - near.value)[turned].reshape(-1, 3)
    assert np.ptp(off, axis=0).max() < 1e-5, "turns differ by one, to second order"
    assert np.abs(off).max() < 0.02, "of places within 40 mm, off by 0.3 mm"


def test_a_free_frame_hides_no_mirror_and_no_unit(tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    campaign = campaign_of(geometry, instrument=None, poses=12, tilt=0.05)
    for flaws, text in (
        ({"exchanged": True}, "turned by about"),
        ({"scale": 1e3}, "mm read as m"),
        ({"scale": -1.0}, "ways read reversed"),
    ):
        machine = live(geometry, "tracker", LiveFlaws(**flaws), stands=STANDS)
        with pytest.raises(SetUpError, match=text):
            collect(campaign, geometry, machine, tmp_path / "out.csv", tracker_frame="free")
        assert machine.observed <= 5


def test_a_file_goes_on_with_the_frame_that_it_was_begun_with(tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    campaign = campaign_of(geometry, instrument=None, poses=5)
    collect(campaign, geometry, live(geometry, "tracker"), tmp_path / "out.csv")
    with pytest.raises(InputFileError, match="was measured with --tracker-frame known"):
        collect(campaign, geometry, live(geometry, "tracker"), tmp_path / "out.csv", tracker_frame="free")


def test_gravity_and_payload_stand_in_the_file(tmp_path: Path) -> None:
    geometry = load_geometry("paper").carrying(Payload(2.5, (0.0, 0.01, 0.02)))

    class Tilted(LiveMachine):
        def observe(self) -> Observation | None:
            return super().observe()._replace(gravity=(1.0, 0.0, -9.7))

    machine = Tilted(geometry, find_model("random:3", geometry), LiveInstrument(geometry, "tracker", flaws=QUIET))
    collect(campaign_of(geometry, instrument=None, poses=3), geometry, machine, tmp_path / "out.csv")
    assert (read_tidy([tmp_path / "out.csv"], geometry).stations.loads == [2.5, 0.0, 0.01, 0.02, 1.0, 0.0, -9.7]).all()


def test_limits_that_leave_no_room_for_the_small_moves_are_named(tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    machine, campaign = live(geometry), campaign_of(geometry)
    go = machine.move

    def move(pose: Pose) -> None:
        if abs(pose.position[2] - campaign.box[0, 2]) > 1e-6:
            error: HexapodError = LimitError("stroke", "too long", 0.7, 0.6, 0, "nominal")
            error.reason = "limit"
            raise error
        go(pose)

    machine.move = move  # type: ignore[method-assign]
    with pytest.raises(SetUpError, match="no room to move along straightness_z at x line"):
        collect(campaign, geometry, machine, tmp_path / "out.csv")


def test_a_centre_that_is_known_to_5_mm_is_no_mistake_and_one_far_off_is_named(tmp_path: Path) -> None:
    """12 places on a circle of 60 mm: about a socket 40 mm aside the bar would read up to 20 mm more at the next."""
    geometry = load_geometry("paper")
    home = geometry.tool_pose(geometry.home)
    run = circle_run("circle", home.position, 0.06, 13, np.eye(3)[:2], home.rotation)
    campaign = campaign_of(geometry, instrument=None, runs=(run,))
    for seed in range(10):
        near = live(geometry, "ball_bar", replace(QUIET, centre_off=5e-3), seed=seed)
        assert collect(campaign, geometry, near, tmp_path / f"{seed}.csv").missing == ()
    machine = live(geometry, "ball_bar")
    set_up = machine.instrument.set_up
    machine.instrument.set_up = lambda place: set_up(Pose(place.position + np.array([0.04, 0.0, 0.0]), np.eye(3)))  # type: ignore[method-assign]
    with pytest.raises(SetUpError, match=r"length (jumps by .* each of 3 times: is the centre|reads)"):
        collect(campaign, geometry, machine, tmp_path / "far.csv")


def test_a_tracker_that_was_moved_between_two_calls_is_reported(tmp_path: Path) -> None:
    geometry, path = load_geometry("paper"), tmp_path / "out.csv"
    campaign = campaign_of(geometry, instrument=None, poses=12, tilt=0.05)
    first = live(geometry, "tracker", stands=STANDS)
    collect(campaign, geometry, first, path, going_on=lambda: first.observed < 6, tracker_frame="free")
    moved = live(geometry, "tracker", stands=Pose(STANDS.position + np.array([0.003, 0.0, 0.0]), STANDS.rotation))
    with pytest.raises(SetUpError, match=r"the tracker stands [23]\.\d mm from where it stood"):
        collect(campaign, geometry, moved, path, tracker_frame="free")
    assert moved.observed == 4
