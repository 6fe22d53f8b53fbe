"""The package as pip and colcon install it: built here from a copy of the source, and run from there.

``make test-packaging`` runs these tests, in a step of their own: they build a wheel and a workspace, and type-check.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "hexapod_comp"
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
    """Build the source archive, and the wheel from that archive: what it lacks, the wheel lacks too."""
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
    """Install the wheel by pip alone; return where its modules are."""
    target = tmp_path_factory.mktemp("prefix")
    options = ["--no-deps", "--no-index", "--ignore-installed", "--prefix", str(target)]
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", *options, str(wheel)], check=True)
    return next(target.glob("**/hexapod_comp/__init__.py")).parents[1]


def test_a_client_passes_a_strict_type_check(site_packages: Path, tmp_path: Path):
    """Against what the wheel installs: its types reach whoever imports it, and none of them is unknown."""
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
    assert 'incompatible type "int"' in wrong  # the deliberate fault is seen, and no other
    assert found.startswith("Found 1 error in 1 file")


def test_the_wheel_runs_and_says_what_it_is(wheel: Path, site_packages: Path, tmp_path: Path):
    """The command, its version, its configuration files, its types."""
    environment = os.environ | {"PYTHONPATH": str(site_packages)}
    command = [sys.executable, "-m", "hexapod_comp", "--version"]  # which it reads beside its configuration files
    output = subprocess.check_output(command, env=environment, cwd=tmp_path, text=True, timeout=60)
    assert output == f"hexapod_comp {VERSION}\n"
    assert (site_packages / "hexapod_comp" / "py.typed").is_file()
    assert re.fullmatch(r"hexapod_comp-\d+\.\d+\.\d+-cp310-abi3-linux_\w+\.whl", wheel.name)
    metadata = next(site_packages.glob("hexapod_comp-*.dist-info/METADATA")).read_text(encoding="utf-8")
    assert metadata.count("Classifier: ") >= 8
    assert "make demo" in metadata.partition("\n\n")[2]


def test_the_source_archive_carries_all_that_its_checks_need(wheel: Path):
    """``make test`` and ``make docs`` run in it: everything that git has, but the folders of hosting sites."""
    (archive,) = wheel.parent.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        held = {name.partition("/")[2] for name in opened.getnames()}
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    needed = {name for name in listed.stdout.splitlines() if not name.startswith((".git", "resource/"))}
    assert needed <= held


def test_ros_finds_executables_and_what_is_shared(installed: Path):
    for name in ("compensator", "strut_drive", "mover", "instrument", "adapter", "hexapod_comp"):
        assert os.access(installed / "lib" / "hexapod_comp" / name, os.X_OK), name
    for name in (
        "ament_index/resource_index/packages/hexapod_comp",
        "hexapod_comp/package.xml",
        "hexapod_comp/launch/machine.launch.py",
        "hexapod_comp/config/own/deep.yaml",  # a subfolder, put there by the fixture
    ):
        assert (installed / "share" / name).is_file(), name


def test_a_sourced_workspace_has_the_command(installed: Path, tmp_path: Path):
    """colcon puts it into lib/, where ``ros2 run`` looks; the hook that colcon.pkg names puts that on PATH."""
    prefix = tmp_path / "install"
    prefix.symlink_to(installed.parent)  # colcon's scripts for sh know no spaces
    script = f". {prefix}/local_setup.sh; command -v hexapod_comp; command -v compensator"
    environment = {"PATH": os.environ["PATH"], "COLCON_CURRENT_PREFIX": str(prefix)}
    found = subprocess.check_output(["sh", "-c", script], env=environment, cwd=tmp_path, text=True, timeout=60)
    folder = prefix / "hexapod_comp" / "lib" / "hexapod_comp"
    assert found.split() == [str(folder / name) for name in ("hexapod_comp", "compensator")]


def test_every_module_is_installed(installed: Path):
    package = next(installed.glob("**/hexapod_comp/__init__.py")).parent
    modules = {path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py")}
    assert {path.relative_to(package) for path in package.rglob("*.py")} == modules
    assert (package / "core" / "_core.abi3.so").is_file()


def test_installed_command_runs_and_finds_its_own_config(installed: Path, tmp_path: Path):
    site_packages = next(installed.glob("**/hexapod_comp/__init__.py")).parents[1]
    environment = os.environ | {"PYTHONPATH": str(site_packages)}
    code = "from hexapod_comp.formats.paths import config_file; print(config_file('paper'), config_file('own/deep'))"
    found = subprocess.check_output([sys.executable, "-c", code], env=environment, cwd=tmp_path, text=True)
    share = installed / "share" / "hexapod_comp" / "config"
    assert found.strip() == f"{share / 'paper.yaml'} {share / 'own' / 'deep.yaml'}"
    # Through the interpreter: a first line with a space in its path, as here perhaps, is beyond the kernel.
    command = [sys.executable, installed / "lib" / "hexapod_comp" / "hexapod_comp", "--help"]
    assert subprocess.check_output(command, env=environment, cwd=tmp_path, timeout=60)
