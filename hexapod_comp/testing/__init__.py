"""A test kit for integrators of the nodes: a pytest plugin with a compensator and a simulated machine, without launch.

Installed with the package. ``hexapod`` is a :class:`~hexapod_comp.testing.bench.Bench` in a private context, in a ROS
domain of this test session's own, on this computer alone.
"""

from __future__ import annotations

import gc
from collections.abc import Generator, Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rclpy.context import Context

    from .bench import Bench


# Fixtures whose tests leave nodes behind; add your own that make nodes without `hexapod_context`
NODE_FIXTURES = {"hexapod_context"}


@pytest.fixture(scope="session")
def hexapod_domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Keep a session's nodes on this computer, in a domain of their own, their logs in a temporary folder."""
    # Yields the domain id. Processes that tests start inherit all of it through the environment.
    from ..loop.processes import PrivateDomain

    with PrivateDomain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        yield domain


@pytest.fixture
def hexapod_context(hexapod_domain: int) -> Iterator[Context]:
    """Give a private rclpy context; nodes and executors made with it leave no trace in other tests."""
    yield from private_context(hexapod_domain)


@pytest.fixture
def hexapod(hexapod_context: Context, capfd: pytest.CaptureFixture[str]) -> Iterator[Bench]:
    """Give a bench for a compensator, a simulated machine, and nodes of one's own."""
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
    """Destroy what a test with ROS leaves behind before the next one starts."""
    # rclpy's nodes are in reference cycles, and die when the collector runs. If that is while the next test's nodes are
    # being discovered, Fast DDS waits for a callback that waits for the GIL, for ever.
    result = yield
    if not NODE_FIXTURES.isdisjoint(getattr(item, "fixturenames", ())):
        gc.collect()
        gc.freeze()  # what is left lives on, and need not be looked at again after every test
    return result
