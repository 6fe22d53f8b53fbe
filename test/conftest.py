"""What tests with ROS need: nothing of them is seen outside, nothing outside disturbs them.

rclpy is imported inside the fixtures only, so that the core's tests run where there is no ROS.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from hexapod_comp.formats.paths import config_file
from hexapod_comp.loop.processes import reserve_domain

if TYPE_CHECKING:
    from node_helpers import Bench
    from rclpy.context import Context
    from rclpy.executors import Executor


ROS_FIXTURES = {"ros_context", "module_context", "client"}


def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile what nodes need before the first test with one: on a busy machine that outlasts a test's time limit."""
    if session.config.option.collectonly or not any(_has_nodes(item) for item in session.items):
        return
    from hexapod_comp.nodes.warming import warm

    warm()


def _has_nodes(item: pytest.Item) -> bool:
    return not ROS_FIXTURES.isdisjoint(getattr(item, "fixturenames", ()))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Keep a file's tests in one process, as ``--dist loadfile`` does, but those of the zoo machine by machine."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return nodeid[nodeid.rindex("[") :] if file.endswith("test_zoo.py") else file

    return Scheduling(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[object]:
    """Destroy what a test with ROS leaves behind before the next one starts.

    rclpy's nodes are in reference cycles, and die when the collector runs. If that is while the next test's
    nodes are being discovered, Fast DDS waits for a callback that waits for the GIL, for ever.
    """
    result = yield
    if _has_nodes(item):
        gc.collect()
        gc.freeze()  # what is left lives on, and need not be looked at again after every test
    return result


@pytest.fixture(scope="session", autouse=True)
def isolated_ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Keep this session's nodes on this machine, in a domain of their own, their logs in a temporary folder.

    Yields the domain id. Processes that tests start inherit all of it through the environment.
    """
    domain, reservation = reserve_domain()
    with reservation, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
        patch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(config_file("fastdds.xml")))
        patch.setenv("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")  # as the nodes do with it
        patch.delenv("ROS_LOCALHOST_ONLY", raising=False)
        patch.delenv("ROS_STATIC_PEERS", raising=False)
        patch.delenv("ROS_DISCOVERY_SERVER", raising=False)
        yield domain


@pytest.fixture
def ros_context(isolated_ros: int) -> Iterator[Context]:
    """Give a private rclpy context; nodes and executors made with it leave no trace in other tests."""
    yield from _private_context(isolated_ros)


@pytest.fixture(scope="module")
def module_context(isolated_ros: int) -> Iterator[Context]:
    """Give a context that the tests of a module share, for nodes that are never spun."""
    yield from _private_context(isolated_ros)


def _private_context(domain: int) -> Iterator[Context]:
    import rclpy

    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain)
    yield context
    rclpy.try_shutdown(context=context)


@pytest.fixture
def bench(ros_context: Context, spin_until: Callable[..., None], capfd: pytest.CaptureFixture[str]) -> Iterator[Bench]:
    """Give a bench for nodes in a private context."""
    from node_helpers import Bench

    with Bench(ros_context, spin_until, capfd) as made:
        yield made


@pytest.fixture
def spin_until() -> Callable[..., None]:
    """Give :func:`spin_executor_until`: ``spin_until(executor, condition, timeout=5.0, what="…")``."""
    return spin_executor_until


def spin_executor_until(
    executor: Executor, condition: Callable[[], object], timeout: float = 5.0, what: str = ""
) -> None:
    """Spin until `condition()` holds; raise TimeoutError naming `what` if it does not within `timeout` s."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            awaited = what or getattr(condition, "__name__", "condition")
            raise TimeoutError(f"waited {timeout} s in vain for: {awaited}")
        executor.spin_once(timeout_sec=0.02)
