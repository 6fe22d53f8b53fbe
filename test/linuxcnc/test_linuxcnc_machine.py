"""What LinuxCNC's shipped configuration says, and the programs beside the bridge; without LinuxCNC.

Its own behaviour is tested in test_linuxcnc.py. Truth: the geometry file, the paper's Table 2, and machines that
are off as a whole, whose tool error is known without kinematics.
"""

from __future__ import annotations

import configparser
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hal_stand_in import StandInHal
from scipy.spatial.transform import Rotation

from hexapod_comp.linuxcnc.hal import dead_components
from hexapod_comp.linuxcnc.machine import MachineComponent, WatchedMachine, main
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.pose import Pose

CONFIG = Path(__file__).resolve().parents[2] / "config"
LINUXCNC = CONFIG / "linuxcnc"


@pytest.fixture(scope="module")
def geometry() -> HexapodGeometry:
    return load_geometry(CONFIG / "paper.yaml")


@pytest.fixture(scope="module")
def ini() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False)  # HALFILE comes several times
    parser.read(LINUXCNC / "hexapod.inc", encoding="utf-8")
    return parser


# The configuration


def test_genhexkins_has_the_nominal_joints(geometry: HexapodGeometry) -> None:
    """To the picometre that the file's digits give: what is corrected is the difference to nominal lengths."""
    setp = dict(re.findall(r"^setp genhexkins\.(\S+) (\S+)$", (LINUXCNC / "genhexkins.hal").read_text(), re.MULTILINE))
    assert float(setp.pop("screw-lead")) == 0.0
    for body, joints in (("base", geometry.base_joints), ("platform", geometry.platform_joints)):
        told = [[float(setp.pop(f"{body}.{n}.{axis}")) for axis in "xyz"] for n in range(6)]
        np.testing.assert_allclose(told, joints * 1e3, rtol=0.0, atol=1e-9)
    assert not setp


def test_home_is_the_geometrys_home(geometry: HexapodGeometry, ini: configparser.ConfigParser) -> None:
    """Home's lengths are Table 2's first row to its last digit, and the geometry's to the nanometre."""
    legs = geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T - geometry.base_joints
    for n in range(6):
        joint = ini[f"JOINT_{n}"]
        for value in (float(joint["HOME"]), ini["DRIVES"].getfloat(f"PARKED_{n}")):
            assert value == pytest.approx(np.linalg.norm(legs[n]) * 1e3, abs=1e-6)
            assert value == pytest.approx(509.192, abs=0.5e-3)
        assert (joint["HOME_OFFSET"], joint["HOME_ABSOLUTE_ENCODER"]) == ("0", "1")
    position = [float(word) for word in ini["TRAJ"]["HOME"].split()]
    np.testing.assert_allclose(position[:3], geometry.home.position * 1e3)
    assert position[3:] == [0.0, 0.0, 0.0]


def test_limits_are_the_geometrys(geometry: HexapodGeometry, ini: configparser.ConfigParser) -> None:
    """LinuxCNC stops where the compensator would refuse."""
    for n in range(6):
        joint = ini[f"JOINT_{n}"]
        stroke = [float(joint[key]) * 1e-3 for key in ("MIN_LIMIT", "MAX_LIMIT")]
        np.testing.assert_allclose(stroke, geometry.limits.stroke[n])
        assert float(joint["MAX_VELOCITY"]) * 1e-3 == pytest.approx(geometry.limits.speed)
    assert float(ini["HEXAPOD_COMP"]["LIMIT"]) * 1e-3 <= geometry.limits.correction


def test_bridge_and_realtime_chain_have_the_same_limits(ini: configparser.ConfigParser) -> None:
    """One in metres, one in millimetres."""
    section = ini["HEXAPOD_COMP"]
    bridge = dict(re.findall(r"-p (\w+):=(\S+)", section["BRIDGE"]))
    assert float(bridge["limit"]) == pytest.approx(float(section["LIMIT"]) * 1e-3)
    assert float(bridge["ramp_rate"]) == pytest.approx(float(section["RAMP_RATE"]) * 1e-3)
    assert bridge["units"] == ini["TRAJ"]["LINEAR_UNITS"]
    assert bridge["on_loss"] == {"0": "zero", "1": "hold"}[section["HOLD"]]


