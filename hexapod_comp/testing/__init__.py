"""A pytest plugin for integrators: it runs a compensator and a simulated machine in a test, without launch files.

The package installs the plugin. Its fixture ``hexapod`` is a :class:`~hexapod_comp.testing.bench.Bench` with a private
rclpy context, in a ROS domain that only this test session uses, visible on this computer only.
"""

from __future__ import annotations

import gc
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rclpy.context import Context

    from .bench import Bench


# Fixtures after whose tests node objects are garbage-collected; add your own that make nodes without `hexapod_context`
NODE_FIXTURES = {"hexapod_context"}


@pytest.fixture(scope="session")
def hexapod_domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Yield the id of a ROS domain for this test session, visible on this computer only; log to a temporary folder."""
    # Processes that tests start inherit these settings through the environment.
    from ..loop.processes import PrivateDomain

    with PrivateDomain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        yield domain


@pytest.fixture
def hexapod_context(hexapod_domain: int) -> Iterator[Context]:
    """Yield a private rclpy context; nodes and executors made with it do not affect other tests."""
    yield from private_context(hexapod_domain)


@pytest.fixture
def hexapod(hexapod_context: Context, capfd: pytest.CaptureFixture[str]) -> Iterator[Bench]:
    """Yield a bench that runs a compensator, a simulated machine and your own nodes."""
    from .bench import Bench

    with Bench(hexapod_context, capfd) as bench:
        yield bench


def private_context(domain: int) -> Iterator[Context]:
    import rclpy

    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Destroy the node objects of a test before the next test starts."""
    # rclpy's nodes are in reference cycles and are destroyed by the garbage collector. If it runs while the next test's
    # nodes are being discovered, Fast DDS waits for a callback that waits for the GIL: a deadlock.
    result = yield
    if not NODE_FIXTURES.isdisjoint(getattr(item, "fixturenames", ())):
        gc.collect()
        gc.freeze()  # the remaining objects need not be examined again after every test
    return result
