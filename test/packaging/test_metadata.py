"""The package's metadata and dependencies compared with the source, and the package as pip and colcon install it.

``make test-packaging`` runs these tests separately, since they build a wheel and a workspace, and type-check.
"""

from __future__ import annotations

import ast
import importlib
import os
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig
import tarfile
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

# Import name → key in rosdep's python.yaml and name on PyPI, if the three differ. ROS packages have the same name for
# import and as a key.
PYTHON3 = ("cffi", "hypothesis", "jinja2", "matplotlib", "numpy", "packaging", "pytest", "scipy", "tqdm", "yaml")
ROSDEP_KEYS = {name: f"python3-{name}" for name in PYTHON3}
PYPI_NAMES = {"yaml": "pyyaml"}
# Not dependencies: setuptools, which runs setup.py; packages that come with another one (mpl_toolkits: matplotlib,
# markupsafe: jinja2, apsw and lz4: rosbags, websockets: viser, hal and linuxcnc: LinuxCNC); benchmarks, part of the
# source tree; optional extras, `pytest -n` and benchmark tools.
COMING_WITH = {"setuptools", "mpl_toolkits", "markupsafe", "apsw", "lz4", "websockets", "hal", "linuxcnc", "benchmarks"}
EXEMPT = COMING_WITH | {"xdist", "argcomplete", "plotly", "distributed", "rosbags", "mujoco", "pinocchio", "viser"}


def _pins(path: Path, here: dict[str, str]) -> dict[str, str]:
    """Return the versions that a requirements file pins for a version of Python, by normalised name."""
    text = re.sub(r" \\\n +--hash=\S+", "", path.read_text(encoding="utf-8"))
    pins = [Requirement(line) for line in text.splitlines() if line and not line.startswith("#")]
    pins = [pin for pin in pins if pin.marker is None or pin.marker.evaluate(here)]
    assert all([specifier.operator for specifier in pin.specifier] == ["=="] for pin in pins)
    pinned = {canonicalize_name(pin.name): next(iter(pin.specifier)).version for pin in pins}
    assert len(pinned) == len(pins)
    return pinned


@pytest.mark.parametrize("version", ["3.10", "3.14"])
def test_constraints_pin_all_that_make_installs(version: str, monkeypatch: pytest.MonkeyPatch):
    """Each requirement has one exact version that satisfies it; after a change of setup.py: ``make constraints``.

    The locked files are the constraints with hashes, and contain setuptools, which builds this package.
    """
    monkeypatch.chdir(ROOT)
    here = {"python_version": version, "python_full_version": f"{version}.0", "sys_platform": "linux"}
    pinned = _pins(ROOT / "constraints.txt", here)
    setup = _setup_arguments()
    extras = ("ros", "test", "docs", "compiler", "wheel")
    lines = [*setup["install_requires"], *(line for extra in extras for line in setup["extras_require"][extra])]
    for requirement in map(Requirement, lines):
        if requirement.marker is None or requirement.marker.evaluate(here):
            assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)]), requirement

    locked = {path.stem: _pins(path, here) for path in sorted((ROOT / "locked").glob("*.txt"))}
    assert set(locked) == set(extras)
    assert {"setuptools", "cffi"} <= set(locked["ros"])
    assert set(locked["compiler"]) == {"ziglang"}
    assert {pin for pins in locked.values() for pin in pins.items()} == set(pinned.items())


