"""The track of the struts: plausible readings, following errors, motion, the start of a run; what each guard refuses.

The clock is the test's own. Stamps: test_stamps.py, temperatures: test_thermal.py."""

from __future__ import annotations

import numpy as np
import pytest

from hexapod_comp.compensation.guards import (
    UNKNOWN_NAME,
    EventWindow,
    Excess,
    Guard,
    OneSender,
    RateLimit,
    Sample,
    StrutSteps,
)
from hexapod_comp.compensation.track import StrutTrack
from hexapod_comp.errors import CommandError, HexapodError, LimitError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry

SECOND = 10**9


def six(length: float, way: float = 0.0, strut: int = 2) -> tuple[float, ...]:
    return tuple(length + way * (n == strut) for n in range(6))


def read(track: StrutTrack, struts, at: float, age: float = 0.0) -> None:
    sample = Sample(at, 0, tuple(struts))
    sample.age = age
    track.add_reading(sample)


# ---- implausible readings ----


@pytest.mark.parametrize(
    ("jump", "by_stamp", "by_arrival", "refusal"),
    [
        (2.9e-3, 0.0, 0.002, ""),  # allowed: 2 mm + 2 ms · 500 mm/s = 3 mm
        (3.1e-3, 0.0, 0.002, "3.100 mm, allowed 3.000 mm in 0.002 s"),
        (10e-3, 0.020, 0.0, ""),  # delivered at once after a pause: 12 mm in the 20 ms between the stamps
        (13e-3, 0.020, 0.0, "13.000 mm, allowed 12.000 mm in 0.020 s"),
        (50e-3, 0.002, 0.1, ""),  # allowed: 52 mm
    ],
)
def test_struts_move_no_faster_than_they_can(jump, by_stamp, by_arrival, refusal):
    """A reading may jump by the paper machine's step of 2 mm plus twice its speed of 250 mm/s, for motion by hand."""
    track = StrutTrack(load_geometry(config_file("paper.yaml")))
    track.check_jump(Sample(0.0, 0, six(7.0)))  # without an earlier reading nothing is compared
    track.add_reading(Sample(1.0, 5 * SECOND, six(0.5)))
    sample = Sample(1.0 + by_arrival, round((5 + by_stamp) * 1e9), six(0.5, -jump, 4))
    if not refusal:
        track.check_jump(sample)
        return
    with pytest.raises(LimitError, match=f"^strut_5 has jumped by {refusal}$") as caught:
        track.check_jump(sample)
    assert (caught.value.reason, caught.value.strut) == ("jump", 4)


def test_no_strut_is_longer_or_shorter_than_it_can_be():
    geometry = load_geometry(config_file("paper.yaml"))
    StrutTrack().check_stroke(six(99.0))  # without a machine there is no limit
    track, limits = StrutTrack(geometry), geometry.limits
    low, high = limits.stroke[3] + np.array([-1.0, 1.0]) * limits.correction
    for length, wrong in ((low + 1e-6, False), (low - 1e-6, True), (high - 1e-6, False), (high + 1e-6, True)):
        struts = list(limits.stroke.mean(axis=1))
        struts[3] = length
        if not wrong:
            track.check_stroke(struts)
            continue
        text = f"strut_4 cannot be {length * 1e3:.3f} mm long, only 328…882 mm"
        with pytest.raises(LimitError, match=f"^{text}$") as caught:
            track.check_stroke(struts)
        assert (caught.value.reason, caught.value.limit) == ("stroke", low if length < low else high)


def test_lag_is_no_following_error():
    """At 0.1 m/s a strut is 5 mm behind after 50 ms, no error: it was commanded there in the last 0.1 s."""
    track = StrutTrack(limit=1e-3)
    for n in range(200):
        track.add_command(six(0.5 + 1e-4 * n), 1e-3 * n)
    for behind, wrong in ((0.0, False), (5e-3, False), (10e-3, False), (12e-3, True), (-2e-3, True)):
        assert track.follow(six(0.5199 - behind), 0.2) == wrong, behind
        assert not track.follow(six(0.5199 - behind), 0.2), "found once"
        track.follow(six(0.5199), 0.2)
        assert bool(track.problem) == wrong, "what has happened stays"
        track.reset()
        assert bool(track.problem) == wrong, "also when commands are forgotten"
        if wrong:
            text = (
                f"^strut_1 is at {519.9 - 1e3 * behind:.3f} mm, 2.000 mm from its command, allowed 1 mm; "
                "commands are refused until ~/reset$"
            )
            with pytest.raises(CommandError, match=text) as caught:
                track.check(Sample(0.2))
            assert caught.value.reason == "following_error"
        track.release()
        track.check(Sample(0.2))
        for n in range(200):
            track.add_command(six(0.5 + 1e-4 * n), 1e-3 * n)
    track.reset()
    assert not track.follow(six(0.0), 0.2), "nothing is in force"
    track.add_command(six(0.5), 1.0)
    track.limit = 0.0
    assert not track.follow(six(0.0), 1.0), "switched off"


