"""Virtual machines, instruments and warm-up against closed forms; the verbs ``simulate`` and ``imagine``."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import UM, Errors, aligned_rms, machine_names, machines, tool_errors
from helpers import assert_equal, hexapod
from strategies import paper_geometry

from hexapod_comp.errors import HexapodError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import PARTS
from hexapod_comp.measurements.campaign import Campaign, load_campaign, template
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.readings import KINDS, MeasurementSet
from hexapod_comp.measurements.stations import compensated, station_errors
from hexapod_comp.virtual import named
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model
from hexapod_comp.virtual.instruments import measure
from hexapod_comp.virtual.warm_up import SENSED, WarmUp, growing, load_warm_up

BOX = np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.55]])
QUIET = Campaign(BOX, cell=0.1, step=0.05, instrument="6-D", diagonals=4, cycles=2, poses=20, tilt=0.1,
                 noise=(0.0,) * 7, beam_slope=0.0)  # fmt: skip


def of_kind(found: MeasurementSet, kind: str) -> np.ndarray:
    return found.kind == KINDS.index(kind)


def filled(campaign: Campaign, truth: RealMachine, seed: int = 3) -> MeasurementSet:
    return measure(template(campaign, truth.geometry), campaign, truth, seed)


def test_a_shifted_base_shows_in_absolute_positions_only() -> None:
    """Moving all base joints by d moves the platform by exactly d; lines, zeroed at their start, do not show it."""
    d = np.array([20e-6, -30e-6, 50e-6])
    truth = RealMachine(paper_geometry(), MachineModel("paper", base_deviation=np.tile(d, (6, 1))))
    found = filled(QUIET, truth)
    np.testing.assert_allclose(found.value[of_kind(found, "position")].reshape(-1, 3), np.tile(d, (20, 1)), atol=1e-13)
    np.testing.assert_allclose(found.value[~of_kind(found, "position")], 0.0, atol=1e-12)


def test_backlash_separates_the_directions() -> None:
    """Every strut lags by half its backlash of 4 µm. On vertical lines all struts move alike: upwards the platform is
    too low by 2 µm or more (the struts are oblique), downwards as much too high. Second order is 1e-11 m."""
    struts = StrutErrors(backlash=np.full(6, 4e-6))
    truth = RealMachine(paper_geometry(), MachineModel("paper", struts=struts))
    plan = template(Campaign(BOX, 0.1, 0.05, "1-D", 0), paper_geometry())
    errors = station_errors(plan, truth)
    along_z = np.flatnonzero([run.base_axis == 2 for run in plan.runs])
    for run in along_z:
        rows = np.flatnonzero(plan.run == run)
        up, down = (rows[plan.direction[rows] == d] for d in (1, -1))
        z = errors[plan.station, 2]
        np.testing.assert_allclose(z[up], -z[down[::-1]], atol=1e-10)
        assert (z[up] < -2e-6).all()


def test_noise_is_as_the_campaign_says() -> None:
    """Standard deviations of about 400 draws are within 15 %, four standard errors."""
    campaign = replace(QUIET, noise=(1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6, 7e-6), poses=200)
    truth = RealMachine(paper_geometry(), MachineModel("paper"))
    found = filled(campaign, truth)
    for kind, sigma in zip(KINDS, campaign.noise, strict=True):
        if of_kind(found, kind).any():
            assert found.value[of_kind(found, kind)].std() == pytest.approx(sigma, rel=0.15)
            assert set(found.uncertainty[of_kind(found, kind)]) == {sigma}
    few = replace(campaign, instrument=None, diagonals=0, poses=5)
    np.testing.assert_array_equal(filled(few, truth).value, filled(few, truth).value)
    assert not np.array_equal(filled(few, truth, seed=4).value, filled(few, truth).value)
    assert np.isnan(
        filled(replace(few, noise=(0.0,) * 7), truth).uncertainty
    ).all()  # without noise the readings state no uncertainty


def test_beam_slopes_bend_straightness_only_and_one_slope_holds_for_a_run() -> None:
    found = filled(replace(QUIET, beam_slope=100e-6), RealMachine(paper_geometry(), MachineModel("paper")))
    straight = of_kind(found, "straightness")
    np.testing.assert_allclose(found.value[~straight], 0.0, atol=1e-13)
    along = found.along()
    slopes = []
    for key in set(zip(found.run[straight], found.channel[straight], strict=True)):
        rows = (found.run == key[0]) & (found.channel == key[1]) & (np.abs(along) > 1e-3)
        each = found.value[rows] / along[rows]
        np.testing.assert_allclose(each, each[0], atol=1e-11)
        slopes.append(each[0])
    assert np.std(slopes) == pytest.approx(100e-6, rel=0.4)  # of 54 draws


def test_the_machine_stops_elsewhere_at_every_visit_for_all_channels_alike() -> None:
    campaign = Campaign(BOX, 0.1, 0.05, None, 0, poses=300, noise=(0.0,) * 7, repeatability=2e-6)
    found = filled(campaign, RealMachine(paper_geometry(), MachineModel("paper")))
    places = found.value[of_kind(found, "position")]
    assert places.std() == pytest.approx(2e-6, rel=0.15)
    lines = filled(replace(QUIET, repeatability=2e-6, poses=0), RealMachine(paper_geometry(), MachineModel("paper")))
    cycles = [lines.value[(lines.cycle == c) & (lines.channel == 0)] for c in (1, 2)]
    assert not np.allclose(cycles[0], cycles[1], atol=1e-9)
    np.testing.assert_allclose(lines.value[of_kind(lines, "rotation")], 0.0, atol=1e-13)


def test_the_truths_own_compensation_leaves_nothing() -> None:
    """The true model, run backwards and then forwards, leaves rounding of lengths below a metre: 1.2e-15 m."""
    geometry = paper_geometry()
    model = load_model(config_file("paper_machine"), geometry)
    plan = compensated(template(QUIET, geometry), model)
    errors = station_errors(plan, RealMachine(geometry, model))
    np.testing.assert_allclose(errors, 0.0, atol=1e-13)


def test_a_pose_that_cannot_be_taken_is_named() -> None:
    geometry = paper_geometry()
    plan = template(replace(QUIET, poses=0), geometry)
    short = plan.stations.commands.copy()
    short[3] *= 0.01
    plan = replace(plan, stations=replace(plan.stations, commands=short))
    with pytest.raises(HexapodError, match=r"run x line .*reading 19, the tool in work at x, y, z "):
        station_errors(plan, RealMachine(geometry, MachineModel("paper")))


SMALL = """format: hexapod_comp/campaign
version: 1
box_mm: [[-100, -100, 400], [100, 100, 600]]
cell_mm: 200
step_mm: 50
instrument: 5-D
diagonals: 0
poses: 5
tilt_deg: 5
noise: {linear_um: 0.5, rotation_arcsec: 0.2, straightness_um: 0}
"""


def test_verb_writes_what_it_says(tmp_path: Path) -> None:
    (tmp_path / "small.yaml").write_text(SMALL)
    shipped = config_file("warm_up").read_text(encoding="utf-8")
    (tmp_path / "warm.yaml").write_text(re.sub("^rounds: .*", "rounds: 1", shipped, flags=re.MULTILINE))
    paths, campaign = [tmp_path / name for name in ("one.csv", "warm.csv")], ("--campaign", tmp_path / "small.yaml")
    assert hexapod("simulate", *campaign, "--seed", 1, "--out", paths[0])[0] == 0
    geometry, campaign_read = paper_geometry(), load_campaign(tmp_path / "small.yaml")
    truth = RealMachine(geometry, load_model(config_file("paper_machine"), geometry))
    expected = measure(template(campaign_read, geometry, 1), campaign_read, truth, 1)
    # The file is rounded to 0.1 nm, the instruments' resolution; its stated noise is exact in its unit.
    found = read_measurements(str(paths[0]), geometry)
    np.testing.assert_allclose(found.value, expected.value, rtol=0.0, atol=0.51e-10)
    np.testing.assert_allclose(found.uncertainty, expected.uncertainty, rtol=1e-15)
    stated = {kind: found.uncertainty[of_kind(found, kind)][0] for kind in ("linear", "rotation", "position")}
    assert stated == pytest.approx({"linear": 0.5e-6, "rotation": np.radians(0.2 / 3600.0), "position": 10e-6})
    assert np.isnan(found.uncertainty[of_kind(found, "straightness")]).all()
    # With --warm-up the file has times, and temperatures and humidity of the shipped sensors.
    warm = ("--warm-up", tmp_path / "warm.yaml", "--model", "paper_machine", "--out", paths[1])
    assert hexapod("simulate", *campaign, *warm)[0] == 0
    stations = read_measurements(str(paths[1]), geometry).stations
    assert np.isfinite(stations.times).all()
    assert np.ptp(stations.temperatures[:, 0]) > 0.3


def test_runs_have_the_attitude_of_home_if_the_tool_cannot_be_parallel_to_work(tmp_path: Path) -> None:
    """Described in a work frame turned by 90°, the paper's machine keeps its platform level: it cannot turn by 90°."""
    machine, readings = tmp_path / "turned.yaml", tmp_path / "readings.csv"
    machine.write_text(
        f"{config_file('paper').read_text()}\nwork: {{position_mm: [0, 0, 0], rotation_deg: [0, 0, 90]}}\n"
    )
    listed = "runs: [{name: listed, instrument: tracker, poses_mm: [[0, 0, 450]]}]\n"
    (tmp_path / "small.yaml").write_text(SMALL.replace("poses: 5", "poses: 0") + listed)
    given = ("--machine", machine, "--model", "ideal", "--campaign", tmp_path / "small.yaml", "--out", readings)
    assert hexapod("simulate", *given)[0] == 0
    rotations = read_measurements(str(readings), load_geometry(machine)).stations.rotations
    np.testing.assert_allclose(rotations, np.tile(np.eye(3), (len(rotations), 1, 1)), atol=1e-12)


