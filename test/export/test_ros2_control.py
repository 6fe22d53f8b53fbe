"""The package for ros2_control: its controller, compiled against stand-ins of ros2_control's headers, and run.

The truth is nominal lengths and commands of the tests' own machines in closed form (foreign_machines), and the geometry
files' limits for the configurations. It has run in the real controller_manager outside these tests, see doc/ros.md.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml
from foreign_machines import Errors, Machine, commands, machines

from hexapod_comp.cli import main
from hexapod_comp.export.control_package import package_name
from hexapod_comp.machine.geometry import STRUT_NAMES

STANDS = Path(__file__).parents[1] / "data" / "ros2_control"
HEADERS = (
    "controller_interface/chainable_controller_interface.hpp",
    "diagnostic_msgs/msg/diagnostic_status.hpp",
    "pluginlib/class_list_macros.hpp",
    "sensor_msgs/msg/temperature.hpp",
)
STRICT = ("-Wall", "-Wextra", "-Wconversion", "-Wno-sign-conversion", "-Werror")


SAME = 1e-9  # m; tolerance of commands, since the core's iterations end below 1e-12 m

PERIOD = 0.004

ERRORS = Errors.drawn(machines()["paper"], 3)  # errors of the paper's machine


def run(*words: str | Path) -> None:
    made = subprocess.run([str(word) for word in words], capture_output=True, text=True)
    assert made.returncode == 0, made.stderr


def exported(machine: Machine, errors: Errors, folder: Path) -> Path:
    """Return the package that is exported for a machine with errors in its model."""
    files = machine.write(folder / "machine.yaml"), errors.write(folder / "model.yaml", machine)
    words = ["--machine", files[0], "--model", files[1], "--ros2-control", folder / "package"]
    assert main(["export", *map(str, words)]) == 0
    return folder / "package"


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile core, controller, which differs between machines only in its namespace, and the loop around it."""
    if not (shutil.which("gcc") and shutil.which("g++")):
        pytest.skip("no gcc and g++ here")
    folder = tmp_path_factory.mktemp("controller")
    for name in HEADERS:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text('#include "stubs.hpp"\n')
    package = exported(machines()["paper"], ERRORS, folder)
    (folder / "both.cpp").write_text('#include "compensation.cpp"\n#include "loop.cpp"\n')  # compiles in half the time
    include = [f"-I{place}" for place in (package, folder, STANDS)]
    run("g++", "-std=c++17", *STRICT, *include, "-c", folder / "both.cpp", "-o", folder / "both.o")
    run("gcc", "-std=c99", "-I", package, "-c", package / "core" / "hexapod_comp.c", "-o", folder / "core.o")
    return folder


