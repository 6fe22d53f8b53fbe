"""Parts that follow a thermometer late: against a numerical integration of the lag, and of two bodies that warm."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_helpers import paper
from scipy.integrate import solve_ivp

from hexapod_comp.errors import InputFileError, KinematicsError, ModelError
from hexapod_comp.machine.kinematics import Structure, strut_lengths_batch
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.surroundings import NO_LOAD, Surroundings
from hexapod_comp.machine.temperatures import PARTS, Lag, LateGrowth, Temperatures, late
from hexapod_comp.machine.trial import drive
from hexapod_comp.pose import Pose

TIMES = np.array([5.0, 65.0, 66.0, 200.0, 900.0, 1000.0])
VALUES = np.array([20.0, 20.4, 20.4, 21.5, 23.0, 22.1])


def integrated(constant: float) -> np.ndarray:
    """Return the lag's output minus its input at TIMES by integrating τ F' = s − F, s straight between readings."""
    flow = solve_ivp(
        lambda t, f: (np.interp(t, TIMES, VALUES) - f) / constant,
        (TIMES[0], TIMES[-1]), [VALUES[0]], t_eval=TIMES, rtol=1e-10, atol=1e-12, max_step=0.5,
    )  # fmt: skip
    return flow.y[0] - VALUES


@pytest.mark.parametrize("constant", [10.0, 300.0, 1e5])
def test_a_lag_is_the_solution_of_its_equation(constant: float):
    """The integration's own error is some 1e-9 K."""
    found = late(TIMES, VALUES[:, None], [constant])[:, 0, 0]
    np.testing.assert_allclose(found, integrated(constant), atol=1e-7)


def test_readings_one_by_one_and_all_at_once_in_any_order():
    """What a compensator carries is what a fit works out, to rounding."""
    constants, temperatures = (100.0, 1000.0), Temperatures()
    behind = []
    for time, value in zip(TIMES, VALUES, strict=True):
        temperatures.follow("base", value, time, constants)
        behind.append(list(temperatures.lags["base"].behind))
    shuffled = np.array([3, 0, 5, 1, 4, 2])
    found = late(TIMES[shuffled], VALUES[shuffled, None], constants)[:, 0]
    np.testing.assert_allclose(found, np.array(behind)[shuffled], atol=1e-12)


def warming_model(**changes) -> MachineModel:
    """Return a model with two time constants, all parts by the base's thermometer."""
    expansion = 1e-6 * np.arange(16.0).reshape(8, 2)
    values = {"time_constants": (600.0, 7200.0), "expansion": expansion, "thermometer": "base"} | changes
    struts = StrutErrors(expansion=np.full(6, 11e-6))
    model = MachineModel("paper", "warm", struts=struts, base_expansion=10e-6, platform_expansion=23e-6)
    return replace(model, late_growth=LateGrowth(**values), origin=ModelOrigin("2026-01-31"))


def test_a_machine_grows_by_one_thermometer_and_what_is_behind_it():
    """Growth of strut 3: 11 ppm/K of 2 K, less 4 and 5 ppm/K of 1 and 1.5 K: 10.5 ppm; the base: 20 − 12 − 19.5."""
    read = dict(zip(PARTS, [99.0] * 6 + [22.0, 50.0], strict=True))
    behind = {part: Lag(np.nan, np.nan, [-1.0, -1.5] if part == "base" else [0.0, 0.0]) for part in PARTS}
    warm = RealMachine(paper(), warming_model(), Temperatures(read, behind))
    assert warm.growth[2] == pytest.approx(10.5e-6)
    nominal = paper().kernel_joints[0]
    np.testing.assert_allclose(warm.structure.base_joints - nominal, -11.5e-6 * nominal, atol=1e-15)
    own = RealMachine(paper(), warming_model(thermometer=""), Temperatures({"strut_3": 24.0, "base": 22.0}))
    assert own.growth[2] == pytest.approx(44e-6)  # its own reading; at rest