ALIKE = WarmUp(
    rise=np.array([3.0] * 8 + [0.2]), time_constants=np.array([600.0] * 8 + [1200.0]), humidity=0.45, sensors=SENSED,
    noise=(0.0, 0.0), rounds=2, every=1200, pace=2,
)  # fmt: skip
STEEL = 11.5e-6


def test_parts_follow_the_power_by_a_first_order_lag() -> None:
    """The power is on for 1000 s, then off for 1000 s; the truth is the closed form of a first-order lag."""
    t = np.arange(1001.0)
    course = ALIKE.over_time(2000, off=(1000, 2000))
    reached = 1.0 - np.exp(-1000.0 / 600.0)
    np.testing.assert_allclose(course[:1001, 0], 20.0 + 3.0 * (1.0 - np.exp(-t / 600.0)), atol=1e-11)
    np.testing.assert_allclose(course[1000:, 7], 20.0 + 3.0 * reached * np.exp(-t / 600.0), atol=1e-11)
    np.testing.assert_allclose(course[:1001, 8], 0.45 + 0.2 * (1.0 - np.exp(-t / 1200.0)), atol=1e-12)


@pytest.mark.parametrize("name", ["framed", "inches"])
def test_a_machine_that_grows_evenly_shows_it_on_every_round(name: str, tmp_path: Path) -> None:
    """If all parts grow alike, the platform's position grows with them; the tool's offset does not grow.

    The growth follows the temperature, not the sensor's filter, which is 30 s late. Second order: 1e-9 of 1e-5 m."""
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
    # Relative to each run's first reading, at which the laser was zeroed
    for run in range(len(read.runs)):
        rows = np.flatnonzero(linear & (read.run == run) & (read.direction == 1))
        grown = read.stations.positions[read.station[rows]] * (STEEL * warmth[rows])[:, None]
        wanted = (grown - grown[0]) @ read.runs[run].axis
        np.testing.assert_allclose(read.value[rows], wanted, atol=1e-11)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rise": np.array([3.0] * 7 + [100.1, 0.2])}, "warm-up of platform: must end within -40…120 °C (found 120.1"),
        ({"humidity": 0.81}, "warm-up of humidity: must end within 0.01…1 (found 1.01"),
        (
            {"time_constants": np.array([600.0] * 8 + [0.0])},
            "warm-up, time constants: must be finite and above zero, s",
        ),
        ({"sensors": ("base", "base")}, "warm-up, sensors: must be some of strut_1,"),
        ({"noise": (0.0, -0.01)}, "warm-up, noise: must be finite and not negative"),
        ({"noise": (np.inf, 0.0)}, "warm-up, noise: must be finite and not negative"),
        ({"cold_rounds": 3}, "warm-up, cold_rounds: must be 0…2 (rounds) (found 3)"),
        ({"pace": 0}, "rounds, every and pace must be above zero, and rounds × every must be at most 1000000 s"),
        ({"every": 500_001}, "(found [2, 500001, 2])"),
        ({"rounds": 0, "cold_rounds": 1}, "warm-up: rounds, every and pace must be above zero"),
    ],
)
def test_a_warm_up_that_cannot_be(changes: dict, said: str) -> None:
    with pytest.raises(HexapodError, match=re.escape(said)):
        replace(ALIKE, **changes)
    replace(ALIKE, rise=np.array([-60.0] + [100.0] * 7 + [0.55]), cold_rounds=0, every=500_000, pace=1, sensors=())
    replace(ALIKE, rise=np.array([0.0] * 8 + [-0.44]), cold_rounds=2, rounds=2, every=1)


