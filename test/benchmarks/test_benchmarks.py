"""Benchmarks that lack a program or data report it and exit with 2; long benchmarks are run for a short time."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import long_test

from benchmarks import rubin
from benchmarks.genhexkins import Genhexkins, NotHere, emc_poses, si_poses
from benchmarks.kinematics import make_poses
from benchmarks.network import refusal
from benchmarks.soak import soak

ROOT = Path(__file__).resolve().parents[2]


def test_rubins_tables_are_fetched_by_who_runs_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """``benchmarks.rubin`` exits with 2 without the observatory's tables, and checks tables of their form."""
    assert rubin.main([str(tmp_path)]) == 2
    assert f"cannot run: {tmp_path}/fitter/zd_m2.txt" in capsys.readouterr().err
    angles = np.arange(90.0, -1.0, -22.5)
    rows = np.outer(np.cos(np.radians(angles)), [1.0, 400.0, -300.0, 0.01, 1e-6, 1e-5])
    (tmp_path / "fitter").mkdir()
    for file in rubin.TABLES.values():
        np.savetxt(tmp_path / file, np.column_stack([angles, rows]), header="Camera")
    assert rubin.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("PASSED") == 2


@long_test
def test_benchmarks_use_what_the_package_has():
    """No test runs a benchmark whole, so mypy looks for functions and arguments that have been renamed or removed."""
    done = subprocess.run([sys.executable, "-m", "mypy", "benchmarks"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


# ---- benchmarks.network: two network name spaces, joined by a simulated cable ----


@long_test
def test_two_hosts_and_a_cable_that_is_cut():
    """A cut cable is reported, and no limit is broken; the benchmark's own targets for times are not checked here."""
    why_not = refusal()
    if why_not:
        pytest.skip(f"no network namespaces here: {why_not}")
    command = [sys.executable, "-m", "benchmarks.network", "--rounds", "1", "--only", "cut,delay", "--seconds", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    rows = {line.split()[0]: line.split() for line in done.stdout.splitlines()[-2:]}
    assert rows.keys() == {"cut", "delay"}, done.stdout + done.stderr
    assert float(rows["cut"][3]) < 2000.0, "the loss of feedback is said"
    for row in rows.values():
        assert row[-1] == "0", "no breach"


# ---- soak: latency is not checked, since on a shared machine other jobs determine it ----


SECONDS = 5.0


@long_test
def test_five_seconds_at_1_khz():
    found = soak(SECONDS, 1000.0)
    counted = sum(int(found.diagnostics["compensator"][name]) for name in ("commands_missed", "refused"))
    assert len(found.latencies) > 100.0 * SECONDS, "a machine too busy for 100 Hz shows nothing"
    assert found.lost <= counted
    assert len(found.beats) > 10.0 * SECONDS  # 50 beats a second are published
    memory = np.array(found.memory)[:, 1:]
    assert (memory[-1] - memory[len(memory) // 2]).max() < 1e6, "an hour of that would be more than 1.4 GB"


# ---- mutants ----


@pytest.mark.parametrize(
    ("line", "changed"),
    [("return False", ["return True"]), ("x.reshape(-1, 3)", []), ("x[-1]", ["x[+1]", "x[-2]"])],
)
def test_no_mutant_is_made_that_changes_nothing(line: str, changed: list[str]):
    mutants = pytest.importorskip("benchmarks.mutants", reason="no coverage.py (pytest-cov)")
    tree = ast.parse(line)
    found = [mutants.mutated(tree, one) for one in mutants.mutants(tree.body[0])]
    assert found == changed


# ---- LinuxCNC's own compiled kinematics ----


@pytest.fixture
def genhexkins():
    try:
        return Genhexkins(make_poses(1).structure)
    except NotHere as reason:
        pytest.skip(str(reason))


def test_lengths_are_linuxcncs(genhexkins):
    """genhexkins' lengths equal ours; each sums about ten products of lengths up to 1 m, with 1e-15 m of rounding."""
    poses = make_poses(200)
    lengths, codes = np.empty((200, 6)), np.empty(200, np.int32)
    genhexkins.inverse(emc_poses(poses.positions, poses.rotations), lengths, codes)
    assert not codes.any()
    np.testing.assert_allclose(lengths * 1e-3, poses.lengths, rtol=0.0, atol=1e-14)


def test_poses_are_linuxcncs(genhexkins):
    """genhexkins' poses equal ours; its iteration ends when the struts are within 1e-12 m."""
    poses = make_poses(200, 1e-3, 1.0)
    home = emc_poses(poses.home.position[None], poses.home.rotation[None])
    codes, found = genhexkins.solved(poses.lengths, np.repeat(home, 200, axis=0))
    assert not codes.any()
    positions, rotations = si_poses(found)
    np.testing.assert_allclose(positions, poses.positions, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(rotations, poses.rotations, rtol=0.0, atol=1e-10)
