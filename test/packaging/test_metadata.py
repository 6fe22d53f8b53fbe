"""The package's metadata, and its dependencies as the source really has them; what is installed: test_installation."""

from __future__ import annotations

import ast
import importlib
import os
import re
import runpy
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from unittest import mock
from xml.etree import ElementTree

import building
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from hexapod_comp.formats.paths import config_file

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "hexapod_comp"

# Import name → key in rosdep's python.yaml and name on PyPI, where the three differ. ROS packages are
# imported under their own name, which is also their key.
PYTHON3 = ("cffi", "hypothesis", "jinja2", "matplotlib", "numpy", "packaging", "pytest", "scipy", "tqdm", "yaml")
ROSDEP_KEYS = {name: f"python3-{name}" for name in PYTHON3}
PYPI_NAMES = {"yaml": "pyyaml"}
# setuptools runs setup.py wherever that is read, mpl_toolkits comes with matplotlib, markupsafe with jinja2, apsw
# and lz4 with rosbags, websockets with viser, hal and linuxcnc with LinuxCNC, benchmarks are the source tree's; the
# others are optional extras, what only `pytest -n` needs, and benchmark tools.
COMING_WITH = {"setuptools", "mpl_toolkits", "markupsafe", "apsw", "lz4", "websockets", "hal", "linuxcnc", "benchmarks"}
EXEMPT = COMING_WITH | {"xdist", "argcomplete", "plotly", "distributed", "rosbags", "mujoco", "pinocchio", "viser"}
WITHOUT_ROS = """
import importlib, sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise ImportError(f"{name} is blocked: the core must not need ROS")

BLOCKED = set(sys.argv[1].split(","))
sys.meta_path.insert(0, Blocker())
for module in sys.argv[2:]:
    importlib.import_module(module)
assert not BLOCKED & set(sys.modules)
"""


VERSIONS = ("3.10", "3.11", "3.12", "3.13", "3.14")


def _environment(version: str) -> dict[str, str]:
    """Return what markers of requirements ask for."""
    return {"python_version": version, "python_full_version": f"{version}.0", "sys_platform": "linux"}


def _pins(path: Path, version: str) -> dict[str, str]:
    """Return the versions that a file of requirements pins for a version of Python, by normalised name."""
    here = _environment(version)
    text = re.sub(r" \\\n +--hash=\S+", "", path.read_text(encoding="utf-8"))
    pins = [Requirement(line) for line in text.splitlines() if line and not line.startswith("#")]
    pins = [pin for pin in pins if pin.marker is None or pin.marker.evaluate(here)]
    assert all([specifier.operator for specifier in pin.specifier] == ["=="] for pin in pins)
    pinned = {canonicalize_name(pin.name): next(iter(pin.specifier)).version for pin in pins}
    assert len(pinned) == len(pins)
    return pinned


@pytest.mark.parametrize("version", VERSIONS)
def test_constraints_pin_all_that_make_installs(version: str, monkeypatch: pytest.MonkeyPatch):
    """One exact version for each requirement, which it satisfies; after a change of setup.py: ``make constraints``.

    Locked files are the constraints with hashes; setuptools, which then builds this package, is there.
    """
    monkeypatch.chdir(ROOT)
    pinned = _pins(ROOT / "constraints.txt", version)
    setup = _setup_arguments()
    wanted = [Requirement(line) for line in (*setup["install_requires"], *setup["extras_require"]["ros"])]
    extras = ("test", "docs", "compiler", "wheel")
    wanted += [Requirement(line) for extra in extras for line in setup["extras_require"][extra]]
    here = _environment(version)
    for requirement in wanted:
        if requirement.marker is not None and not requirement.marker.evaluate(here):
            continue
        assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)]), requirement

    locked = {path.stem: _pins(path, version) for path in sorted((ROOT / "locked").glob("*.txt"))}
    assert set(locked) == {"compiler", "docs", "ros", "test", "wheel"}
    assert {"setuptools", "cffi"} <= set(locked["ros"])
    assert set(locked["compiler"]) == {"ziglang"}
    assert {pin for pins in locked.values() for pin in pins.items()} == set(
        _pins(ROOT / "constraints.txt", version).items()
    )


