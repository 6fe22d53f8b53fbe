"""Effects of single errors against loop closures solved by SciPy and v. Daake et al.'s iteration; surveys in parts.

In this process, in several, and on a cluster the numbers are the same to the last bit.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields, replace
from itertools import pairwise
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from calibration_helpers import framed, paper
from helpers import general_machine, poses_about
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hexapod_comp.errors import HexapodError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine import kinematics
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.workspace import study as runner
from hexapod_comp.workspace.budget import BASE_JOINT, LENGTH, PLATFORM_JOINT, TOOL, Budget, SingleErrors, load_budget
from hexapod_comp.workspace.effects import EXACT, LINEAR, Extremes, effect_vectors, effects, extremes, merged
from hexapod_comp.workspace.reach import Reach, orientations, poses_at, reach
from hexapod_comp.workspace.study import survey

SIZES = {
    "strut_length": 20e-6,
    "screw_pitch_slope": 2e-4,
    "base_joint_xy": 10e-6,
    "base_joint_z": 10e-6,
    "platform_joint_xy": 10e-6,
    "platform_joint_z": 10e-6,
    "thermal_growth": 3e-5,
    "tool_offset": 10e-6,
}


def every_error(geometry: HexapodGeometry, sizes: dict[str, float] | None = None) -> SingleErrors:
    return Budget(geometry.name, sizes or SIZES).single_errors(geometry)


def by_least_squares(
    geometry: HexapodGeometry, errors: SingleErrors, e: int, p: np.ndarray, r: np.ndarray
) -> np.ndarray:
    """Return the effect of one error from the loop closures alone, solved by SciPy with finite differences."""
    base, platform = geometry.base_joints.copy(), geometry.platform_joints.copy()
    tool, i, v = geometry.tool.position.copy(), errors.struts[e], errors.vector[e]

    def lengths(b: np.ndarray, t: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        return np.array([np.linalg.norm(position + rotation @ t[k] - b[k]) for k in range(6)])

    wanted = lengths(base, platform, p, r)
    home = lengths(base, platform, geometry.home.position, geometry.home.rotation)
    if errors.part[e] == LENGTH:
        wanted[i] += v[0] + v[1] * (wanted[i] - home[i]) + v[2] * wanted[i]
    target = {BASE_JOINT: base, PLATFORM_JOINT: platform}.get(int(errors.part[e]))
    if target is not None:
        target[i] += v
    elif errors.part[e] == TOOL:
        tool += v

    def misfit(x: np.ndarray) -> np.ndarray:
        x = 1e-3 * x  # so that steps of the differences fit the result's size
        now = lengths(base, platform, p + x[:3], Rotation.from_rotvec(x[3:]).as_matrix() @ r)
        return 1e3 * (now - wanted)

    solved = 1e-3 * least_squares(misfit, np.zeros(6), jac="3-point", xtol=3e-16, ftol=3e-16, gtol=3e-16).x
    actual = Rotation.from_rotvec(solved[3:]).as_matrix() @ r
    tip = p + solved[:3] + actual @ tool - (p + r @ geometry.tool.position)
    return np.concatenate([geometry.work.rotation.T @ tip, geometry.work.rotation.T @ solved[3:]])


@pytest.mark.parametrize("make", [paper, general_machine], ids=["paper", "general"])
def test_exact_effects_solve_the_loop_closures(make):
    # SciPy's loop closures subtract lengths of about a metre: 1e-16 times gains of about ten
    geometry = framed(make())
    errors = every_error(geometry)
    positions, rotations = poses_about(geometry.home, 1, seed=1, reach=0.04, tilt_deg=15.0)
    found = effect_vectors(geometry, errors, positions, rotations)
    for e in range(len(errors)):
        truth = by_least_squares(geometry, errors, e, positions[0], rotations[0])
        np.testing.assert_allclose(found[0, e], truth, rtol=0.0, atol=2e-14, err_msg=errors.labels[e])


def test_linear_effects_are_the_limit_of_exact_ones():
    # The remaining difference is of second order: it falls by four when the errors are halved
    geometry = framed(general_machine())
    errors = every_error(geometry, {name: 1e-3 if name != "thermal_growth" else 1e-4 for name in SIZES})
    positions, rotations = poses_about(geometry.home, 4, seed=4, tilt_deg=15.0)
    misses = []
    for factor in (1.0, 0.5):
        some = replace(errors, vector=factor * errors.vector)
        exact, linear = (effect_vectors(geometry, some, positions, rotations, m) for m in ("exact", "linear"))
        misses.append(np.linalg.norm((exact - linear).reshape(-1)))
    assert misses[0] / misses[1] == pytest.approx(4.0, rel=0.01)
    assert misses[0] < 0.02 * np.linalg.norm(exact.reshape(-1))


def test_poses_without_a_certified_answer_are_nan_and_counted():
    geometry = paper()
    errors = every_error(geometry)
    upside_down = geometry.home.position * [1.0, 1.0, -1.0]  # the mirror image: another assembly mode
    positions = np.array([geometry.home.position, upside_down, geometry.home.position, [np.nan, 0.0, 0.4]])
    fichter = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()  # singular
    rotations = np.array([np.eye(3), np.eye(3), fichter, np.eye(3)])
    for method in ("exact", "linear"):
        found = effects(geometry, errors, positions, rotations, method)
        assert np.isfinite(found[0]).all()
        assert np.isnan(found[1:]).all()
        result = extremes(geometry, errors, positions, rotations, method)
        np.testing.assert_array_equal(result.failed, 3 * np.bincount(errors.kind))
        assert (result.positions == positions[0]).all()
    with_none = extremes(geometry, errors, positions[1:], rotations[1:])
    assert np.isnan(with_none.values).all()
    assert (with_none.at_error == -1).all()


@pytest.mark.parametrize("method", [EXACT, LINEAR])
def test_extremes_are_those_of_all_effects_however_they_are_parted(method, monkeypatch):
    monkeypatch.setattr(kinematics, "ALONE", -1.0)  # other threads help from the second slice on
    geometry = framed(paper())
    errors = every_error(geometry)
    positions, rotations = poses_about(geometry.home, 2000, seed=9)
    monkeypatch.setattr(kinematics, "SLICE", 512)
    whole = extremes(geometry, errors, positions, rotations, method, threads=3)
    sizes = effects(geometry, errors, positions, rotations, method)
    for kind in range(len(errors.kinds)):
        of_kind = np.flatnonzero(errors.kind == kind)
        for column, (quantity, best) in enumerate([(0, np.argmax), (0, np.argmin), (1, np.argmax), (1, np.argmin)]):
            pose, error = divmod(int(best(sizes[:, of_kind, quantity])), len(of_kind))
            assert whole.at_error[kind, column] == of_kind[error]
            assert whole.values[kind, column] == sizes[pose, of_kind[error], quantity]
            np.testing.assert_array_equal(whole.positions[kind, column], positions[pose])
    parts = merged(
        extremes(geometry, errors, positions[a:b], rotations[a:b], method, threads=1)
        for a, b in pairwise([0, 1, 700, 1537, 2000])
    )
    for name in ("values", "at_error", "positions", "rotations", "failed", "poses"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


PART = 17  # poses per part in these tests, so that each orientation has some parts and a last one that is not full


@pytest.fixture(scope="module")
def errors() -> SingleErrors:
    return load_budget(config_file("error_budget")).single_errors(load_geometry("positioning_unit"))


@pytest.fixture(scope="module")
def small() -> list[Reach]:
    """Return the reaches of two orientations of the positioning unit, with some dozens of poses each."""
    geometry = load_geometry("positioning_unit")
    tilts = np.deg2rad([0.0, 5.0])
    return [reach(geometry, rotation, 7) for rotation in orientations(geometry, [tilts, [0.0], [0.0]])]


@pytest.fixture
def parted(monkeypatch: pytest.MonkeyPatch, small: list[Reach]) -> None:
    monkeypatch.setattr(runner, "PART", PART)
    assert all(found.within.sum() > 1.5 * PART for found in small)


def every_pose(small: list[Reach]) -> tuple[np.ndarray, np.ndarray]:
    poses = [poses_at(found.geometry, found.points(), found.rotation) for found in small]
    positions, rotations = (np.concatenate([pose[k] for pose in poses]) for k in range(2))
    return positions, rotations


def at_once(small: list[Reach], errors: SingleErrors, method: str = EXACT) -> Extremes:
    """Return the extremes over all poses at once, without the runner."""
    return extremes(small[0].geometry, errors, *every_pose(small), method)


def test_random_poses_are_drawn_once_from_all_reaches(small: list[Reach]) -> None:
    def rows(poses: tuple[np.ndarray, np.ndarray]) -> set[tuple[float, ...]]:
        return {(*p.tolist(), *r.ravel().tolist()) for p, r in zip(*poses, strict=True)}

    every, some = every_pose(small), runner.random_poses(tuple(small), 40, seed=1)
    assert rows(runner.random_poses(tuple(small), 10**6, seed=0)) == rows(every)
    assert len(some[0]) == len(rows(some)) == len(rows(some) & rows(every)) == 40


def assert_same_bits(found: Extremes, expected: Extremes) -> None:
    for name in (field.name for field in fields(Extremes) if field.name != "errors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name, strict=True)
    assert found.errors.labels == expected.errors.labels


@pytest.mark.usefixtures("parted")
@pytest.mark.parametrize(("method", "workers"), [(EXACT, 1), (LINEAR, 2)])
def test_part_by_part_here_and_in_another_process(small, errors, method: str, workers: int, monkeypatch) -> None:
    """Poses and errors of the extremes agree, too, even if equal values occur in different parts."""
    # One process shows what two do: each costs two seconds of imports, and the order of the results is the library's
    monkeypatch.setattr(runner, "ProcessPoolExecutor", lambda workers, **given: ProcessPoolExecutor(1, **given))
    counts: list[int] = []
    whole = at_once(small, errors, method)
    assert_same_bits(survey(small, errors, method, workers, progress=counts.append), whole)
    assert sum(counts) == whole.poses


@pytest.mark.usefixtures("parted")
def test_what_ends_a_survey_ends_its_processes(small, errors, monkeypatch) -> None:
    pool, made = Mock(), Mock()
    made.return_value = pool
    monkeypatch.setattr(runner, "ProcessPoolExecutor", made)
    pool.map = Mock(side_effect=BrokenProcessPool)
    with pytest.raises(HexapodError, match=r"a worker process ended \(out of memory\?\); use fewer --workers"):
        survey(small, errors, workers=2)
    pool.shutdown.assert_called_once_with(wait=True, cancel_futures=True)
    pool.map, pool.shutdown = map, Mock()
    with pytest.raises(KeyboardInterrupt):
        survey(small, errors, workers=2, progress=Mock(side_effect=KeyboardInterrupt))
    pool.shutdown.assert_called_once_with(wait=True, cancel_futures=True)
    assert made.call_args.args == (2,)


# An existing cluster


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Provide the address of a cluster of two workers in this process, used over TCP like any other."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install distributed")
    folder = str(tmp_path_factory.mktemp("dask"))
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "local_directory": folder}
    with distributed.LocalCluster(processes=False, protocol="tcp://", host="127.0.0.1", **options) as cluster:
        yield cluster.scheduler_address


@pytest.mark.usefixtures("parted")
def test_on_a_cluster(small: list[Reach], errors: SingleErrors, scheduler: str) -> None:
    whole = at_once(small, errors)
    for _ in range(2):  # twice, so that nothing may be left closed
        assert_same_bits(survey(small, errors, scheduler=scheduler), whole)


def test_what_cannot_be_ranked_is_refused(small: list[Reach], errors: SingleErrors) -> None:
    geometry = small[0].geometry
    for make, said in (
        (lambda: merged(iter(())), "no poses: the workspace is empty"),
        (lambda: reach(geometry, cells=3), "cells: must lie in 4…200 .found 3"),
        (lambda: reach(geometry, cells=201), "cells: must lie in 4…200 .found 201"),
        (lambda: runner.classify(geometry, load_budget(config_file("error_budget")), method="fast"), "must be one of "),
    ):
        with pytest.raises(HexapodError, match=said):
            make()


def test_a_cluster_without_dask(small: list[Reach], errors: SingleErrors, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(HexapodError, match=r"needs Dask: pip install distributed"):
        survey(small, errors, scheduler="tcp://127.0.0.1:8786")
    with pytest.raises(HexapodError, match="address must be like tcp://host:8786, not 'nowhere:8786'"):
        survey(small, errors, scheduler="nowhere:8786")
    client = MagicMock()
    client.wait_for_workers.side_effect = TimeoutError
    for made, said in ((OSError("refused"), "no Dask scheduler answers at 'tcp://a:1': refused"),
                       ([client], "the Dask scheduler at 'tcp://a:1' has no workers")):  # fmt: skip
        monkeypatch.setitem(sys.modules, "distributed", Mock(Client=Mock(side_effect=made)))
        with pytest.raises(HexapodError, match=said):
            survey(small, errors, scheduler="tcp://a:1")
