"""Collecting a campaign: the file holds what was seen, whatever happens on the way, and mistakes are found at once.

Truth: a stand-in for the machine whose tool is where a closed form says; no ROS runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from helpers import ALL_TESTS, long_test
from scipy.spatial.transform import Rotation

from hexapod_comp.errors import InputFileError, LimitError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.measurements import collect as collecting
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.collect import Collected, Observation, SetUpError, collect
from hexapod_comp.measurements.tidy import read_tidy
from hexapod_comp.pose import Pose

SHIFT = np.array([30e-6, -20e-6, 10e-6])  # How far the stand-in's tool is off along x, y, z of the base, m

TURN = np.array([40e-6, 10e-6, -25e-6])  # And turned, rad


def wrong(commanded: Pose) -> Pose:
    return Pose(commanded.position + SHIFT, Rotation.from_rotvec(TURN).as_matrix() @ commanded.rotation)


class StandIn:
    """Goes where it is sent, but for its error; `blind` counts observations that read nothing, `killed_at` ends it."""

    def __init__(self, geometry: HexapodGeometry, seen: Callable[[Pose], Pose] = wrong, killed_at: int = -1) -> None:
        self.geometry, self.seen, self.killed_at = geometry, seen, killed_at
        self.went: list[Pose] = []
        self.blind: set[int] = set()  # observations, by number
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


LARGER = ["inches", "hanging", *(pytest.param(name, marks=long_test) for name in ("paper", "example_6_6"))]


def machine_of(name: str, folder: Path) -> HexapodGeometry:
    return load_geometry("example_6_6" if name == "example_6_6" else machines()[name].write(folder / "machine.yaml"))


def small(geometry: HexapodGeometry, **more: object) -> Campaign:
    """Return a campaign about home: lines of a 5-D laser and eight poses of a tracker."""
    home = geometry.tool_pose(geometry.home)
    box = home.position + np.array([[-0.01, -0.01, -0.01], [0.01, 0.01, 0.01]])
    kept = {"cell": 0.02, "step": 0.01, "diagonals": 0, "poses": 8, "level": home.rotation, **more}
    return Campaign(box, **kept)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", LARGER)
def test_the_file_holds_what_was_seen(name: str, tmp_path: Path) -> None:
    """Every channel is the projection of one displacement and one turn; struts, times, temperatures as measured."""
    geometry, path = machine_of(name, tmp_path), tmp_path / "out.csv"
    campaign, machine = small(geometry), StandIn(machine_of(name, tmp_path))
    done = collect(campaign, geometry, machine, path)
    assert (done.resumed, done.missing) == (0, ())
    read, plan = read_tidy([path], geometry), template(campaign, geometry)
    assert len(read) == len(plan) == len(done.measurements)
    expected = plan.directions() @ np.concatenate([SHIFT, TURN])
    assert np.abs(read.value - expected).max() < 2e-11, "turns of 1e-4 rad are no vectors, to their square"
    assert np.allclose(read.uncertainty, 1e-7, rtol=1e-3)
    assert np.allclose(np.diff(read.stations.temperatures[:, :7], axis=0), 0.0)
    assert (np.diff(read.stations.temperatures[:, 7]) > 0.0).all()
    assert np.isfinite(read.stations.times).all()
    assert np.abs(read.stations.commands - [strut_lengths(geometry, read.stations.pose(n)) for n in
                                            range(len(read.stations))]).max() < 1e-12  # fmt: skip


def test_each_pass_begins_before_its_first_point(tmp_path: Path) -> None:
    geometry = load_geometry("paper")
    machine = StandIn(geometry)
    collect(small(geometry, poses=0), geometry, machine, tmp_path / "out.csv")
    places = np.array([pose.position for pose in machine.went])
    first, second, third = places[:3]
    assert np.linalg.norm(first - second) == pytest.approx(collecting.APPROACH)
    assert (second - first) @ (third - second) > 0.0
    assert np.abs(np.cross(second - first, third - second)).max() < 1e-15


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


def test_a_killed_run_goes_on_where_it_stopped_wherever_that_was(tmp_path: Path) -> None:
    """Killed after one of its moves, with every stop saved: the file comes out the same, to the last bit."""
    geometry, campaign = load_geometry("paper"), small(load_geometry("paper"), step=0.02)
    whole = tmp_path / "whole.csv"
    machine = StandIn(geometry)
    collect(campaign, geometry, machine, whole)
    for killed_at in range(1, len(machine.went), 5 if ALL_TESTS else 31):
        path = tmp_path / f"{killed_at}.csv"
        collecting.SAVE_EVERY, before = 0.0, collecting.SAVE_EVERY
        try:
            with pytest.raises(KeyboardInterrupt):
                collect(campaign, geometry, StandIn(geometry, killed_at=killed_at), path)
            rest = StandIn(geometry)
            done: Collected = collect(campaign, geometry, rest, path) if path.exists() else Collected(None, 0, ())  # type: ignore[arg-type]
        finally:
            collecting.SAVE_EVERY = before
        if not path.exists():
            continue
        assert len(rest.went) <= len(machine.went) - killed_at + 2, "but for the way to where a pass begins"
        ours, theirs = read_tidy([path], geometry), read_tidy([whole], geometry)
        assert done.resumed + rest.observed == machine.observed
        assert np.array_equal(ours.value, theirs.value)
        assert np.array_equal(ours.direction, theirs.direction)


@pytest.mark.parametrize("done", [2, 3, 4, 5, 6])
def test_what_is_left_of_a_pass_is_reached_in_its_direction(done: int, tmp_path: Path) -> None:
    """A run goes on within a pass, or at its last stop; the machine may stand anywhere: each stop is reached from the
    side that its file states, by the two places before and at it."""
    geometry, campaign = load_geometry("paper"), small(load_geometry("paper"), poses=0)
    first = StandIn(geometry)
    collect(campaign, geometry, first, tmp_path / "out.csv", going_on=lambda: first.observed < done)
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


def test_who_stops_it_keeps_what_was_read(tmp_path: Path) -> None:
    geometry, campaign = load_geometry("paper"), small(load_geometry("paper"))
    machine = StandIn(geometry)
    done = collect(campaign, geometry, machine, tmp_path / "out.csv", going_on=lambda: machine.observed < 7)
    assert len(read_tidy([tmp_path / "out.csv"], geometry)) == len(done.measurements) == 6 * 5, (
        "the seventh is the only one of its line"
    )


HOME = np.array([0.0, 0.0, 0.4])
MIRRORED = np.diag([-1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("seen", "text"),
    [
        (lambda p: Pose(p.position * 1e3, p.rotation), "1000 times as long as commanded: mm read as m?"),
        (lambda p: Pose(p.position / 25.4, p.rotation), "0.03937 times as long as commanded: mm read as inches?"),
        (lambda p: Pose(p.position * 1.1 - 0.1 * HOME, p.rotation), "1.1 times as long as commanded"),
        (lambda p: Pose(MIRRORED @ p.position, p.rotation), "ways read reversed"),
        (lambda p: Pose(p.position[[1, 0, 2]], p.rotation), "ways read turned by about 90.0°"),
        (lambda p: Pose(p.position + np.array([0.0, 0.03, 0.0]), p.rotation), "is measured 0.0, 30.0, 0.0 mm away"),
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
    with pytest.raises(InputFileError, match="is no reading of this campaign; give another file"):
        collect(moved, geometry, machine, path)
    assert (path.read_bytes(), machine.went) == (before, [])
