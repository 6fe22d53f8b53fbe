"""Campaigns that list their runs: written and read back, order of readings; test/cli/messages.txt has refusals."""

from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import calibration_helpers as small
import numpy as np
import pytest
from helpers import assert_defaults, beside

from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.measurements.campaign import (
    DIAGONALS,
    Campaign,
    CampaignRun,
    CircleEntry,
    campaign_readings,
    campaign_text,
    diagonals,
    line_run,
    load_campaign,
    template,
)
from hexapod_comp.measurements.readings import CHANNELS
from hexapod_comp.pose import rotation_from_angles

HEAD = "format: hexapod_comp/campaign\nversion: 1\n"
BOX = np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.5]])
TILTED = rotation_from_angles(np.radians([5.0, 3.0, 0.0]))
RUNS = (
    replace(line_run("backwards", "6-D", np.array([[0.1, 0.0, 0.45], [-0.1, 0.0, 0.45]]), 5, TILTED), slope="square"),
    line_run("diagonal", "linear", BOX, 3, np.eye(3)),
    CampaignRun("poses", "tracker", np.array([[0.0, 0.0, 0.45], [0.01, 0.02, 0.46]]), np.stack([np.eye(3), TILTED])),
)


def listed() -> Campaign:
    """Return a campaign of three listed runs."""
    return Campaign(BOX, 0.1, 0.1, None, 0, cycles=2, noise=tuple(1e-6 * np.arange(1.0, 8.0)), beam_slope=2e-6,
                    centre_off=3e-3, repeatability=4e-6, runs=RUNS)  # fmt: skip


def test_a_written_campaign_reads_back(tmp_path: Path) -> None:
    """A campaign read back gives the same commands to a picometre, and the same runs and numbers."""
    path = tmp_path / "planned.yaml"
    path.write_text(campaign_text(listed(), ["planned", "for a test"]))
    read = load_campaign(path)
    before, after = (template(campaign, small.paper()) for campaign in (listed(), read))
    np.testing.assert_allclose(after.stations.commands, before.stations.commands, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(after.channel, before.channel)
    np.testing.assert_array_equal(read.box, BOX)
    for name in ("cycles", "noise", "beam_slope", "centre_off", "repeatability"):
        assert getattr(read, name) == pytest.approx(getattr(listed(), name), rel=1e-12), name
    assert [run.slope for run in read.runs] == ["square", "", ""]
    assert read.stops == pytest.approx(np.sqrt(3.0) * 4e-6)
    assert path.read_text().startswith("# planned\n# for a test\nformat: hexapod_comp/campaign\n")


def test_readings_come_in_measuring_order() -> None:
    """Two cycles of five points in both directions with six channels, three with one channel, two poses with three."""
    m = template(listed(), small.paper())
    assert [run.name for run in m.runs] == ["backwards", "diagonal", "poses"]
    assert np.bincount(m.run).tolist() == [2 * 2 * 5 * 6, 2 * 2 * 3, 2 * 3]
    assert [CHANNELS[c] for c in m.channel[m.run == 2]][:3] == ["position_x", "position_y", "position_z"]
    x = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)[0][m.station, 0]
    assert x[0] == pytest.approx(-0.1)  # forward is towards positive x, whichever end is listed first
    assert m.direction[0] == 1
    assert set(map(str, m.sources)) == {"campaign"}


def test_a_tracker_reads_each_pose_as_reached_from_the_pose_before() -> None:
    """Struts lengthen or shorten by the difference of the nominal lengths; how the first pose is reached is unknown."""
    geometry = small.paper()
    campaign = Campaign(BOX, 0.1, 0.1, None, 0, poses=5, tilt=np.radians(8.0))
    stations = template(campaign, geometry).stations
    changes = np.diff(stations.commands, axis=0)
    assert np.abs(changes).min() > 1e-4
    np.testing.assert_array_equal(stations.sense[0], 0.0)
    np.testing.assert_array_equal(stations.sense[1:, 3:], np.sign(changes))