class Loop:
    """The life of one controller: its inputs, and its answer to each."""

    def __init__(self, program: Path) -> None:
        self.program = program
        self.lines: list[str] = []
        self.time = 1.7e9

    def activate(self, measured: np.ndarray) -> None:
        self.lines.append("a " + numbers(measured))

    def cycle(self, measured: np.ndarray, references: np.ndarray) -> None:
        self.time += PERIOD
        self.lines.append(f"u {self.time:.9f} {numbers(measured)} {numbers(references)}")

    def say(self, line: str) -> None:
        self.lines.append(line)

    def run(self) -> list[str]:
        """Run the program; return the answers to all inputs (of a cycle: commands and exported states, 12 lengths)."""
        ran = subprocess.run([self.program], input="\n".join(self.lines) + "\n", capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        self.errors = ran.stderr
        first, *answers = ran.stdout.splitlines()
        assert first.split() == ["1", *(f"compensation/{name}/position" for name in STRUT_NAMES)]
        assert len(answers) == len(self.lines)
        return answers


def linked(objects: Path, package: Path) -> Path:
    """Link the program of one machine; return its path."""
    run("gcc", "-std=c99", "-I", package, "-c", package / "machine.c", "-o", package / "machine.o")
    run("g++", objects / "both.o", objects / "core.o", package / "machine.o", "-o", package / "loop")
    return package / "loop"


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def lengths(answer: str) -> tuple[np.ndarray, np.ndarray]:
    values = np.array(answer.split(), dtype=float)
    return values[:6], values[6:]


NONE = np.full(6, np.nan)


@pytest.fixture(scope="module")
def papers(objects: Path) -> Path:
    """Link the program of the paper's machine with the errors that ``objects`` has."""
    return linked(objects, objects / "package")


@pytest.fixture
def made(papers: Path) -> tuple[Loop, np.ndarray, np.ndarray]:
    """Return a loop of the paper's machine, and its commands and nominal lengths at home."""
    machine = machines()["paper"]
    at_home = np.array([machine.home]), np.eye(3)[None]
    return Loop(papers), commands(machine, ERRORS, *at_home)[0], machine.lengths(*at_home)[0]


def test_nominal_lengths_become_commands(objects: Path, tmp_path: Path) -> None:
    """Over a way of 1 mm and back, commands and exported nominal lengths are the closed forms.

    Before the first references the controller exports the nominal lengths of the measured struts, and moves nothing."""
    machine = machines()["hanging"]
    errors = Errors.drawn(machine, 5)
    loop = Loop(linked(objects, exported(machine, errors, tmp_path)))
    way = 1e-3 * np.sin(np.linspace(0.0, np.pi, 200))[:, None] * [1.0, -0.5, 0.3]
    tips = machine.middle + way
    rotations = np.tile(machine.level(), (len(tips), 1, 1))
    poses = machine.platforms(tips), rotations
    nominal, told = machine.lengths(*poses), commands(machine, errors, *poses)
    assert np.abs(told - nominal).max() > 20e-6
    loop.activate(told[0])
    loop.cycle(told[0], NONE)  # no references: another controller is active
    for k in range(200):
        loop.cycle(told[k], nominal[k])
    loop.say("s")
    activated, waiting, *cycles, status = loop.run()
    assert activated == "0"
    np.testing.assert_array_equal(lengths(waiting)[0], told[0])
    np.testing.assert_allclose(lengths(waiting)[1], nominal[0], rtol=0, atol=SAME)
    for k, answer in enumerate(cycles):
        np.testing.assert_allclose(lengths(answer)[0], told[k], rtol=0, atol=SAME)
        np.testing.assert_allclose(lengths(answer)[1], nominal[k], rtol=0, atol=SAME)
    assert status.startswith("0 compensating|model=truth|compensation=on|commands=200|")
    assert "refused" not in status


def test_a_jump_is_refused_and_the_struts_are_held(made: tuple[Loop, np.ndarray, np.ndarray]) -> None:
    loop, told, nominal = made
    loop.activate(told)
    loop.cycle(told, nominal)
    loop.cycle(told, nominal + 0.005)
    loop.say("s")
    loop.cycle(told, nominal)
    loop.say("s")
    _, _, jump, refused, _, again = loop.run()
    np.testing.assert_allclose(lengths(jump)[0], told, rtol=0, atol=SAME)
    assert refused.startswith("2 refused: step|")
    assert "|refused_step=1|" in refused
    assert again.startswith("0 compensating|")


def test_struts_that_are_elsewhere_or_stand_still_stop_it(made: tuple[Loop, np.ndarray, np.ndarray]) -> None:
    """A following error of 2.1 mm, or readings that do not change, stop the struts until the next activation."""
    loop, told, nominal = made
    loop.activate(told)
    loop.cycle(told + 0.0019, nominal)
    loop.cycle(told + 0.0021, nominal)
    loop.cycle(told, nominal + 0.0001)
    loop.say("s")
    loop.activate(told)
    for k in range(60):  # 0.6 mm in 0.24 s, with readings that do not change
        loop.cycle(told, nominal + 1e-5 * k)
    loop.say("s")
    _, near, off, back, following, activated, *cycles, stale = loop.run()
    for answer in (near, off, back):
        np.testing.assert_allclose(lengths(answer)[0], told, rtol=0, atol=SAME)
    assert following.startswith("2 following_error: ")
    assert activated == "0"
    assert stale.startswith("2 stale: ")
    held = lengths(cycles[-1])[0] - told
    assert 0.0002 <= held.max() <= 0.0003
    np.testing.assert_array_equal(lengths(cycles[-2])[0], lengths(cycles[-1])[0])


def test_without_readings_or_references_the_struts_are_held(made: tuple[Loop, np.ndarray, np.ndarray]) -> None:
    loop, told, nominal = made
    loop.activate(NONE)
    loop.activate(told)
    loop.cycle(told, nominal)
    loop.cycle(NONE, nominal + 0.0001)
    loop.say("s")
    loop.cycle(told, NONE)
    loop.say("s")
    nowhere, _, _, blind, no_feedback, idle, waiting = loop.run()
    assert nowhere == "2"
    assert "cannot start at the measured struts: not_finite" in loop.errors
    for answer in (blind, idle):
        np.testing.assert_allclose(lengths(answer)[0], told, rtol=0, atol=SAME)
    assert no_feedback.startswith("2 no feedback")
    assert waiting.startswith("1 no references|")


def test_compensation_is_switched_off_while_it_runs(made: tuple[Loop, np.ndarray, np.ndarray]) -> None:
    """Switched off, the compensation ramps out at 1 mm/s, 4 µm per cycle; a temperature of 900 °C is refused."""
    loop, told, nominal = made
    loop.activate(told)
    loop.cycle(told, nominal)
    loop.say("e 0")
    for _ in range(60):
        loop.cycle(told, nominal)
    loop.say("t strut_2 900")
    loop.cycle(told, nominal)
    loop.say("s")
    _, on, _, *cycles, _, off, status = loop.run()
    np.testing.assert_allclose(lengths(on)[0], told, rtol=0, atol=SAME)
    assert 0.0 < np.abs(lengths(cycles[0])[0] - told).max() < 4.1e-6
    np.testing.assert_allclose(lengths(off)[0], nominal, rtol=0, atol=SAME)
    assert "|compensation=off|" in status
    assert "|bad_temperatures=1|" in status


# ---- the configurations ----


def test_configurations_fit_the_machine(tmp_path: Path) -> None:
    """A path tolerance of a step or more would let a goal continue until its own end is refused."""
    name = "example_6_6"
    names = [f"axis{n}/leg" for n in range(6)]
    words = ["--machine", name, "--ros2-control", str(tmp_path), "--rate", "100", "--joint-names", ",".join(names)]
    assert main(["export", *words]) == 0
    # The machine's step is 1.5 mm; drives are 20 ms late, and by the rate 10 ms: 0.75 · 1.5 mm / 30 ms = 37.5 mm/s
    assert "lag by this distance at 37.5 mm/s: plan slower" in (tmp_path / "config" / "below.yaml").read_text()
    files = {path.stem: yaml.safe_load(path.read_text()) for path in (tmp_path / "config").iterdir()}
    assert set(files) == {"within", "below", "before"}
    for stem, content in files.items():
        manager = content["controller_manager"]["ros__parameters"]
        assert manager["update_rate"] == 100
        started = {key for key, value in manager.items() if isinstance(value, dict)}
        assert set(content) - {"controller_manager", "/**/compensator"} <= started
        joints = [f"compensation/{joint}" for joint in names] if stem == "within" else names
        for part in ("joint_trajectory_controller", "forward_command_controller"):
            if part in content:
                assert content[part]["ros__parameters"]["joints"] == joints
        if stem != "within":
            assert content["/**/compensator"]["ros__parameters"]["joint_names"] == names
        if planner := content.get("joint_trajectory_controller"):
            limits = planner["ros__parameters"]["constraints"]
            assert {limits[joint]["trajectory"] for joint in joints} == {0.001125}
    assert files["within"]["compensation"]["ros__parameters"]["joints"] == names
    robot = ET.parse(tmp_path / "urdf" / "machine.urdf").getroot()
    assert [joint.get("name") for joint in robot.find("ros2_control").findall("joint")] == names


def test_the_package_is_named_after_the_machine(tmp_path: Path) -> None:
    assert package_name("Große Hexe 2") == "gro_e_hexe_2_compensation"
    assert package_name("6-6") == "machine_6_6_compensation"
    assert package_name("H6") == "h6_compensation"
    assert main(["export", "--machine", "example_6_6", "--ros2-control", str(tmp_path)]) == 0
    texts = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir() if path.is_file()}
    assert not re.search(r"@\w+@", "".join(texts.values()))
    manifest, plugins = (ET.fromstring(texts[name]) for name in ("package.xml", "plugins.xml"))
    assert manifest.findtext("name") == plugins.get("path") == "example_6_6_compensation"
    kind = plugins.find("class").get("name")
    assert kind == "example_6_6_compensation/Compensation"
    within = yaml.safe_load((tmp_path / "config" / "within.yaml").read_text())
    assert within["controller_manager"]["ros__parameters"]["compensation"]["type"] == kind
    packages = {element.text for element in manifest.findall("depend")}
    assert packages == set(re.search(r"set\(DEPENDENCIES ([\w ]+)\)", texts["CMakeLists.txt"])[1].split())
    used = set(re.findall(r'#include "(\w+)/\w+(?:/\w+)?\.hpp"', texts["compensation.cpp"]))
    assert used <= packages
