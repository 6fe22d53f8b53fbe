"""Fixtures of tests with ROS: their nodes are isolated from other nodes on the computer and network.

rclpy is imported inside the fixtures only, so that the core's tests run without ROS.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from node_helpers import Bench, Rig, Stranger
    from rclpy.context import Context

pytest_plugins = ("hexapod_comp.testing",)  # if the package is not installed

OWN_NODE_FIXTURES = {"module_context", "client"}

# Folders and files whose tests wait for nodes more than they compute; those with the longest tests are first
WAITING = ("test/loop/", "test/fuzz/test_fuzz_wire.py", "test/benchmarks/", "test/linuxcnc/", "test/ros/")


def pytest_configure() -> None:
    """Refuse a core compiled from other sources; make the test kit clean up after this project's own fixtures, too."""
    from hexapod_comp import core
    from hexapod_comp.core.build import sources_hash
    from hexapod_comp.testing import NODE_FIXTURES

    if sources_hash(Path(core.__file__).parent) != core.SOURCES_HASH:
        raise pytest.UsageError("the core was compiled from other sources: python setup.py build_ext --inplace")
    NODE_FIXTURES.update(OWN_NODE_FIXTURES)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Run a file's tests in one process, as ``--dist loadfile`` does, but split test_zoo.py by machine.

    The first process takes the files whose tests wait for nodes first, the other processes those that compute.
    """
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return nodeid[nodeid.rindex("[") :] if file.endswith("test_zoo.py") else file

        def _assign_work_unit(self, node: Any) -> None:
            waiting = [file for folder in WAITING for file in self.workqueue if file.startswith(folder)]
            computing = [file for file in self.workqueue if file not in waiting]
            wanted = waiting + computing if node is self.nodes[0] else computing + waiting
            self.workqueue.move_to_end(wanted[0], last=False)
            super()._assign_work_unit(node)

    return Scheduling(config, log)


@pytest.fixture(scope="session", autouse=True)
def isolated_ros(hexapod_domain: int) -> int:
    """Use this session's ROS domain in every test, since some tests start processes with nodes."""
    return hexapod_domain


@pytest.fixture
def unsuspected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Switch off the fit's searches for mix-ups and for a lead that is given, in tests of other things."""
    from calibration_helpers import search_nothing

    search_nothing(monkeypatch)


@pytest.fixture(scope="module")
def module_context(hexapod_domain: int) -> Iterator[Context]:
    """Provide one context for the tests of a module whose nodes are never spun."""
    from hexapod_comp.testing import private_context

    yield from private_context(hexapod_domain)


@pytest.fixture
def bench(hexapod_context: Context, capfd: pytest.CaptureFixture[str]) -> Iterator[Bench]:
    """Provide a bench with this project's usual machine."""
    from node_helpers import Bench

    with Bench(hexapod_context, capfd) as made:
        yield made


@pytest.fixture
def rig(
    module_context: Context,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> Iterator[Rig]:
    """Provide a bench without DDS whose clock also replaces ``time`` in the test module."""
    from node_helpers import Rig

    with Rig(module_context, capfd, monkeypatch) as made:
        if hasattr(request.module, "time"):
            monkeypatch.setattr(request.module, "time", made.clock)
        yield made


@pytest.fixture
def stranger(rig: Rig) -> Stranger:
    """Provide a second node beside the rig's."""
    from node_helpers import Stranger

    return Stranger(rig, "stranger")
