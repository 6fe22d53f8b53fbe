"""A pytest plugin for integrators that runs a compensator and a simulated machine in a test, without launch files.

The plugin's fixture ``hexapod`` is a :class:`~hexapod_comp.testing.bench.Bench`. The test session uses a ROS domain
that no other computer can see.
"""

from __future__ import annotations

import gc
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rclpy.context import Context

    from .bench import Bench


# After a test with one of these fixtures the plugin destroys the test's node objects. Add the names of your own
# fixtures that make nodes without `hexapod_context`.
NODE_FIXTURES = {"hexapod_context"}


@pytest.fixture(scope="session")
def hexapod_domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Yield the id of a ROS domain that only this test session uses; ROS logs go to a temporary folder."""
    # domain and log folder are environment variables, so that processes started by a test inherit them
    from ..loop.processes import PrivateDomain

    with PrivateDomain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        yield domain


@pytest.fixture
def hexapod_context(hexapod_domain: int) -> Iterator[Context]:
    """Yield a private rclpy context, whose nodes and executors do not affect other tests."""
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
    # Only the garbage collector destroys nodes, which are in reference cycles. If Fast DDS discovers the next test's
    # nodes during the collection, Fast DDS waits for a callback, and the callback waits for the GIL: a deadlock.
    result = yield
    if not NODE_FIXTURES.isdisjoint(getattr(item, "fixturenames", ())):
        gc.collect()
        gc.freeze()  # saves time, since later collections skip the present objects
    return result
