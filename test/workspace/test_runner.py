"""Surveys part by part: in this process, in several, on a cluster; the same numbers to the last bit."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import fields

import numpy as np
import pytest
from strategies import PAPER_FILE

from hexapod_comp.errors import HexapodError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.workspace import study as runner
from hexapod_comp.workspace.budget import SingleErrors, load_budget
from hexapod_comp.workspace.effects import EXACT, LINEAR, Extremes, extremes
from hexapod_comp.workspace.reach import Reach, orientations, reach
from hexapod_comp.workspace.study import survey

PART = 17  # Poses per part in these tests: each orientation has some parts, and a last one that is not full


@pytest.fixture(scope="module")
def errors() -> SingleErrors:
    return load_budget(config_file("error_budget")).single_errors(load_geometry(config_file("positioning_unit")))


@pytest.fixture(scope="module")
def small() -> list[Reach]:
    """Two orientations of the positioning unit, some dozens of poses each."""
    geometry = load_geometry(PAPER_FILE.with_name("positioning_unit.yaml"))
    tilts = np.deg2rad([0.0, 5.0])
    return [reach(geometry, rotation, 7) for rotation in orientations(geometry, [tilts, [0.0], [0.0]])]


@pytest.fixture
def parted(monkeypatch: pytest.MonkeyPatch, small: list[Reach]) -> None:
    monkeypatch.setattr(runner, "PART", PART)
    assert all(found.within.sum() > 1.5 * PART for found in small)


@pytest.fixture(scope="module")
def whole(small: list[Reach], errors: SingleErrors) -> Extremes:
    """All poses at once, without the runner."""
    poses = [found.platform_poses() for found in small]
    positions, rotations = (np.concatenate([pose[k] for pose in poses]) for k in range(2))
    return extremes(small[0].geometry, errors, positions, rotations)


def assert_same_bits(found: Extremes, expected: Extremes) -> None:
    for name in (field.name for field in fields(Extremes) if field.name != "errors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name, strict=True)
    assert found.errors.labels == expected.errors.labels


@pytest.mark.usefixtures("parted")
def test_in_two_processes(small: list[Reach], errors: SingleErrors, whole: Extremes) -> None:
    """The extremes' poses and errors too, where equal values meet in different parts."""
    counts: list[int] = []
    assert_same_bits(survey(small, errors, workers=2, progress=counts.append), whole)
    assert sum(counts) == whole.poses


@pytest.mark.usefixtures("parted")
def test_the_method_reaches_the_parts(small: list[Reach], errors: SingleErrors, whole: Extremes) -> None:
    """To first order is near the exact, within error/length or 1e-3, and not the same."""
    linear = survey(small, errors, LINEAR)
    np.testing.assert_allclose(linear.values[:, 0], whole.values[:, 0], rtol=1e-3)
    assert (linear.values[:, 0] != whole.values[:, 0]).all()
    assert_same_bits(survey(small, errors, EXACT), whole)


@pytest.mark.usefixtures("parted")
def test_an_interruption_ends_the_processes(small: list[Reach], errors: SingleErrors) -> None:
    """And comes out as what it is."""

    def interrupted(count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        survey(small, errors, workers=2, progress=interrupted)


# An existing cluster.


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a cluster of two workers in this process, spoken to over TCP like any other."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install distributed")
    folder = str(tmp_path_factory.mktemp("dask"))
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "local_directory": folder}
    with distributed.LocalCluster(processes=False, protocol="tcp://", host="127.0.0.1", **options) as cluster:
        yield cluster.scheduler_address


@pytest.mark.usefixtures("parted")
def test_on_a_cluster(small: list[Reach], errors: SingleErrors, whole: Extremes, scheduler: str) -> None:
    assert scheduler.startswith("tcp://")
    counts: list[int] = []
    assert_same_bits(survey(small, errors, scheduler=scheduler, progress=counts.append), whole)
    assert sum(counts) == whole.poses
    assert_same_bits(survey(small, errors, scheduler=scheduler), whole)  # once more: nothing was left closed


def test_a_cluster_without_dask(small: list[Reach], errors: SingleErrors, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(HexapodError, match=r"needs Dask: pip install distributed"):
        survey(small, errors, scheduler="tcp://127.0.0.1:8786")


def test_no_scheduler_answers(small: list[Reach], errors: SingleErrors, monkeypatch: pytest.MonkeyPatch) -> None:
    """Port 1 of this machine, where nothing listens; after one second instead of ten."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install distributed")

    def impatient(address: str, **options: object) -> object:
        return client(address, **{**options, "timeout": "1s"})

    client = distributed.Client
    monkeypatch.setattr(distributed, "Client", impatient)
    with pytest.raises(HexapodError, match=r"no Dask scheduler answers at 'tcp://127\.0\.0\.1:1'"):
        survey(small, errors, scheduler="tcp://127.0.0.1:1")
