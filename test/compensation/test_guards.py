"""What each guard refuses, by direct calls and a clock of the test's own: the list that no change may shorten.

Over DDS the nodes' tests show that the guards are in the way of messages; what they judge is shown here. Stamps have a
file of their own, test_stamps.py, temperatures too, test_thermal.py.
"""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import fixed

from hexapod_comp.compensation.guards import (
    SPEAKERS_HELD,
    UNKNOWN_NAME,
    Guard,
    OneSender,
    RateLimit,
    Sample,
    StrutSteps,
)
from hexapod_comp.errors import HexapodError, LimitError

STEP, SPEED = 2e-3, 0.25
"""Of the paper's machine: m and m/s."""

AT = (0.5,) * 6


def moved(way: float, strut: int = 4) -> tuple[float, ...]:
    return tuple(length + way * (n == strut) for n, length in enumerate(AT))


def reason(guard: Guard, sample: Sample) -> str:
    """Return why a guard refuses a sample; empty where it lets it pass."""
    try:
        guard.check(sample)
    except HexapodError as error:
        return error.reason
    return ""


# ---- speed ----


@pytest.mark.parametrize(("way", "pause", "passes"), [(2.9e-3, 0.004, True), (3.1e-3, 0.004, False), (0.03, 0.2, True)])
def test_steps_beyond_the_limits_of_step_and_speed_are_refused(way, pause, passes):
    """2 mm per command and 250 mm/s: 3 mm after 4 ms, 52 mm after 0.2 s."""
    guard = StrutSteps(STEP, SPEED)
    guard.check(Sample(0.0, 0, (7.0,) * 6))  # nothing is known yet
    guard.accept(Sample(1.0, 0, AT))
    sample = Sample(1.0 + pause, 0, moved(way))
    if passes:
        guard.check(sample)
        return
    with pytest.raises(LimitError, match=r"strut_5 would step by 3\.1 mm, allowed 3 mm") as caught:
        guard.check(sample)
    assert (caught.value.reason, caught.value.strut) == ("step", 4)


def test_the_first_command_is_held_against_where_the_struts_stand_however_long():
    guard = StrutSteps(STEP, SPEED)
    guard.reset(list(AT))
    assert reason(guard, Sample(1e6, 0, moved(2.1e-3))) == "step"
    assert reason(guard, Sample(1e6, 0, moved(1.9e-3))) == ""


def test_many_in_turn_are_no_faster_than_the_struts_but_for_a_bunch():
    """1.9 mm each millisecond is within a step each time; 2 mm and 0.1 s at 250 mm/s, 27 mm, may be ahead: fourteen of
    them, less what 1 ms of motion takes off each."""
    guard = StrutSteps(STEP, SPEED)
    guard.reset(list(AT))
    for n in range(1, 40):
        sample = Sample(1.0 + 1e-3 * n, 0, moved(1.9e-3 * n))
        if found := reason(guard, sample):
            break
        guard.accept(sample)
    assert (found, n) == ("speed", 17)  # the first gives no right to a way: 1.9 + 16 · 1.65 = 28.3 mm, 15 are 26.65 mm


@fixed
@given(
    st.lists(st.tuples(st.floats(-1, 1), st.floats(0, 2)), min_size=1, max_size=40), st.floats(1e-3, 1), st.floats(0, 5)
)
def test_what_passes_a_rate_limit_moves_no_faster(moves, at_once, rate):
    """A property: between any two accepted values in turn there is no more than at_once + rate · time."""
    limit, accepted, now = RateLimit(at_once, rate), [], 0.0
    for value, pause in moves:
        now += pause
        if limit.excess((value,), now) is None:
            limit.accept((value,), now)
            accepted.append((value, now))
    for (a, then), (b, later) in itertools.pairwise(accepted):
        assert abs(b - a) <= at_once + rate * (later - then) + 1e-12
    assert accepted, "the first of all passes"


# ---- senders ----