def test_stations_driven_together_go_where_each_goes_alone():
    """Four in a row, the middle two alike: to the bit. The third is then told a length that no pose has, and named."""
    temperatures, humidity = np.full((4, 8), 20.0), np.full(4, np.nan)
    temperatures[1:3, 6], temperatures[3, 2] = 23.0, 25.0
    around = Surroundings(temperatures, np.full(4, np.nan), humidity, np.tile(NO_LOAD, (4, 1)))
    machines = around.machines(RealMachine(paper(), warming_model()))
    assert machines[1] is machines[2]
    assert len(set(machines)) == 3
    home = paper().home
    positions = home.position + 1e-3 * np.arange(12.0).reshape(4, 3)
    rotations, senses = np.tile(home.rotation, (4, 1, 1)), np.tile([1.0, -1.0, 1.0], (4, 3))
    commands = strut_lengths_batch(Structure.of(paper()), positions, rotations)
    driven = drive(machines, (positions, rotations), senses, commands).actual
    for n, machine in enumerate(machines):
        alone, _ = machine.pose_for(commands[n], senses[n], Pose(positions[n], rotations[n]))
        assert (driven[0][n] == alone.position).all()
        assert (driven[1][n] == alone.rotation).all()
    commands[2, 0] = 100.0
    with pytest.raises(KinematicsError, match="row 2"):
        drive(machines, (positions, rotations), senses, commands, lambda n: f"row {n}")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("thermometer: base", "thermometer: spindle", ["thermometer", "spindle", "strut_1"]),
        ("time_constants_s: [600.0, 7200.0]", "time_constants_s: [7200.0, 600.0]", ["time_constants", "increasing"]),
        ("time_constants_s: [600.0, 7200.0]", "time_constants_s: [0.6, 7200.0]", ["time_constants", "10…1e"]),
        ("time_constants_s: [600.0, 7200.0]", "time_constants_s: [1, 2, 3]", ["late_struts"]),
        ("late_base_ppm_per_K: [12.0, 13.0]", "late_base_ppm_per_K: [12.0, 1300000]", ["thermal.late", "unit"]),
    ],
)
def test_a_file_in_doubt_is_refused(tmp_path: Path, old: str, new: str, words: list[str]):
    path = tmp_path / "warm.yaml"
    save_model(warming_model(), path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputFileError) as refused:
        load_model(path, paper())
    assert all(word in str(refused.value) for word in words)


def test_a_restart_does_not_know_what_was_before_and_says_for_how_long():
    """Three time constants of the slowest, 7200 s, from the first reading of the thermometer that counts."""
    late_growth, temperatures = warming_model().late_growth, Temperatures()
    temperatures.follow("base", 21.0, math.nan, ())
    with pytest.raises(ModelError, match="time of the temperature of base"):
        temperatures.follow("base", 22.0, math.nan, (600.0,))
    assert temperatures.at("base") == 21.0
    temperatures = Temperatures()
    assert temperatures.unknown_for(late_growth, 1000.0) == 0.0
    temperatures.follow("strut_1", 25.0, 900.0, late_growth.time_constants)
    assert temperatures.unknown_for(late_growth, 1000.0) == 0.0
    temperatures.follow("base", 25.0, 1000.0, late_growth.time_constants)
    assert temperatures.unknown_for(late_growth, 2000.0) == 3 * 7200.0 - 1000.0
    assert temperatures.unknown_for(late_growth, 50_000.0) == 0.0


def test_whatever_acts_on_the_machine_tells_places_apart():
    """One number of a place at a time is another; only what leaves the machine as it is may be merged."""
    swelling = StrutErrors(expansion=np.full(6, 11e-6), moisture=np.full(6, 1e-4))
    load = Load(stiffness=np.full(6, 2e7), mass=20.0)
    bending = RealMachine(paper(), replace(warming_model(), struts=swelling, load=load))
    rigid, growing = (
        RealMachine(paper(), MachineModel("paper", name, base_expansion=expansion))
        for name, expansion in (("rigid", 0.0), ("growing", 11e-6))
    )
    usual = [20.0] * 8 + [0.5] + [3.0, 0.0, 0.0, 0.1] + [0.0, 0.0, -9.81]
    rows = np.tile(usual, (1 + len(usual), 1))
    rows[1 + np.arange(len(usual)), np.arange(len(usual))] += 0.25
    around = Surroundings(rows[:, :8], np.full(len(rows), np.nan), rows[:, 8], rows[:, 9:])
    assert len(set(around.machines(bending))) == len(rows)
    assert len(set(around.machines(growing))) == 9  # no strut gives or swells: temperatures alone
    assert len(set(around.machines(rigid))) == 1
    again = Surroundings(*(np.concatenate([part, part]) for part in vars(around).values()))
    machines = again.machines(bending)
    assert all(a is b for a, b in zip(machines, machines[len(rows) :], strict=False))
