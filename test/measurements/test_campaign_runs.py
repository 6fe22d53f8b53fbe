"""Campaigns that list their runs: written and read back, the order of their readings, and refusals."""

import re
from dataclasses import replace
from pathlib import Path

import calibration_helpers as small
import numpy as np
import pytest

from hexapod_comp.errors import InputFileError
from hexapod_comp.measurements.campaign import Campaign, CampaignRun, campaign_text, line_run, load_campaign, template
from hexapod_comp.measurements.readings import CHANNELS
from hexapod_comp.pose import rotation_from_angles

BOX = np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.5]])
TILTED = rotation_from_angles(np.radians([5.0, 3.0, 0.0]))
RUNS = (
    line_run("backwards", "6-D", np.array([[0.1, 0.0, 0.45], [-0.1, 0.0, 0.45]]), 5, TILTED),
    line_run("diagonal", "linear", BOX, 3, np.eye(3)),
    CampaignRun("poses", "tracker", np.array([[0.0, 0.0, 0.45], [0.01, 0.02, 0.46]]), np.stack([np.eye(3), TILTED])),
)


def listed() -> Campaign:
    """Return a campaign of three listed runs."""
    return Campaign(BOX, 0.1, 0.1, None, 0, cycles=2, runs=RUNS)


def test_a_written_campaign_reads_back(tmp_path: Path) -> None:
    """A campaign read back gives the same commands to a picometre, the same noise and the same box."""
    path = tmp_path / "planned.yaml"
    path.write_text(campaign_text(listed(), ["planned", "for a test"]))
    read = load_campaign(path)
    before, after = (template(campaign, small.paper()) for campaign in (listed(), read))
    np.testing.assert_allclose(after.stations.commands, before.stations.commands, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(after.channel, before.channel)
    np.testing.assert_array_equal(read.box, BOX)
    assert read.noise == listed().noise


def test_readings_come_in_measuring_order() -> None:
    """Two cycles of five points in both directions with six channels, three with one channel, two poses with three."""
    m = template(listed(), small.paper())
    assert [run.name for run in m.runs] == ["backwards", "diagonal", "poses"]
    assert np.bincount(m.run).tolist() == [2 * 2 * 5 * 6, 2 * 2 * 3, 2 * 3]
    assert [CHANNELS[c] for c in m.channel[m.run == 2]][:3] == ["position_x", "position_y", "position_z"]
    x = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)[0][m.station, 0]
    assert x[0] == pytest.approx(-0.1)  # forward is towards positive x, whichever end is listed first
    assert m.direction[0] == 1


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


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("instrument: linear", "instrument: laser"), "runs[1].instrument: must be one of linear"),
        (("instrument: linear", "instrument: rotation"), "run diagonal: is not parallel to an axis of the work frame"),
        (("name: diagonal", "name: backwards"), "runs[1].name: is given to two runs"),
        (("[10.0, 20.0, 460.0]", "[10.0, 20.0, .nan]"), "runs[2].poses_mm[1][2]: must be finite"),
        (("[100.0, 0.0, 450.0]", "[-100.0, 0.0, 450.0]"), "run backwards: starts and ends at the same place"),
    ],
)
def test_wrong_runs(tmp_path: Path, change: tuple[str, str], complaint: str) -> None:
    """The message names file, key and value."""
    text = campaign_text(listed())
    assert change[0] in text
    path = tmp_path / "wrong.yaml"
    path.write_text(text.replace(*change, 1))
    with pytest.raises(InputFileError, match=f"wrong.yaml: {re.escape(complaint)}"):
        load_campaign(path)


INSTRUMENTS = """format: hexapod_comp/campaign
version: 1
box_mm: [[-100, -100, 400], [100, 100, 500]]
runs:
  - {name: circle, instrument: ball_bar, centre_mm: [0, 0, 450], radius_mm: 50, plane: zx, points: 5, zero: known}
  - {name: place, instrument: r_test, position_mm: [10, 20, 450], tilt_deg: 10, points: 9}
  - {name: plate, instrument: probe, centres_mm: [[0, 0, 400], [80, 0, 400]], radius_mm: 20, points: 6}
  - {name: outside, instrument: station, centre_mm: [700, 0, 100], poses_mm: [[0, 0, 450], [50, 0, 450]]}
"""


def test_short_forms_of_instruments(tmp_path: Path) -> None:
    """A circle stays in its plane with its radius, forward and back; touches and tilts have theirs."""
    path = tmp_path / "instruments.yaml"
    path.write_text(INSTRUMENTS)
    m = template(load_campaign(path), small.paper())
    assert np.bincount(m.run).tolist() == [2 * 5, 9 * 3, 2 * 6, 2]
    assert [run.known_zero for run in m.runs] == [True, False, False, False]
    tips = m.points()[m.station] - m.geometry.work.position
    circle = (tips[m.run == 0] - [0.0, 0.0, 0.45]) @ m.geometry.work.rotation
    quarters = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 0, 1]]) * 0.05
    np.testing.assert_allclose(circle, np.vstack([quarters, quarters[::-1]]), atol=1e-9)
    assert m.cycle[m.run == 0].tolist() == [1] * 5 + [2] * 5
    touches = np.linalg.norm((m.points()[m.station] - m.centre)[m.run == 2], axis=1)
    np.testing.assert_allclose(touches, 0.02, atol=1e-9)
    up = m.stations.rotations[m.station[m.run == 1]][:, 2, 2]
    assert np.degrees(np.arccos(up.min())) == pytest.approx(10.0, abs=0.1)
    written = tmp_path / "written.yaml"
    written.write_text(campaign_text(load_campaign(path)))
    again = template(load_campaign(written), small.paper())
    np.testing.assert_allclose(again.centre, m.centre, atol=1e-12)
    np.testing.assert_allclose(again.stations.commands, m.stations.commands, atol=1e-12)
    assert [run.known_zero for run in again.runs] == [run.known_zero for run in m.runs]


@pytest.mark.parametrize("entry", ["ball_bar, centre_mm: [0, 0, 450], plane: xy", "probe, centres_mm: [[0, 0, 450]]"])
@pytest.mark.parametrize("radius", ["-20", "0"])
def test_a_radius_that_is_not_above_zero_is_refused(tmp_path: Path, entry: str, radius: str) -> None:
    """A negative radius of a sphere would command touches from below."""
    text = campaign_text(listed()) + f"- {{name: one, instrument: {entry}, points: 9, radius_mm: {radius}}}\n"
    (tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(InputFileError, match=re.escape("wrong.yaml: runs[3].radius: must be above 0 (found")):
        load_campaign(tmp_path / "wrong.yaml")