@pytest.mark.parametrize(("name", "least"), [("hexapod.hal", 20), ("bridge.hal", 2), ("machine.hal", 1)])
def test_struts_are_wired_alike(name: str, least: int) -> None:
    """What is said of strut 1 is said of the others: lines that name one number are there with each of the six."""
    number = re.compile(r"(?<=[._-])[0-5](?=[. ]|-[a-z]|$)")
    other = re.compile("#|loadrt|$|.*(comp-missing.in|iocontrol)")
    lines = [line for line in (LINUXCNC / name).read_text().splitlines() if not other.match(line)]
    named = [(set(number.findall(line)), number.sub("N", line)) for line in lines]
    of_strut = [sorted(line for numbers, line in named if numbers == {f"{n}"}) for n in range(6)]
    assert len(of_strut[0]) >= least
    for wiring in of_strut[1:]:
        assert wiring == of_strut[0]


# The true tool


def lengths(geometry: HexapodGeometry, axes: list[float], tool_length: float = 0.0) -> np.ndarray:
    """Return the strut lengths that genhexkins gives for axes in m and degrees (genhexkins.c), m."""
    turn = Rotation.from_euler("ZYX", axes[5:2:-1], degrees=True).as_matrix()
    up = np.array([0.0, 0.0, tool_length])
    base, platform = geometry.base_joints + up, geometry.platform_joints + up
    return np.linalg.norm(np.array(axes[:3]) + platform @ turn.T - base, axis=1)


TILTED = [0.02, -0.03, 0.42, 6.0, -5.0, 4.0]


@pytest.mark.parametrize("tool_length", [0.0, 0.05])
def test_a_machine_that_is_off_as_a_whole(geometry: HexapodGeometry, tool_length: float) -> None:
    """A moved base takes the tool along; a moved platform joint pattern leaves the tool behind, in its own frame."""
    moved, left = np.array([100e-6, -50e-6, 30e-6]), np.array([20e-6, 40e-6, -60e-6])
    truth = MachineModel("paper", base_deviation=np.tile(moved, (6, 1)), platform_deviation=np.tile(left, (6, 1)))
    command = Pose(TILTED[:3], Rotation.from_euler("xyz", TILTED[3:], degrees=True).as_matrix())
    watched = WatchedMachine(RealMachine(geometry, truth))
    _, error = watched.observe(lengths(geometry, TILTED, tool_length), command, tool_length)
    turn = Rotation.from_euler("ZYX", TILTED[5:2:-1], degrees=True).as_matrix()
    np.testing.assert_allclose(error, moved - turn @ left, atol=1e-9)


def test_pins_are_in_machine_units(geometry: HexapodGeometry) -> None:
    """Inches in, inches out; lengths without a pose only take `valid` away."""
    hal, truth = StandInHal(), MachineModel("paper", base_deviation=np.tile([0.0, 0.0, 127e-6], (6, 1)))
    component = MachineComponent(RealMachine(geometry, truth), "inch", "hexapod_machine", hal)
    component.cycle()
    assert hal["valid"] is False
    for name, value in zip("xyzabc", TILTED, strict=True):
        hal[name] = value / 0.0254 if name in "xyz" else value
    for n, length in enumerate(lengths(geometry, TILTED)):
        hal[f"strut.{n}"] = length / 0.0254
    component.cycle()
    assert hal["valid"] is True
    assert hal["error"] == pytest.approx(0.005, abs=1e-7)  # 127 µm
    assert hal["error-z"] == pytest.approx(0.005, abs=1e-7)
    found = [hal[f"true-{axis}"] for axis in "xyzabc"]
    x, y, z = TILTED[:3]
    wanted = [x / 0.0254, y / 0.0254, (z + 127e-6) / 0.0254, *TILTED[3:]]
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_a_wrong_option_and_a_missing_truth_end_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--rate", "0"])
    assert "--rate" in capsys.readouterr().err
    assert main(["--truth", "nowhere.yaml"]) == 1
    assert "nowhere.yaml" in capsys.readouterr().err


# A dead process's component


def test_only_dead_components_are_found() -> None:
    """The listing is that of halcmd 2.9; the dead process was one a moment ago."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    listing = f"""Loaded HAL Components:
ID      Type  Name                                            PID   State
    88  User  halcmd2327                                       {os.getpid()} ready
    60  User  hexapod_comp                                     {gone.pid} ready
    61  User  hexapod_comp2                                    {gone.pid} ready
    62  User  alive                                            {os.getpid()} ready
    45  RT    hexapod_comp                                             ready
"""
    assert dead_components(listing, "hexapod_comp") == [60]
    assert dead_components(listing, "alive") == []
    assert dead_components(listing, "missing") == []