def test_the_stable_abi_is_what_pythons_own_header_declares(tmp_path: Path):
    """A compiler refuses a function that two headers declare in two ways."""
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        pytest.skip("this Python came without its headers")
    own = ROOT / "hexapod_comp" / "core" / "stable_abi" / "Python.h"
    source = tmp_path / "both.c"
    source.write_text(f'#define Py_LIMITED_API 0x030a0000\n#include <Python.h>\n#include "{own}"\n')
    command = [*building.installed_compiler(), f"-I{sysconfig.get_path('include')}", "-fsyntax-only", str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Take every command away: PATH leads to an empty folder, and no variable names a compiler."""
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))


@pytest.mark.usefixtures("no_compiler")
def test_pip_asks_for_a_compiler_where_none_is(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(building.build_meta, "get_requires_for_build_wheel", lambda settings: ["wheel"])
    assert building.get_requires_for_build_wheel() == ["wheel", "ziglang"]
    monkeypatch.undo()
    assert "ziglang" not in building.compiler_from_pypi()  # this machine's compiler has built the core under test


@pytest.mark.usefixtures("no_compiler")
def test_a_build_without_a_compiler_says_what_to_install(tmp_path: Path):
    """Neither the machine's nor PyPI's: one sentence, and no traceback."""
    words = [sys.executable, "setup.py", "--quiet", "build_ext", "--build-lib", tmp_path, "--build-temp", tmp_path]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("setup.py: no C compiler")
    assert all(word in done.stderr for word in ("apt-get install gcc", "pip install ziglang", "CC="))


# Keys that `rosdep resolve --os ubuntu:noble` knows: from ros/rosdistro, rosdep/base.yaml and rosdep/python.yaml at
# 8468e88 (2026-08-22); and packages of ROS 2 Jazzy, from jazzy/distribution.yaml of the same commit.
PYTHON = "argcomplete cffi colcon-common-extensions hypothesis jinja2 matplotlib mypy numpy packaging pytest "
PYTHON += "pytest-timeout scipy tqdm yaml"
NOBLE = {"g++-static", *(f"python3-{name}" for name in PYTHON.split())}
ROS = "ament_index_python builtin_interfaces diagnostic_msgs geometry_msgs launch launch_ros lifecycle_msgs "
ROS += "rcl_interfaces rclpy rmw_dds_common rosgraph_msgs sensor_msgs std_msgs std_srvs trajectory_msgs"
JAZZY = {*ROS.split(), "visualization_msgs"}


@pytest.mark.filterwarnings("ignore:.*parse_:DeprecationWarning")  # catkin_pkg under a newer pyparsing
def test_every_dependency_is_a_key_of_rosdep_or_a_package_of_jazzy():
    """Read as rosdep, colcon and bloom do, and without conditions: every distribution gets the same."""
    package = importlib.import_module("catkin_pkg.package").parse_package(ROOT / "package.xml")
    named = [*package.buildtool_depends, *package.build_depends, *package.exec_depends, *package.test_depends]
    assert {dependency.name for dependency in named} <= NOBLE | JAZZY
    assert {dependency.condition for dependency in named} == {None}
    assert {dependency.name for dependency in package.build_depends} == {"g++-static", "python3-cffi"}


def _setup_arguments() -> dict:
    """Return what setup.py, run in the current folder, tells setuptools."""
    with mock.patch("setuptools.setup") as setup:
        runpy.run_path("setup.py")
    return setup.call_args.kwargs


def test_a_file_of_the_user_wins_over_a_shipped_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert config_file("paper.yaml") == ROOT / "config" / "paper.yaml"
    (tmp_path / "paper.yaml").write_text("mine: 1\n")
    assert config_file("paper.yaml").resolve() == tmp_path / "paper.yaml"
    monkeypatch.setenv("HOME", str(tmp_path))
    assert config_file("~/paper.yaml") == tmp_path / "paper.yaml"


def test_the_core_imports_without_ros():
    modules = ["hexapod_comp"]
    for path in sorted(PACKAGE.rglob("*.py")):
        dotted = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if path.name != "__init__.py" and path.parent.name not in ("ros", "viewer", "linuxcnc", "testing"):
            modules.append(dotted)
    blocked = ",".join(sorted({"rclpy", "launch", "launch_ros", *_ros_dependencies()}))
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT_ROS, blocked, *modules], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


def test_package_xml_lists_what_the_source_imports():
    listed = _package_xml("exec_depend")
    needed = {_rosdep_key(name) for folder in (PACKAGE, ROOT / "launch") for name in _imports(folder)}
    needed.remove("python3-pytest")  # the test kit runs under pytest, or not at all
    assert needed <= listed
    assert {key for key in listed if key.startswith("python3-")} <= needed


NO_CORE = "import sys; sys.modules['hexapod_comp.core._core'] = None\n"
"""What makes a script find no compiled core."""


def _run_script(script: str, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    words = (sys.executable, "-c", script, *words)
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("program", ["hexapod_comp", "compensator", "mover", "linuxcnc_bridge"])
def test_a_core_that_was_not_built_is_named_in_one_line_that_tells_how(program: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(ROOT)
    lines = [line.split(" = ") for line in _setup_arguments()["entry_points"]["console_scripts"]]
    module, function = dict(lines)[program].split(":")  # started as the script that pip writes does
    script = f"{NO_CORE}from {module} import {function}; sys.exit({function}())"
    words = ("ik", "--pose", "0,0,400") if program == "hexapod_comp" else ()
    run = _run_script(script, *words)
    assert run.returncode in (1, 2)
    assert run.stdout == ""
    line = run.stderr.removesuffix("\n")
    assert "\n" not in line
    assert "hexapod_comp's core does not load" in line
    assert "pip install --editable ." in line


def test_setup_py_agrees_with_the_imports_and_package_xml(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(ROOT)
    metadata = _setup_arguments()
    required = {re.split(r"[^\w.-]", line)[0].lower() for line in metadata["install_requires"]}
    assert required == {PYPI_NAMES.get(name, name) for name in _imports(PACKAGE) - _ros_dependencies() - {"pytest"}}
    package_xml = ElementTree.parse(ROOT / "package.xml")
    for field in ("name", "version", "license", "maintainer"):
        assert package_xml.findtext(field) == metadata[field]


def _ros_dependencies() -> set[str]:
    """Return the dependencies of package.xml that are ROS packages."""
    return {key for key in _package_xml("exec_depend") if not key.startswith("python3-")}


def _package_xml(tag: str) -> set[str]:
    return {element.text or "" for element in ElementTree.parse(ROOT / "package.xml").iter(tag)}


def _rosdep_key(name: str) -> str:
    return ROSDEP_KEYS.get(name, name)


def _imports(folder: Path) -> set[str]:
    """Return the third-party top-level names that the Python files of a folder import, anywhere in them."""
    folders = ("test", "tools")
    own = {"hexapod_comp", "data", "examples", *(path.stem for name in folders for path in (ROOT / name).rglob("*.py"))}
    names = {name for path in folder.rglob("*.py") for name in _imported_names(ast.parse(path.read_bytes()))}
    return names - own - EXEMPT - set(sys.stdlib_module_names)


def _imported_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.partition(".")[0]