def test_what_counts_as_moving():
    """Motion is more than 50 µm within the last 0.1 s, commanded or measured."""
    track = StrutTrack()
    assert track.moving(1.0) == ""
    for n in range(100):
        track.add_command(six(0.5, 1e-6 * n), 1.0 + 1e-3 * n)
    assert track.moving(1.04) == "strut_3 was commanded to move by 0.099 mm in the last 0.1 s"
    assert track.moving(1.2) == ""
    read(track, six(0.5), 2.0)
    read(track, six(0.5 + 49e-6), 2.05)
    assert track.moving(2.05) == ""
    read(track, six(0.5 - 2e-6), 2.06)
    assert track.moving(2.06) == "strut_1 moved by 0.051 mm in the last 0.1 s"


def test_a_wait_for_feedback_has_an_end_where_a_parameter_says_so():
    """The wait ends 2 s after the start, by the track's clock; after one reading there is no wait any more."""
    track = StrutTrack(anywhere_after=2.0)
    with pytest.raises(CommandError, match="2 s after the activation the first command") as caught:
        track.start(100.0, fresh=False)
    assert caught.value.reason == "no_feedback"
    track.begin(100.0)
    assert track.waits(101.999)
    with pytest.raises(CommandError, match="no strut_states yet"):
        track.start(101.999, fresh=False)
    assert not track.waits(102.0)
    assert track.start(102.0, fresh=False) is None
    read(track, six(0.5), 110.0)
    track.begin(120.0)
    assert not track.waits(120.0)
    np.testing.assert_array_equal(track.start(999.0, fresh=False), 0.5)
    with pytest.raises(CommandError, match=r"the struts' lengths are unknown$"):
        StrutTrack().start(1e9, fresh=False)


def test_a_start_from_struts_at_rest_is_from_the_mean_of_their_readings():
    """The start is the mean of 200 readings with 0.1 µm of noise; after a motion of 10 µm, the newest one."""
    rng, track = np.random.default_rng(3), StrutTrack()
    for n in range(200):
        read(track, 0.5 + rng.normal(0.0, 1e-7, 6), 7.0 + 0.002 * n)
    assert np.abs(track.start(8.0, fresh=True) - 0.5).max() < 3e-8, "0.1 µm / √200 is 7 nm"
    away = six(0.5, 1e-5)
    read(track, away, 7.4)
    np.testing.assert_array_equal(track.start(8.0, fresh=True), away)
    for at, length in ((7.91, 0.5), (7.92, 0.5 + 1e-6)):  # readings older than 0.5 s are forgotten
        read(track, six(length), at)
    np.testing.assert_allclose(track.start(9.0, fresh=True), 0.5 + 0.5e-6, rtol=0.0, atol=1e-15)
    read(track, six(0.5 + 3e-6), 7.93)
    np.testing.assert_array_equal(track.start(9.0, fresh=True), 0.5 + 3e-6)


@pytest.mark.parametrize(
    ("measured_at", "fresh", "wanted"),
    [
        (9.89, True, "told"),  # the reading is fresh, but a command was sent after it
        (9.91, True, "measured"),
        (10.05, False, "told"),  # the drive may still have lagged
        (10.11, False, "measured"),  # the strut has arrived, or has been moved since
    ],
)
@pytest.mark.parametrize("late", [0.0, 0.3])
def test_what_is_known_last_counts(measured_at, fresh, wanted, late):
    """A drive follows within 0.1 s, and the last command was at 10 s; a reading counts from the time of measurement."""
    track = StrutTrack()
    track.add_command(six(0.4), 10.0)
    track.reset()
    np.testing.assert_array_equal(track.start(11.0, fresh), 0.4)
    read(track, six(0.5), measured_at + late, age=late)
    np.testing.assert_array_equal(track.start(11.0, fresh), 0.4 if wanted == "told" else 0.5)


