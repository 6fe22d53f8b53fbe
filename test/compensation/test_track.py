"""What the track of the struts answers: can they stand so, do they follow, do they stand, where does a start begin."""

from __future__ import annotations

import numpy as np
import pytest

from hexapod_comp.compensation.guards import Sample
from hexapod_comp.compensation.track import FOLLOWED_WITHIN, StrutTrack
from hexapod_comp.errors import CommandError, LimitError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry

SECOND = 10**9


def six(length: float, way: float = 0.0, strut: int = 2) -> tuple[float, ...]:
    return tuple(length + way * (n == strut) for n in range(6))


def read(track: StrutTrack, struts, at: float, age: float = 0.0) -> None:
    sample = Sample(at, 0, tuple(struts))
    sample.age = age
    track.accept(sample)


# ---- readings that cannot be ----


@pytest.mark.parametrize(
    ("jump", "by_stamp", "by_arrival", "passes"),
    [
        (2.9e-3, 0.0, 0.002, True),  # 2 mm + 2 ms · 500 mm/s = 3 mm
        (3.1e-3, 0.0, 0.002, False),
        (10e-3, 0.020, 0.0, True),  # delivered at once after a pause: 12 mm in the 20 ms between their stamps
        (13e-3, 0.020, 0.0, False),
        (50e-3, 0.002, 0.1, True),  # 52 mm
        (1e30, 0.1, 0.1, False),
    ],
)
def test_struts_move_no_faster_than_they_can(jump, by_stamp, by_arrival, passes):
    """The paper's machine: 2 mm per command, 250 mm/s, and twice that by hand."""
    track = StrutTrack(load_geometry(config_file("paper.yaml")))
    track.check_jump(Sample(0.0, 0, six(7.0)))  # nothing is known yet
    track.accept(Sample(1.0, 5 * SECOND, six(0.5)))
    sample = Sample(1.0 + by_arrival, round((5 + by_stamp) * 1e9), six(0.5, -jump, 4))
    if passes:
        track.check_jump(sample)
        return
    with pytest.raises(LimitError, match="strut_5 has jumped by") as caught:
        track.check_jump(sample)
    assert (caught.value.reason, caught.value.strut) == ("jump", 4)


def test_no_strut_is_longer_or_shorter_than_it_can_be():
    geometry = load_geometry(config_file("paper.yaml"))
    track, limits = StrutTrack(geometry), geometry.limits
    low, high = limits.stroke[3] + np.array([-1.0, 1.0]) * limits.correction
    for length, wrong in ((low + 1e-6, False), (low - 1e-6, True), (high - 1e-6, False), (high + 1e-6, True)):
        struts = list(limits.stroke.mean(axis=1))
        struts[3] = length
        if not wrong:
            track.check_stroke(struts)
            continue
        with pytest.raises(LimitError, match="strut_4 cannot be") as caught:
            track.check_stroke(struts)
        assert caught.value.reason == "stroke"


# ---- following ----


def test_lag_is_no_following_error():
    """At 0.1 m/s a strut is 5 mm behind after 50 ms: right, since that was commanded in the last 0.1 s."""
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
            with pytest.raises(CommandError, match="from its command, allowed 1 mm; until ~/reset") as caught:
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
    """More than 50 µm in 0.1 s, told or measured; what was long ago does not count."""
    track = StrutTrack()
    assert track.moving(1.0) == ""
    for n in range(100):
        track.add_command(six(0.5, 1e-6 * n), 1.0 + 1e-3 * n)
    assert track.moving(1.04) == "strut_3 was told to go 0.099 mm in the last 0.1 s"
    assert track.moving(1.1 + FOLLOWED_WITHIN) == ""
    read(track, six(0.5), 2.0)
    read(track, six(0.5 + 49e-6), 2.05)
    assert track.moving(2.05) == ""
    read(track, six(0.5 - 2e-6), 2.06)
    assert track.moving(2.06) == "strut_1 went 0.051 mm in the last 0.1 s"


# ---- where a start begins ----


def test_a_wait_for_feedback_has_an_end_where_a_parameter_says_so():
    """By a clock of its own: 2 s after the start, not before it; a single reading ends it for good."""
    track = StrutTrack(anywhere_after=2.0)
    with pytest.raises(CommandError, match="from 2 s after the start on") as caught:
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
    with pytest.raises(CommandError, match="needs start_without_feedback_after"):
        StrutTrack().start(1e9, fresh=False)


def test_a_start_from_struts_at_rest_is_from_the_mean_of_their_readings():
    """Truth: 0.5 m, read 200 times with a noise of 0.1 µm; then a strut goes 10 µm away, and the newest counts."""
    rng, track = np.random.default_rng(3), StrutTrack()
    for n in range(200):
        read(track, 0.5 + rng.normal(0.0, 1e-7, 6), 7.0 + 0.002 * n)
    assert np.abs(track.start(8.0, fresh=True) - 0.5).max() < 3e-8, "0.1 µm / √200 is 7 nm"
    away = six(0.5, 1e-5)
    read(track, away, 7.4)
    np.testing.assert_array_equal(track.start(8.0, fresh=True), away)
    read(track, away, 9.0)  # what came before is past
    np.testing.assert_array_equal(track.start(9.0, fresh=True), away)


@pytest.mark.parametrize(
    ("measured_at", "fresh", "wanted"),
    [
        (9.89, True, "told"),  # readings of a minute may count as fresh, but the struts have been sent elsewhere since
        (9.91, True, "measured"),
        (10.05, False, "told"),  # the drive may have lagged still when it was last heard
        (10.11, False, "measured"),  # it was there, or somebody has moved it since
    ],
)
@pytest.mark.parametrize("late", [0.0, 0.3])
def test_what_is_known_last_counts(measured_at, fresh, wanted, late):
    """A drive follows and tells within 0.1 s; the last command was at 10 s. A reading counts from when it was made."""
    track = StrutTrack()
    track.add_command(six(0.4), 10.0)
    track.reset()
    np.testing.assert_array_equal(track.start(11.0, fresh), 0.4)
    read(track, six(0.5), measured_at + late, age=late)
    np.testing.assert_array_equal(track.start(11.0, fresh), 0.4 if wanted == "told" else 0.5)
