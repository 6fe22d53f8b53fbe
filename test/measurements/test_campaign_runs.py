"""Campaigns that list their runs: files there and back, their readings in order, and what is refused."""

from pathlib import Path

import calibration_helpers as small
import numpy as np
import pytest

from hexapod_comp.errors import InputFileError
from hexapod_comp.measurements.campaign import Campaign, campaign_text, load_campaign, template
from hexapod_comp.measurements.campaign_runs import CampaignRun, line_run
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
    """Return a campaign of three runs."""
    return Campaign(BOX, 0.1, 0.1, None, 0, cycles=2, runs=RUNS)


def test_a_written_campaign_reads_back(tmp_path: Path) -> None:
    """Commands of the machine after a file are those before it, to a picometre; noise and box too."""
    path = tmp_path / "planned.yaml"
    path.write_text(campaign_text(listed(), ["planned", "for a test"]))
    read = load_campaign(path)
    before, after = (template(campaign, small.paper()) for campaign in (listed(), read))
    np.testing.assert_allclose(after.stations.commands, before.stations.commands, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(after.channel, before.channel)
    np.testing.assert_array_equal(read.box, BOX)
    assert read.noise == listed().noise
    assert path.read_text().startswith("# planned\n# for a test\n")


def test_readings_come_in_measuring_order() -> None:
    """Two cycles of five points both ways under six channels, three under one, two poses under three."""
    m = template(listed(), small.paper())
    assert [run.name for run in m.runs] == ["backwards", "diagonal", "poses"]
    assert np.bincount(m.run).tolist() == [2 * 2 * 5 * 6, 2 * 2 * 3, 2 * 3]
    assert [CHANNELS[c] for c in m.channel[m.run == 2]][:3] == ["position_x", "position_y", "position_z"]
    x = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)[0][m.station, 0]
    assert x[0] == pytest.approx(-0.1)  # forward is towards positive x, whichever way the file lists the ends
    assert m.direction[0] == 1


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("instrument: linear", "instrument: laser"), "runs[1].instrument: must be one of linear"),
        (("instrument: linear", "instrument: rotation"), "run diagonal: is not parallel to an axis of the work frame"),
        (("points: 3", "points: 1"), "runs[1].points: must be 2 to 10000"),
        (("name: diagonal", "name: backwards"), "runs[1].name: is given to two runs"),
        (("[10.0, 20.0, 460.0]", "[10.0, 20.0, .nan]"), "runs[2].poses_mm[1][2]: must be finite"),
        (("[100.0, 0.0, 450.0]", "[-100.0, 0.0, 450.0]"), "run backwards: starts and ends at the same place"),
        (("points: 3", "spots: 3"), "runs[1].spots"),
    ],
)
def test_wrong_runs(tmp_path: Path, change: tuple[str, str], complaint: str) -> None:
    """File, key and value are named."""
    text = campaign_text(listed())
    assert change[0] in text
    path = tmp_path / "wrong.yaml"
    path.write_text(text.replace(*change, 1))
    with pytest.raises(InputFileError) as refused:
        load_campaign(path)
    assert complaint in str(refused.value)
    assert "wrong.yaml" in str(refused.value)