# ---- guards ----

STEP, SPEED = 2e-3, 0.25
"""Step, m, and speed, m/s, of the paper's machine."""


def reason(guard: Guard, sample: Sample) -> str:
    """Return the reason for which a guard refuses a sample; empty if the guard accepts it."""
    try:
        guard.check(sample)
    except HexapodError as error:
        return error.reason
    return ""


@pytest.mark.parametrize(("way", "pause", "passes"), [(2.9e-3, 0.004, True), (3.1e-3, 0.004, False), (0.03, 0.2, True)])
def test_steps_beyond_the_limits_of_step_and_speed_are_refused(way, pause, passes):
    """With 2 mm per command and 250 mm/s, 3 mm are allowed after 4 ms and 52 mm after 0.2 s."""
    guard = StrutSteps(STEP, SPEED)
    guard.check(Sample(0.0, 0, (7.0,) * 6))  # without an earlier command nothing is compared
    guard.accept(Sample(1.0, 0, six(0.5)))
    sample = Sample(1.0 + pause, 0, six(0.5, way, 4))
    if passes:
        guard.check(sample)
        return
    with pytest.raises(LimitError, match=r"strut_5 would step by 3\.1 mm, allowed 3 mm") as caught:
        guard.check(sample)
    assert (caught.value.reason, caught.value.strut) == ("step", 4)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_what_is_no_length_is_refused_as_a_step(value):
    guard = StrutSteps(STEP, SPEED)
    guard.accept(Sample(1.0, 0, six(0.5)))
    with pytest.raises(LimitError, match="strut_3"):
        guard.check(Sample(1.004, 0, tuple(value if n == 2 else 0.5 for n in range(6))))


def test_the_first_command_is_held_against_where_the_struts_stand_however_long():
    guard = StrutSteps(STEP, SPEED)
    guard.reset(six(0.5))
    assert reason(guard, Sample(1e6, 0, six(0.5, 2.1e-3, 4))) == "step"
    assert reason(guard, Sample(1e6, 0, six(0.5, 1.9e-3, 4))) == ""


def test_many_in_turn_are_no_faster_than_the_struts_but_for_a_bunch():
    """Commands of 1.9 mm each millisecond pass as steps until they are 27 mm ahead of 250 mm/s (2 mm and 0.1 s)."""
    guard = StrutSteps(STEP, SPEED)
    guard.reset(six(0.5))
    for n in range(1, 17):  # 16 commands are 1.9 + 15 · 1.65 = 26.65 mm ahead, 17 are 28.3 mm
        sample = Sample(1.0 + 1e-3 * n, 0, six(0.5, 1.9e-3 * n, 4))
        guard.check(sample)
        guard.accept(sample)
    with pytest.raises(
        LimitError, match=r"^strut_5 would be 28\.3 mm ahead of a motion at 250 mm/s, allowed 27 mm$"
    ) as caught:
        guard.check(Sample(1.017, 0, six(0.5, 1.9e-3 * 17, 4)))
    assert (caught.value.reason, caught.value.strut) == ("speed", 4)


def test_what_exceeds_a_rate_limit():
    """A change by 1 + 1 · time is allowed, with a bucket of 2 s also a lead of 1 + 1 · 2; all numbers are exact."""
    limit = RateLimit(1.0, 1.0, 2.0)
    limit.accept((0.0, 0.0), 0.0)
    assert limit.excess((0.0, -2.0), 1.0) is None
    assert limit.excess((0.0, -2.5), 1.0) == Excess(1, 2.5, 2.0, 1.0, False)
    assert limit.excess((0.0, -2.5), 1.0, 1.5) is None
    for way in (1.0, 2.0, 3.0):
        assert limit.excess((way, 0.0), 0.0) is None
        limit.accept((way, 0.0), 0.0)
    assert limit.excess((3.5, 0.0), 0.0) == Excess(0, 3.5, 3.0, 0.0, True)
    assert limit.excess((4.0, 0.0), 1.0) is None


# ---- senders ----