def test_sensors_tell_what_they_have() -> None:
    one = replace(ALIKE, sensors=("base",), humidity=np.nan, noise=(0.05, 0.0))
    true = one.over_time(3000)
    seen = one.sensed(true, np.random.default_rng(1))
    assert (np.delete(seen[:, :8], PARTS.index("base"), axis=1) == 20.0).all()
    assert np.isnan(seen[:, 8]).all()
    off = seen[1000:, 6] - true[1000:, 6]
    assert 0.002 < off.std() < 0.02, "0.05 K, an eighth of it after the filter"


def test_the_shipped_warm_up_and_what_a_file_may_lack(tmp_path: Path) -> None:
    path = tmp_path / "w.yaml"
    constants = "".join(f"{part}_time_constant_s: 900\n" for part in ("struts", "base", "platform"))
    path.write_text(f"format: hexapod_comp/warm_up\nversion: 1\n{constants}")
    warm, expansion = load_warm_up(path)
    assert np.isnan(warm.rise[8])
    assert not warm.rise[:8].any()
    assert not expansion.any()
    assert (warm.noise, warm.time_constants.tolist()) == ((0.05, 0.01), [900.0] * 8 + [1.0])
    warm, expansion = load_warm_up("warm_up")
    assert warm.sensors == PARTS
    np.testing.assert_array_equal(expansion, [11.5e-6] * 3)