def test_readings_of_a_grid_are_counted_before_they_are_made() -> None:
    """Without diagonals the estimate of the number is exact; random poses are spread over the box and its tilts."""
    campaign = replace(listed(), instrument="6-D", step=0.05, poses=40, tilt=0.1)
    readings = list(campaign_readings(campaign))
    # lines along x: 3·2 of 5 points, along y the same, along z 3·3 of 3 points, with six channels, twice there and back
    assert len(readings) == 4 * 6 * (6 * 5 + 6 * 5 + 9 * 3) + 40 * 6 + 4 * (5 * 6 + 3) + 6
    assert len(readings) == campaign._approximate_count()
    poses = [r.pose for r in readings if r.run == "poses" and r.cycle <= 40][::6][:40]
    places = np.array([pose.position for pose in poses])
    assert ((places >= BOX[0]) & (places <= BOX[1])).all()
    assert (np.ptp(places, axis=0) > 0.8 * np.ptp(BOX, axis=0)).all()
    tilted = np.array([pose.rotation[2, :2] for pose in poses])
    assert (np.abs(tilted).max(axis=0) > 0.08).all()
    assert (np.abs(tilted) < 0.1).all()
    with pytest.raises(
        ModelError, match=r"cycles, poses, runs: result in about 1\.2.e\+06 readings; allowed are up to"
    ):
        replace(campaign, step=0.05, cycles=1150)


def test_diagonals_of_a_box() -> None:
    """Ends of body diagonals differ in three coordinates, ends of face diagonals in two."""
    corners = [tuple(corner) for corner in product(*BOX.T.tolist())]
    pairs = {n: [{a, b} for a, b in combinations(corners, 2) if sum(x != y for x, y in zip(a, b, strict=True)) == n]
             for n in (2, 3)}  # fmt: skip
    assert (DIAGONALS, Campaign(BOX, 0.1, 0.1).diagonals) == ((0, len(pairs[3]), len(pairs[3]) + len(pairs[2])), 4)
    found = [{tuple(end) for end in ends.tolist()} for ends in diagonals(BOX)]
    assert len(found) == 16
    assert all(pair in found[:4] for pair in pairs[3])
    assert all(pair in found[4:] for pair in pairs[2])


@pytest.mark.parametrize(("plane", "first", "second"), [("xy", 0, 1), ("yz", 1, 2), ("zx", 2, 0)])
def test_a_circle_turns_from_the_first_axis_of_its_plane_to_the_second(plane: str, first: int, second: int) -> None:
    run = CircleEntry(plane, np.zeros(3), 0.05, 5).run("circle", "ball_bar", np.eye(3))
    np.testing.assert_allclose(run.positions[:2], 0.05 * np.eye(3)[[first, second]], atol=1e-12)


def test_a_campaign_without_a_box_is_in_the_machines_own_box(tmp_path: Path) -> None:
    """Its cells are a quarter of the longest edge, also in a flat box; its steps are a quarter of the cell or height.

    A box in the file has one cell, as high as its shortest edge."""
    path, text, high, flat = tmp_path / "campaign.yaml", campaign_text(listed()), BOX + 0.1, BOX * [1.0, 1.0, 0.1]
    stated = "box_mm:\n- [-100.0, -100.0, 400.0]\n- [100.0, 100.0, 500.0]\n"
    assert stated in text
    own = text.replace(stated, "")
    for content, box, cell, smallest in ((text, BOX, 0.1, 0.1), (own, high, 0.05, 0.05), (own, flat, 0.05, 0.01)):
        path.write_text(content)
        read = load_campaign(path, lambda box=box: box)
        np.testing.assert_allclose(read.box, box, atol=1e-12)
        assert (read.cell, read.step) == pytest.approx((cell, smallest / 4))


def test_alternate_stops_are_read_once(tmp_path: Path) -> None:
    """Of five stops the first, third and fifth are read forward, the others backward; also from a file."""
    run = replace(RUNS[1], positions=np.linspace(*BOX, 5), rotations=np.tile(np.eye(3), (5, 1, 1)), alternate=True)
    path = tmp_path / "planned.yaml"
    path.write_text(campaign_text(replace(listed(), cycles=1, runs=(run,))))
    (read,) = load_campaign(path).runs
    readings = list(read.readings(1))
    assert [round(r.pose.position[0], 9) for r in readings] == [-0.1, 0.0, 0.1, 0.05, -0.05]
    assert [r.direction for r in readings] == [1, 1, 1, -1, -1]
    assert (read.count(1), read.count(2)) == (5, 10)


