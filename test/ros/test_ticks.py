"""What is called at a rate: a rate that changes hundreds of times a second disturbs neither it nor a timer.

Truth: the times of the calls by the monotonic clock.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.experimental import EventsExecutor

from hexapod_comp.ros.rclpy_compat import Alarm


@pytest.fixture
def executor(ros_context: Context):
    executor = EventsExecutor(context=ros_context)
    yield executor
    executor.shutdown()


def spin(executor: EventsExecutor, seconds: float, each=lambda: None) -> None:
    """Handle events for a while, and do something every 2 ms."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        each()
        executor.spin_once(timeout_sec=0.002)


def test_a_flood_of_rates_moves_neither_ticks_nor_timers(executor, ros_context):
    """By timers that are reset, 500 times a second, there were 3 heartbeats a second, and gaps of 4 s."""
    node = rclpy.create_node("ticking", context=ros_context)
    executor.add_node(node)
    ticks, checks = [], []
    ticker = Alarm(node, lambda: ticks.append(time.monotonic()), 100.0)
    node.create_timer(0.05, lambda: checks.append(time.monotonic()))
    began, rates = time.monotonic(), iter(np.random.default_rng(1).uniform(90.0, 110.0, 10_000))
    spin(executor, 0.5, lambda: ticker.set_rate(next(rates)))
    ticker.close()
    assert 35 <= len(ticks) <= 58, "90 to 110 Hz for half a second, on a busy computer"
    assert np.diff([began, *ticks, time.monotonic()]).max() < 0.1
    assert len(checks) >= 6
    node.destroy_node()