# Only errors that the tests' own kinematics have stay: structure, offsets and pitch
PLAIN = ("--wave-um", "0", "--map-um", "0", "--backlash-um", "0")


@pytest.mark.parametrize("name", machine_names())
def test_any_machine(name: str, tmp_path: Path) -> None:
    """The errors in the report of ``imagine`` are those of the written file, at random places of the box it names."""
    # Both figures are over 1,000 places. Aligned errors grow towards the corners: squares scatter by 1.5 times their
    # size, a mean square by 4.5/√1000 = 14 %, its root by 7 %, the difference of two roots by 10 %.
    machine = machines()[name]
    geometry, out = machine.write(tmp_path / "machine.yaml"), tmp_path / "truth.yaml"
    bounds = ("--joints-um", "30", "--struts-um", "20", "--pitch-ppm", "100")
    said = hexapod("imagine", "--machine", geometry, *bounds, *PLAIN, "--seed", 3, "--out", out)[1]
    truth = Errors.read(out)
    bodies = np.stack([truth.base, truth.platform])
    for values, bound in ((bodies, 30 * UM), (truth.offset, 20 * UM), (truth.pitch, 1e-4)):
        assert 0.5 * bound < np.abs(values).max() <= bound
        assert len(np.unique(values)) > 3
    corners, raw, aligned = re.search(
        r"in the box \((.*)\) mm in work: ([\d.]+) µm RMS absolute, ([\d.]+) µm", said
    ).groups()
    box = np.array([[float(v) * 1e-3 for v in c.split(",")] for c in corners.split(")…(")])
    tips = np.random.default_rng(8).uniform(box[0], box[1], (1000, 3))
    errors = tool_errors(machine, truth, None, tips)
    assert float(raw) * UM == pytest.approx(np.sqrt((errors**2).sum(axis=1).mean()), rel=0.1)
    assert float(aligned) * UM == pytest.approx(aligned_rms(tips, errors), rel=0.1)