def test_the_stable_abi_is_what_pythons_own_header_declares(tmp_path: Path):
    """A compiler refuses a function that two headers declare differently."""
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        pytest.skip("this Python came without its headers")
    own = ROOT / "hexapod_comp" / "core" / "stable_abi" / "Python.h"
    source = tmp_path / "both.c"
    source.write_text(f'#define Py_LIMITED_API 0x030a0000\n#include <Python.h>\n#include "{own}"\n')
    command = [*building.installed_compiler(), f"-I{sysconfig.get_path('include')}", "-fsyntax-only", str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_pip_asks_for_a_compiler_where_none_is_and_setup_py_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Without any compiler pip asks for ``ziglang``, and setup.py without it prints what to install."""
    assert "ziglang" not in building.compiler_from_pypi()  # this machine's compiler has built the core under test
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(building.build_meta, "get_requires_for_build_wheel", lambda settings: ["wheel"])
    assert building.get_requires_for_build_wheel() == ["wheel", "ziglang"]
    words = [sys.executable, "setup.py", "--quiet", "build_ext", "--build-lib", tmp_path, "--build-temp", tmp_path]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("setup.py: no C compiler")
    assert all(word in done.stderr for word in ("apt-get install gcc", "pip install ziglang", "CC="))


# Keys that `rosdep resolve --os ubuntu:noble` knows, from ros/rosdistro, rosdep/base.yaml and rosdep/python.yaml at
# 8468e88 (2026-08-22), and packages of ROS 2 Jazzy, from jazzy/distribution.yaml of the same commit
PYTHON = "argcomplete cffi colcon-common-extensions hypothesis jinja2 matplotlib mypy numpy packaging pytest "
PYTHON += "pytest-timeout scipy tqdm yaml"
NOBLE = {"g++-static", *(f"python3-{name}" for name in PYTHON.split())}
ROS = "ament_index_python builtin_interfaces diagnostic_msgs geometry_msgs launch launch_ros lifecycle_msgs "
ROS += "rcl_interfaces rclpy rmw_dds_common rosgraph_msgs sensor_msgs std_msgs std_srvs trajectory_msgs"
JAZZY = {*ROS.split(), "visualization_msgs"}


@pytest.mark.filterwarnings("ignore:.*parse_:DeprecationWarning")  # catkin_pkg with a newer pyparsing
def test_every_dependency_is_a_key_of_rosdep_or_a_package_of_jazzy():
    """Dependencies are read as rosdep, colcon and bloom read them, and have no conditions."""
    package = importlib.import_module("catkin_pkg.package").parse_package(ROOT / "package.xml")
    named = [*package.buildtool_depends, *package.build_depends, *package.exec_depends, *package.test_depends]
    assert {dependency.name for dependency in named} <= NOBLE | JAZZY
    assert {dependency.condition for dependency in named} == {None}
    assert {dependency.name for dependency in package.build_depends} == {"g++-static", "python3-cffi"}


def _setup_arguments() -> dict:
    """Return the arguments of setup() when setup.py runs in the current folder."""
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


def test_package_xml_lists_what_the_source_imports():
    listed = _package_xml("exec_depend")
    needed = {ROSDEP_KEYS.get(name, name) for folder in (PACKAGE, ROOT / "launch") for name in _imports(folder)}
    needed.remove("python3-pytest")  # the test kit runs only under pytest
    assert needed <= listed
    assert {key for key in listed if key.startswith("python3-")} <= needed


@pytest.mark.parametrize("program", ["hexapod_comp", "compensator"])
def test_a_core_that_was_not_built_is_named_in_one_line_that_tells_how(program: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(ROOT)
    lines = [line.split(" = ") for line in _setup_arguments()["entry_points"]["console_scripts"]]
    module, function = dict(lines)[program].split(":")  # started like pip's script
    script = "import sys; sys.modules['hexapod_comp.core._core'] = None\n"  # so that the compiled core is not found
    script += f"from {module} import {function}; sys.exit({function}())"
    words = ["ik", "--pose", "0,0,400"] if program == "hexapod_comp" else []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    run = subprocess.run([sys.executable, "-c", script, *words], env=environment, capture_output=True, text=True)
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


def _imports(folder: Path) -> set[str]:
    """Return the third-party top-level names that the Python files of a folder import anywhere."""
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


FOLDERS = ("hexapod_comp", "config", "environment", "launch", "resource", "tools")
MADE = ("__pycache__", ".hypothesis", "out", "*.egg-info", "build", "dist", "install", "log", "*.so")
FILES = ("package.xml", "colcon.pkg", "setup.py", "setup.cfg", "pyproject.toml", "LICENSE", "README.md")
VERSION = ElementTree.parse(ROOT / "package.xml").findtext("version")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a copy of the source with colcon; return the prefix of the installation."""
    workspace = tmp_path_factory.mktemp("colcon workspace")
    source = workspace / "src" / "hexapod_comp"
    source.mkdir(parents=True)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns(*MADE))
    for name in FILES:
        shutil.copy2(ROOT / name, source / name)
    (source / "config" / "own").mkdir(exist_ok=True)
    (source / "config" / "own" / "deep.yaml").write_text("deep: 1\n")
    command = [sys.executable, "-m", "colcon", "--log-base", "log", "build", "--paths", "src/hexapod_comp"]
    run = subprocess.run(command, cwd=workspace, capture_output=True, text=True, timeout=100, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    return workspace / "install" / "hexapod_comp"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the source archive, and from it the wheel, so that a file missing in the archive is missing in both."""
    folder = tmp_path_factory.mktemp("archives")
    source = folder / "checkout"
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(".git*", ".venv*", ".*_cache", *MADE))
    python, quiet = sys.executable, {"capture_output": True, "check": True}
    subprocess.run([python, "setup.py", "-q", "sdist", "--dist-dir", str(folder)], cwd=source, **quiet)
    (archive,) = folder.glob("*.tar.gz")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([python, "-m", "pip", "wheel", *options, str(archive)], **quiet)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def site_packages(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel by pip alone; return the folder of its modules."""
    target = tmp_path_factory.mktemp("prefix")
    options = ["--no-deps", "--no-index", "--ignore-installed", "--prefix", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", *options, str(wheel)], check=True)
    return next(target.glob("**/hexapod_comp/__init__.py")).parents[1]


def test_a_client_passes_a_strict_type_check(site_packages: Path, tmp_path: Path):
    """The types of the wheel reach a client's type check, and none of them is unknown."""
    client = tmp_path / "client.py"
    shutil.copy2(ROOT / "test" / "data" / "client.py", client)
    with client.open("a", encoding="utf-8") as stream:
        stream.write("\n\nreveal_type(hc.load_geometry)\nhc.load_geometry(3)\n")
    options = ["--strict", "--config-file", os.devnull, "--cache-dir", str(ROOT / ".mypy_cache" / "client")]
    command = [sys.executable, "-m", "mypy", *options, client.name]
    environment = os.environ | {"PYTHONPATH": str(site_packages)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    revealed, wrong, found = done.stdout.strip().splitlines()
    assert "HexapodGeometry" in revealed
    assert 'incompatible type "int"' in wrong  # the only error is the deliberate one
    assert found.startswith("Found 1 error in 1 file")


def test_the_wheel_runs_and_says_what_it_is(wheel: Path, site_packages: Path, tmp_path: Path):
    """Command, version, configuration files and types are in the wheel."""
    environment = os.environ | {"PYTHONPATH": str(site_packages)}
    command = [sys.executable, "-m", "hexapod_comp", "--version"]  # the version is read beside the configuration files
    output = subprocess.check_output(command, env=environment, cwd=tmp_path, text=True, timeout=60)
    assert output == f"hexapod_comp {VERSION}\n"
    assert (site_packages / "hexapod_comp" / "py.typed").is_file()
    assert re.fullmatch(r"hexapod_comp-\d+\.\d+\.\d+-cp310-abi3-linux_\w+\.whl", wheel.name)
    metadata = next(site_packages.glob("hexapod_comp-*.dist-info/METADATA")).read_text(encoding="utf-8")
    assert metadata.count("Classifier: ") >= 8
    assert "make demo" in metadata.partition("\n\n")[2]


def test_the_source_archive_carries_all_that_its_checks_need(wheel: Path):
    """``make test`` and ``make docs`` run in it: it has every file of git except folders of hosting sites."""
    (archive,) = wheel.parent.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        held = {name.partition("/")[2] for name in opened.getnames()}
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    needed = {name for name in listed.stdout.splitlines() if not name.startswith((".git", "resource/"))}
    assert needed <= held


def test_every_module_is_installed_and_ros_finds_executables_and_what_is_shared(installed: Path):
    package = next(installed.glob("**/hexapod_comp/__init__.py")).parent
    modules = {path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py")}
    assert {path.relative_to(package) for path in package.rglob("*.py")} == modules
    assert (package / "core" / "_core.abi3.so").is_file()
    for name in ("compensator", "strut_drive", "mover", "instrument", "adapter", "hexapod_comp"):
        assert os.access(installed / "lib" / "hexapod_comp" / name, os.X_OK), name
    for name in (
        "ament_index/resource_index/packages/hexapod_comp",
        "hexapod_comp/package.xml",
        "hexapod_comp/launch/machine.launch.py",
        "hexapod_comp/config/own/deep.yaml",  # the fixture adds this subfolder
    ):
        assert (installed / "share" / name).is_file(), name


def test_a_sourced_workspace_has_the_command_which_finds_its_own_config(installed: Path, tmp_path: Path):
    """colcon installs it into lib/, where ``ros2 run`` looks; the hook of colcon.pkg adds lib/ to PATH."""
    prefix = tmp_path / "install"
    prefix.symlink_to(installed.parent)  # colcon's scripts for sh do not support spaces
    script = f". {prefix}/local_setup.sh; command -v hexapod_comp; command -v compensator"
    environment = {"PATH": os.environ["PATH"], "COLCON_CURRENT_PREFIX": str(prefix)}
    found = subprocess.check_output(["sh", "-c", script], env=environment, cwd=tmp_path, text=True, timeout=60)
    folder = prefix / "hexapod_comp" / "lib" / "hexapod_comp"
    assert found.split() == [str(folder / name) for name in ("hexapod_comp", "compensator")]
    environment = os.environ | {"PYTHONPATH": str(next(installed.glob("**/hexapod_comp/__init__.py")).parents[1])}
    code = "from hexapod_comp.formats.paths import config_file; print(config_file('paper'), config_file('own/deep'))"
    found = subprocess.check_output([sys.executable, "-c", code], env=environment, cwd=tmp_path, text=True)
    share = installed / "share" / "hexapod_comp" / "config"
    assert found.strip() == f"{share / 'paper.yaml'} {share / 'own' / 'deep.yaml'}"
    # Through the interpreter, since the kernel refuses a first line whose path has a space, as this one may.
    command = [sys.executable, installed / "lib" / "hexapod_comp" / "hexapod_comp", "--help"]
    assert subprocess.check_output(command, env=environment, cwd=tmp_path, timeout=60)