class Graph:
    """A stand-in for the ROS graph, since DDS cannot be stopped between two of its messages."""

    def __init__(self, *names: str, count: int | None = None, unknown: str = "", own: str = "", allowed: bool = False):
        self.names, self.unknown, self.fixed_count, self.asked = names, unknown, count, 0
        self.sender = OneSender("/commands", self.count, self.look_up, allowed, own)

    def count(self) -> int:
        return len(self.names) if self.fixed_count is None else self.fixed_count

    def look_up(self) -> tuple[tuple[str, ...], str]:
        self.asked += 1
        return tuple(sorted(set(self.names))), self.unknown


def test_unnamed_counts_as_another():
    """A publisher that DDS has found but not named, or that is no ROS node, counts as another sender."""
    graph = Graph("/left/controller", UNKNOWN_NAME)
    sender = graph.sender
    sender.update(0.0)
    assert sender.problem == "several publishers of /commands: /left/controller, _NODE_NAME_UNKNOWN_"
    assert reason(sender, Sample(0.0)) == "several_publishers"
    graph.names = ("/left/controller", "/left/controller")
    sender.update(0.1)
    assert (sender.problem, sender.names) == ("", ("/left/controller",))
    graph.names = (UNKNOWN_NAME,)
    for _ in range(2):
        sender.update(0.2)
    assert not sender.problem, "alone, it is the one who commands"
    assert graph.asked == 4, "its name may become known"
    graph.names = ("/left/controller",)
    for _ in range(3):
        sender.update(0.25)
    assert graph.asked == 5, "the name of the only publisher is known"
    graph.names = ()
    sender.update(0.3)
    assert (sender.names, graph.asked) == ((), 5)
    graph.names, graph.unknown = ("/a",), "no name"
    for _ in range(2):
        sender.update(0.4)
    assert (sender.problem, graph.asked) == ("the publisher of /commands is unknown: no name", 7)
    assert reason(sender, Sample(0.4)) == "unknown_publisher"
    several = Graph("/a", "/b", allowed=True).sender
    several.update(0.0)
    assert (several.problem, several.names) == ("", ("/a", "/b"))


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
    graph.names, graph.fixed_count = ("/stranger",), 1  # its own publisher is not discovered yet
    graph.sender.update(0.3)
    assert graph.sender.problem


NUMBERS = {
    "one publisher": ([1, 2, 3, 4], 0, 0.0),
    "joined late": ([70, 71, 72], 0, 0.0),
    "three missed": ([1, 2, 6, 7], 3, 0.0),
    "restarted": ([500, 501, 1, 2, 3], 0, 0.0),
    "restarted, one missed": ([500, 1, 3, 4], 1, 0.0),
    "an old one, 1 s later": ([500, *range(1, 101), 501], 400, 0.0),
    "an old one, 0.99 s later": ([500, *range(1, 100), 501], 0, 1.0),
    "two that began together": ([1, 1, 2, 2, 3, 3], 0, 0.05),
    "an old and a new one": ([500, 1, 501, 2, 502], 0, 0.04),
    "a fast and a slow one": ([500, 1, 2, 3, 4, 501, 5, 6, 7], 0, 0.06),
    "both miss": ([500, 1, 503, 3], 3, 0.03),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_sequence_numbers_tell(case):
    """Sequence numbers, counted by hand, distinguish two senders of one name from one sender and its stale entry.

    Two senders are refused until 2 s after the last change of turn.
    """
    numbers, missed, turned = NUMBERS[case]
    graph = Graph("/a", "/a")
    graph.sender.update(0.0)
    found = [graph.sender.receive(number, 0.01 * n) for n, number in enumerate(numbers)]
    two = "two publishers of /commands send in turn, both called /a" if turned else ""
    assert (graph.sender.missed, any(found), graph.sender.problem) == (missed, bool(turned), two)
    assert graph.sender.missing(0.01 * len(numbers)) is (missed > 0)
    for late, problem in ((1.99, two), (2.01, "")):
        graph.sender.update(turned + late)
        assert graph.sender.problem == problem


def test_two_of_one_name_are_refused_where_the_middleware_does_not_count():
    """Without sequence numbers (rmw_cyclonedds) two publishers of one name are refused, a single one is accepted."""
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


def test_what_happened_while_nobody_asked_holds_once():
    """An event is recent for less than 1 s, and at least until the next query."""
    lately = EventWindow()
    lately.note(1.0)
    assert lately.holds(6.0)
    assert lately.holds(6.0)
    assert not lately.holds(6.05)
    lately.note(10.0)
    assert [lately.holds(now) for now in (10.0, 10.5, 10.999, 11.0)] == [True, True, True, False]