def test_every_bound_ends_where_it_belongs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every option arrives in the bounds, in SI units; test_imperfections.py shows what bounds do."""
    given: list[ImperfectionBounds] = []
    real = named.imagine
    monkeypatch.setattr(named, "imagine", lambda *a: given.append(a[2]) or real(*a))
    out = tmp_path / "truth.yaml"
    options = "--joints-um 1 --struts-um 8 --pitch-ppm 14 --wave-um 2,3 --wave-period-mm 4 --map-um 1.5 --wear-um 3"
    options += " --backlash-um 5,6 --strut-expansion-ppm-per-k 10,11 --body-expansion-ppm-per-k 12,13 --field-um 7"
    options += " --field-urad 9 --field-reversal-percent 20 --box -50,-50,360,50,50,440 --name all"
    told = json.loads(hexapod("imagine", *options.split(), "--seed", 2, "--json", "--out", out)[1])
    assert (told["machine"], told["name"], told["seed"], told["tool_error"]["frame"]) == ("paper", "all", 2, "work")
    box = np.array([[-0.05, -0.05, 0.36], [0.05, 0.05, 0.44]])
    wanted = ImperfectionBounds(
        joint=1e-6, strut_offset=8e-6, pitch=14e-6, wave=(2e-6, 3e-6), wave_period=4e-3, length_map=1.5e-6, wear=3e-6,
        backlash=(5e-6, 6e-6), strut_expansion=(10e-6, 11e-6), body_expansion=(12e-6, 13e-6), field_displacement=7e-6,
        field_rotation=9e-6, field_reversal=0.2, field_box=box,
    )  # fmt: skip
    assert_equal(given[0], wanted, 1e-12)
    drawn = draw_model(load_geometry("paper"), given[0], 2)
    np.testing.assert_allclose(load_model(out, load_geometry("paper")).struts.offset, drawn.struts.offset, atol=1e-15)


@pytest.mark.parametrize(
    "command",
    [
        "ik --pose 10,20,400 --json --model",
        "export --box -50,-50,380,50,50,420 --table {}/t.csv --json --model",
        "simulate --campaign {}/campaign.yaml --out {}/m.csv --json --truth",
    ],
)
def test_random_is_the_same_machine_in_every_verb(command: str, tmp_path: Path) -> None:
    """``random:SEED`` and the file of ``imagine --seed SEED`` give the same numbers, printed and in files."""
    (tmp_path / "campaign.yaml").write_text(SMALL)
    file = tmp_path / "truth.yaml"
    assert hexapod("imagine", "--seed", 4, "--out", file)[0] == 0
    answers = []
    for name in (file, "random:4", "random:5"):
        code, out, _ = hexapod(*command.replace("{}", str(tmp_path)).split(), name)
        assert code == 0
        texts = [out, *(path.read_text() for path in sorted(tmp_path.glob("*.csv")))]
        answers.append([float(n) for n in re.findall(r"-?\d+\.\d+(?:e[+-]?\d+)?", "\n".join(texts))])
    assert answers[0] == pytest.approx(answers[1], rel=1e-12, abs=1e-12)
    assert answers[0] != answers[2]
