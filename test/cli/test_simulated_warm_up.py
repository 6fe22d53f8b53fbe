"""A virtual machine that warms while it is measured.

Truth: a first-order lag's closed form, 1 − exp(−t/τ); growth of a line by expansion times kelvins; and files that give
the same numbers back.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines

from hexapod_comp import cli
from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.temperatures import PARTS
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.measurements.tidy import read_tidy
from hexapod_comp.virtual.warm_up import SENSED, WarmUp, growing, load_warm_up

ALIKE = WarmUp(
    rise=np.array([3.0] * 8 + [0.2]), time_constants=np.array([600.0] * 8 + [1200.0]), humidity=0.45, sensors=SENSED,
    noise=(0.0, 0.0), rounds=2, every=1200, pace=2,
)  # fmt: skip
STEEL = 11.5e-6


def test_parts_follow_the_power_by_a_first_order_lag() -> None:
    """On for 1000 s, off for another thousand: closed form on both ways; rounding of two thousand steps."""
    t = np.arange(1001.0)
    course = ALIKE.course(2000, off=(1000, 2000))
    reached = 1.0 - np.exp(-1000.0 / 600.0)
    np.testing.assert_allclose(course[:1001, 0], 20.0 + 3.0 * (1.0 - np.exp(-t / 600.0)), atol=1e-11)
    np.testing.assert_allclose(course[1000:, 7], 20.0 + 3.0 * reached * np.exp(-t / 600.0), atol=1e-11)
    np.testing.assert_allclose(course[:1001, 8], 0.45 + 0.2 * (1.0 - np.exp(-t / 1200.0)), atol=1e-12)


@pytest.mark.parametrize("name", ["framed", "hanging", "inches", "mirror"])
def test_a_machine_that_grows_evenly_shows_it_on_every_round(name: str, tmp_path: Path) -> None:
    """Struts, base and platform alike: the platform's place is the commanded one, grown; the tool's offset does not.
    What acts is the temperature, not what the filter makes of it 30 s later. Second order: 1e-9 of a metre's 1e-5."""
    geometry, box = load_geometry(machines()[name].write(tmp_path / "machine.yaml")), machines()[name].box
    side = float(np.ptp(box, axis=0).min())
    campaign = ALIKE.campaign(Campaign(box, side, side, None, 4, noise=(0.0,) * len(KINDS), beam_slope=0.0))
    truth = RealMachine(geometry, growing(MachineModel(geometry.name), np.full(3, STEEL)))
    read = ALIKE.measured(template(campaign, geometry), campaign, truth, seed=1)
    assert [run.name for run in read.runs[4:]] == [f"{a} {w}" for w in ("cold 1", "round 1", "round 2") for a in "xyz"]
    times = read.stations.times[read.station]
    assert times[read.run == 7].min() == 600.0, "half of the first round"
    warmth = 3.0 * (1.0 - np.exp(-np.maximum(times, 0.0) / 600.0))
    assert (read.stations.temperatures[read.station][times < 0.0] == 20.0).all()
    linear = read.channel == 0
    # From each run's first reading on, which has a warmth of its own.
    for run in range(len(read.runs)):
        rows = np.flatnonzero(linear & (read.run == run) & (read.direction == 1))
        grown = read.stations.positions[read.station[rows]] * (STEEL * warmth[rows])[:, None]
        wanted = (grown - grown[0]) @ read.runs[run].axis
        np.testing.assert_allclose(read.value[rows], wanted, atol=1e-11)


def test_sensors_tell_what_they_have() -> None:
    one = replace(ALIKE, sensors=("base",), humidity=np.nan, noise=(0.05, 0.0))
    true = one.course(3000)
    seen = one.sensed(true, np.random.default_rng(1))
    assert (np.delete(seen[:, :8], PARTS.index("base"), axis=1) == 20.0).all()
    assert np.isnan(seen[:, 8]).all()
    off = seen[1000:, 6] - true[1000:, 6]
    assert 0.002 < off.std() < 0.02, "0.05 K, an eighth of it after the filter"


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"sensors": ("spindle",)}, "must be of strut_1"),
        ({"sensors": ("base", "base")}, "each once"),
        ({"humidity": np.nan}, "of the humidity only where it is given"),
        ({"humidity": 45.0}, r"warm-up of humidity: must end within 0\.01…1"),
        ({"rise": np.array([300.0] * 9)}, "warm-up of strut_1: must end within -40…120"),
        ({"time_constants": np.zeros(9)}, "above zero"),
        ({"noise": (np.nan, 0.0)}, "must be finite"),
        ({"rounds": 0}, "cold_rounds"),
        ({"every": 10**7}, "1000000 s in all at most"),
    ],
)
def test_what_cannot_be_is_refused(change: dict, problem: str) -> None:
    with pytest.raises(ModelError, match=problem):
        replace(ALIKE, **change)


def test_the_shipped_file_and_one_with_a_slip(tmp_path: Path) -> None:
    text = config_file("warm_up").read_text(encoding="utf-8")
    warm, expansion = load_warm_up("warm_up")
    assert warm.sensors == PARTS
    np.testing.assert_array_equal(expansion, [11.5e-6] * 3)
    path = tmp_path / "slip.yaml"
    for wrong, problem in (
        (text.replace("strut_spread_percent: 10", "strut_spread_percent: 90"), "must be 0…20 %"),
        (text.replace("base_rise_K", "base_rise_degC"), "base_rise_degC"),
        (text + "sensors: base\n", "must be a list"),
        (text + "humidity_percent: [0.45, 0.65]\nhumidity_time_constant_s: 3600\n", "warm-up of humidity"),
        (text + "humidity_percent: [45, 65]\n", "time constants: must be finite"),
        ("", "slip.yaml"),
    ):
        path.write_text(wrong, encoding="utf-8")
        with pytest.raises(InputFileError, match=problem):
            load_warm_up(path)


SHORT = """format: hexapod_comp/warm_up
version: 1
struts_rise_K: 3.0
struts_time_constant_s: 1500
base_time_constant_s: 5400
platform_time_constant_s: 3000
expansion_ppm_per_K: [11.5, 11.5, 11.5]
humidity_percent: [45, 65]
humidity_time_constant_s: 3600
rounds: 1
"""

SMALL = """format: hexapod_comp/campaign
version: 1
box_mm: [[-100, -100, 400], [100, 100, 550]]
cell_mm: 150
step_mm: 150
diagonals: 4
"""


def test_the_verb_writes_times_and_what_sensors_tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = {name: tmp_path / name for name in ("warm.yaml", "small.yaml", "out.csv")}
    paths["warm.yaml"].write_text(SHORT, encoding="utf-8")
    paths["small.yaml"].write_text(SMALL, encoding="utf-8")
    options = ["--campaign", str(paths["small.yaml"]), "--warm-up", str(paths["warm.yaml"]), "--model", "paper_machine"]
    assert cli.main(["simulate", *options, "--out", str(paths["out.csv"])]) == 0
    assert "warms while it is measured: strut_1 0." in capsys.readouterr().out
    back = read_tidy(paths["out.csv"], load_geometry("paper"))
    assert np.isfinite(back.stations.times).all()
    assert np.ptp(back.stations.temperatures[:, 0]) > 0.3
    assert np.ptp(back.stations.humidity) > 0.005
