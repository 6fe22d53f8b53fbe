"""Five seconds of what ``python -m benchmarks.soak`` does for half an hour, and that its account is right.

No latency is judged here: other jobs decide it on a shared machine. What is judged holds on any: a command
without an answer has been counted, and nothing is hoarded while the machine moves.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers import long_test

pytest.importorskip("rclpy")

from benchmarks.soak import BINS, Soak, soak

SECONDS = 5.0


@long_test
def test_five_seconds_at_1_khz():
    found = soak(SECONDS, 1000.0)
    counted = sum(int(found.diagnostics["compensator"][name]) for name in ("commands_missed", "refused"))
    assert found.commands > 100.0 * SECONDS, "a machine too busy for 100 Hz shows nothing"
    assert found.lost <= counted
    assert found.heartbeats > 10.0 * SECONDS  # of 50 a second
    assert found.histogram.sum() == found.commands - found.lost
    memory = np.array(found.memory)[:, 1:]
    assert (memory[-1] - memory[len(memory) // 2]).max() < 1e6, "an hour of that would be more than 1.4 GB"


def test_quantiles_and_growth_of_a_known_run():
    """999 answers after 1 ms and one after 20 ms; 3 MB an hour in one node, nothing in the other."""
    found = Soak(longest=0.02)
    found.histogram[np.searchsorted(BINS, [1e-3, 20e-3])] = [999, 1]
    assert found.quantile(0.5) == pytest.approx(1e-3, rel=0.0024)
    assert found.quantile(0.99) == pytest.approx(1e-3, rel=0.0024)
    assert found.quantile(1.0) == 0.02
    found.memory = [(float(second), 2e8 + 3e6 * second / 3600.0, 2e8) for second in range(600)]
    assert found.growth(0)[0] == pytest.approx(3.0, rel=1e-9)
    assert found.growth(1)[0] == pytest.approx(0.0, abs=1e-9)