class Graph:
    """Stands for the ROS graph: DDS would have to be stopped between two of its messages to see this over topics."""

    def __init__(self, *names: str, count: int | None = None, unknown: str = "", own: str = "", allowed: bool = False):
        self.names, self.unknown, self.fixed_count, self.asked = names, unknown, count, 0
        self.sender = OneSender("/commands", self.count, self.look_up, allowed, own)

    def count(self) -> int:
        return len(self.names) if self.fixed_count is None else self.fixed_count

    def look_up(self) -> tuple[tuple[str, ...], str]:
        self.asked += 1
        return tuple(sorted(set(self.names))), self.unknown


def test_unnamed_counts_as_another():
    """What DDS has found but not yet named, or never will: not a ROS node."""
    graph = Graph("/left/controller", UNKNOWN_NAME)
    sender = graph.sender
    sender.update(0.0)
    assert sender.problem == "several publishers of /commands: /left/controller, _NODE_NAME_UNKNOWN_"
    assert reason(sender, Sample(0.0)) == "several_publishers"
    graph.names = ("/left/controller", "/left/controller")
    sender.update(0.1)
    assert (sender.problem, sender.names) == ("", ("/left/controller",))
    graph.names = (UNKNOWN_NAME,)
    sender.update(0.2)
    assert not sender.problem, "alone, it is the one who commands"
    graph.names = ()
    sender.update(0.3)
    assert sender.names == ()


def test_who_cannot_be_told_is_refused():
    graph = Graph("/a", unknown="a node's name is not UTF-8")
    graph.sender.update(0.0)
    assert reason(graph.sender, Sample(0.0)) == "unknown_publisher"
    assert graph.sender.problem == "who publishes /commands cannot be told: a node's name is not UTF-8"
    graph.unknown = ""
    graph.sender.update(0.1)
    assert reason(graph.sender, Sample(0.1)) == ""


def test_another_on_an_own_topic_is_a_problem_and_one_of_the_same_name_is_not():
    graph = Graph("/me", own="/me")
    graph.sender.update(0.0)
    assert (graph.sender.problem, graph.sender.names) == ("", ())
    graph.names = ("/me", "/me")
    graph.sender.update(0.1)
    assert not graph.sender.problem
    graph.names = ("/me", "/stranger")
    graph.sender.update(0.2)
    assert graph.sender.problem == "/commands is also published by /stranger"
    graph.names, graph.fixed_count = ("/stranger",), 1  # its own has not been found yet
    graph.sender.update(0.3)
    assert graph.sender.problem


NUMBERS = {
    "one publisher": ([1, 2, 3, 4], 0, False),
    "joined late": ([70, 71, 72], 0, False),
    "three missed": ([1, 2, 6, 7], 3, False),
    "restarted": ([500, 501, 1, 2, 3], 0, False),
    "restarted, one missed": ([500, 1, 3, 4], 1, False),
    "two that began together": ([1, 1, 2, 2, 3, 3], 0, True),
    "an old and a new one": ([500, 1, 501, 2, 502], 0, True),
    "a fast and a slow one": ([500, 1, 2, 3, 4, 501, 5, 6, 7], 0, True),
    "both miss": ([500, 1, 503, 3], 3, True),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_sequence_numbers_tell(case):
    """Counted by hand; two of one name stand in the graph, one of which may be a ghost."""
    numbers, missed, two = NUMBERS[case]
    graph = Graph("/a", "/a")
    graph.sender.update(0.0)
    found = [graph.sender.receive(number, 0.01 * n) for n, number in enumerate(numbers)]
    assert (graph.sender.missed, any(found), bool(graph.sender.problem)) == (missed, two, two)
    assert graph.sender.missing(0.1) is (missed > 0)
    graph.sender.update(0.1 + SPEAKERS_HELD)
    assert not graph.sender.problem


def test_two_of_one_name_are_refused_where_the_middleware_does_not_count():
    """As rmw_cyclonedds: whether one is the other's ghost cannot be told; one alone is obeyed."""
    for publishers, number, refused in ((1, None, False), (2, None, True), (2, 1, False)):
        sender = Graph(*["/controller"] * publishers).sender
        sender.update(0.0)
        assert not sender.problem
        assert sender.receive(number, 0.01) is refused
        assert ("does not count" in sender.problem) is refused
        sender.update(10.0)
        assert bool(sender.problem) is refused
        assert not sender.receive(number, 10.1)
        assert sender.missed == 0


# ---- what all have in common ----