@pytest.mark.parametrize(("key", "wrong"), [("radius_mm", "-20"), ("radius_in", "0"), ("cell_in", "40.0")])
def test_a_refusal_states_key_and_value_as_in_the_file(tmp_path: Path, key: str, wrong: str) -> None:
    radius, cell = (f"{key}: {wrong}" if key.startswith(name) else "" for name in ("radius", "cell"))
    entry = (
        f"name: bar, instrument: ball_bar, plane: xy, centre_mm: [0, 0, 450], points: 8, {radius or 'radius_mm: 50'}"
    )
    path = tmp_path / "c.yaml"
    path.write_text(f"{HEAD}box_mm: [[-100, -100, 400], [100, 100, 500]]\n{cell}\nruns:\n  - {{{entry}}}\n")
    with pytest.raises(InputFileError, match=rf"c.yaml: (runs\[0\].)?{key}: must be above .* .found {wrong}."):
        load_campaign(path)


def test_a_box_and_a_run_that_cannot_be_are_refused() -> None:
    for box in (BOX[::-1], BOX[:, :2], BOX * [[1.0], [np.inf]], BOX[[0, 0]]):
        with pytest.raises(ModelError, match="box: must be the box's lowest corner and its highest corner"):
            Campaign(box, 0.1, 0.1)
    for given, said in (
        ({"instrument": None, "diagonals": 0}, "instrument: is missing, and so are diagonals, poses and runs"),
        ({"tilt": -0.1}, "tilt: must be finite and not negative"),
        ({"tilt": np.inf}, "tilt: must be finite and not negative"),
        ({"noise": (0.0,) * 6 + (-1e-9,)}, "noise.displacement: must be 0…"),
        ({"noise": (0.0,) * 6}, "noise: must be one number for each of linear, straightness, rotation, position"),
        ({"centre_off": np.nan}, "centre_off: must be 0…"),
    ):
        with pytest.raises(ModelError, match=said):
            Campaign(BOX, 0.1, 0.1, **given)
    for count in (0, 10_001):
        with pytest.raises(ModelError, match=f"run poses: must have 1 to 10000 points .found {count}"):
            CampaignRun("poses", "tracker", np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)))


def test_a_probe_needs_centres_and_a_tracker_has_none() -> None:
    for instrument, centres in (("probe", None), ("tracker", np.zeros((2, 3)))):
        with pytest.raises(ModelError, match=r"the instrument (probe reads .* needs|tracker must not have) a centre"):
            replace(RUNS[2], instrument=instrument, centres=centres)


def test_short_forms_of_instruments(tmp_path: Path) -> None:
    """In two cycles a circle is run twice in both senses; touches are on the upper half of a sphere, evenly high."""
    path = tmp_path / "instruments.yaml"
    path.write_text(beside(__file__)["instruments"])
    m = template(load_campaign(path), small.paper())
    assert np.bincount(m.run).tolist() == [4 * 5, 2 * 9 * 3, 2 * 2 * 6, 2 * 2, 2]
    assert [run.known_zero for run in m.runs] == [True, False, False, False, False]
    tips = m.points()[m.station] - m.geometry.work.position
    circle = (tips[m.run == 0] - [0.0, 0.0, 0.45]) @ m.geometry.work.rotation
    quarters = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 0, 1]]) * 0.05
    np.testing.assert_allclose(circle, np.vstack([quarters, quarters[::-1]] * 2), atol=1e-9)
    assert m.cycle[m.run == 0].tolist() == np.repeat([1, 2, 3, 4], 5).tolist()
    touches = (m.points()[m.station] - m.centre)[m.run == 2]
    np.testing.assert_allclose(np.linalg.norm(touches, axis=1), 0.02, atol=1e-9)
    np.testing.assert_allclose(touches[:6, 2], 0.02 * (np.arange(6) + 0.5) / 6, atol=1e-9)
    up = m.stations.rotations[m.station[m.run == 1]][:, 2, 2]
    assert np.degrees(np.arccos(up.min())) == pytest.approx(10.0, abs=0.1)
    written = tmp_path / "written.yaml"
    written.write_text(campaign_text(load_campaign(path)))
    again = template(load_campaign(written), small.paper())
    np.testing.assert_allclose(again.centre, m.centre, atol=1e-12)
    np.testing.assert_allclose(again.stations.commands, m.stations.commands, atol=1e-12)
    assert [run.known_zero for run in again.runs] == [run.known_zero for run in m.runs]
    for plain, turned in zip(load_campaign(path).runs, load_campaign(path, level=TILTED).runs, strict=True):
        np.testing.assert_allclose(turned.rotations, plain.rotations @ TILTED, atol=1e-15)  # no angles in the file


def test_defaults():
    assert_defaults(__file__)
