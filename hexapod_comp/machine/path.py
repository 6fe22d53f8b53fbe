"""Least-time straight motions between tool poses, from rest to rest, within the struts' speed, acceleration and jerk.

A leg is a straight line of one point of the tool, its tip or another pivot, and the shortest turn about that point; s
from 0 to 1 is the share of both. The struts' lengths and three derivatives by s are closed forms. Speed and
acceleration without jerk are time-optimal path parameterisation by reachability (Pham & Pham 2018): on a grid of s a
backward pass finds the largest ṡ² from which the end can still be reached, and a forward pass uses the largest
acceleration. A moving average over a time w then turns a change of acceleration by A into a jerk of A/w. Averaging
lengthens the motion, so the optimum before it uses only a share of the limits of speed and acceleration (a short move
has no time to reach them). A search finds the share that gives the shortest motion; for one strut this is the optimal
profile of seven phases. Any remaining excess over a limit is removed by running the whole motion more slowly, so that
no limit is ever exceeded, whatever the search found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..errors import GeometryError, PoseError
from ..pose import Pose, attitude_error, rotation_from_vector
from .geometry import HexapodGeometry
from .trajectory import SHARE_OF_LIMIT, Path

# If the machine file has no limit: times in which a strut reaches its speed, and its acceleration, s
SPEED_UP, JERK_UP = 0.1, 0.02
SECTIONS, MOST_SECTIONS = 200, 4000  # Sections of a leg, and of a program, between which ṡ² is linear in s
SPREADS = (1.0, 0.3, 0.1)  # Range of the search around the best so far, in logarithms of a share of a limit
CANDIDATES = 6  # Each way in one round of the search
SLACK = 1e-4  # Factor by which limits are tightened: s is checked at the grid's times and between, not everywhere
DELAYS = 8  # Times at which a stop may begin to slow down, within a window of the average and again up to the end
HALVINGS = 10  # Divisions of the span in which the shortest stop from each time is searched for
SHORTEST = 1e-3  # Share of that span below which the search ends
# A solution found at few times is checked at all, and over this factor of its length
LENGTHENED = (1.0, 1.01, 1.03, 1.1)
COARSE, FINE = 24, 200  # Times of a stop that are checked during the search, and in the end
HALF_TURN = 1e-6  # Within this of 180°, rad, there are two shortest turns


@dataclass(frozen=True)
class StrutRates:
    """Limits of every strut.

    Parameters
    ----------
    speed, acceleration : float
        m/s and m/s².
    jerk : float, optional
        m/s³; infinite: not limited.

    Raises
    ------
    GeometryError
        A rate that is not positive; a speed or acceleration that is not finite.
    """

    speed: float
    acceleration: float
    jerk: float = np.inf

    def __post_init__(self) -> None:
        for name, unit in (("speed", "m/s"), ("acceleration", "m/s²"), ("jerk", "m/s³")):
            value = getattr(self, name)
            if not (value > 0.0 and (name == "jerk" or np.isfinite(value))):
                raise GeometryError(name, f"must be positive{'' if name == 'jerk' else ' and finite'}, {unit}", value)

    @staticmethod
    def of(geometry: HexapodGeometry, rate: float, share: float = SHARE_OF_LIMIT) -> StrutRates:
        """Return a share of the machine's limits at a rate of commands, Hz; the rest is left to the corrections.

        Where the machine file has no acceleration, a strut takes 0.1 s to reach its speed; where it has no jerk,
        0.02 s to reach its acceleration. The largest step of a command limits the speed too.
        """
        limits = geometry.limits
        if not (np.isfinite(rate) and rate > 0.0):
            raise GeometryError("rate", "must be finite and positive, Hz", rate)
        if not 0.0 < share <= 1.0:
            raise GeometryError("share", "must lie in (0, 1]", share)
        acceleration = limits.acceleration or limits.speed / SPEED_UP
        jerk = limits.jerk or acceleration / JERK_UP
        return StrutRates(share * min(limits.speed, limits.step * rate), share * acceleration, share * jerk)

    def excess(self, speed: np.ndarray, acceleration: np.ndarray, jerk: np.ndarray) -> np.ndarray:
        """Return the factor by which a motion must be slowed to keep the rates: largest over the last two axes."""
        most = [np.abs(values).max(axis=(-2, -1)) for values in (speed, acceleration, jerk)]
        roots = most[0] / self.speed, (most[1] / self.acceleration) ** 0.5, (most[2] / self.jerk) ** (1.0 / 3.0)
        return np.max(roots, axis=0)


class Leg:
    """A straight leg between two tool poses: a pivot on a line, and the shortest turn about it."""

    def __init__(self, geometry: HexapodGeometry, start: Pose, end: Pose, pivot: np.ndarray) -> None:
        self.start, self.end, self.pivot = start, end, pivot
        self.turn = attitude_error(end.rotation, start.rotation)  # In ``work``
        if np.linalg.norm(self.turn) > np.pi - HALF_TURN:
            raise PoseError("a turn by 180° has two shortest ways: give a pose in between", np.degrees(self.turn))
        self.origin = start.position + start.rotation @ pivot
        self.travel = end.position + end.rotation @ pivot - self.origin
        # In ``work``: base joints, and platform joints seen from the pivot
        self.base = (geometry.base_joints - geometry.work.position) @ geometry.work.rotation
        in_tool = (geometry.platform_joints - geometry.tool.position) @ geometry.tool.rotation
        self.arms = (in_tool - pivot) @ start.rotation.T

    def poses(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's positions, (n, 3), and rotations, (n, 3, 3), at shares s; at 0 and 1 as given."""
        rotations = rotation_from_vector(s[:, None] * self.turn) @ self.start.rotation
        positions = self.origin + s[:, None] * self.travel - rotations @ self.pivot
        for at, pose in ((0.0, self.start), (1.0, self.end)):
            positions[s == at], rotations[s == at] = pose.position, pose.rotation
        return positions, rotations

    def struts(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the struts' nominal lengths and their first three derivatives by s, each (n, 6)."""
        arms = np.einsum("nij,kj->nki", rotation_from_vector(s[:, None] * self.turn), self.arms)
        d = self.origin + s[:, None, None] * self.travel + arms - self.base
        swing = np.cross(self.turn, arms)
        d1, d2, d3 = self.travel + swing, np.cross(self.turn, swing), -(self.turn @ self.turn) * swing

        def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return np.asarray((a * b).sum(axis=2))

        # Derivatives of L² = d·d
        q = np.sqrt(dot(d, d))
        q1 = dot(d, d1) / q
        q2 = (dot(d1, d1) + dot(d, d2) - q1 * q1) / q
        q3 = (3.0 * dot(d1, d2) + dot(d, d3) - 3.0 * q1 * q2) / q
        return q, q1, q2, q3


class Course:
    """The path of a program: a smooth curve through tool poses, with s the share of the program's own time."""

    def __init__(self, geometry: HexapodGeometry, poses: Sequence[Pose], times: Sequence[float]) -> None:
        from scipy.interpolate import CubicSpline, make_interp_spline  # half a second that moves alone need not load
        from scipy.spatial.transform import Rotation, RotationSpline

        shares = (np.asarray(times, dtype=float) - times[0]) / (times[-1] - times[0])
        self._ends = poses[0], poses[-1]
        self._line = CubicSpline(shares, [pose.position for pose in poses], bc_type="clamped")
        self._turns = RotationSpline(shares, Rotation.from_matrix(np.array([pose.rotation for pose in poses])))
        self.longest = 1.0 / (times[-1] - times[0])  # ṡ that the program's own times allow
        self.sections = int(np.clip(4 * len(poses), SECTIONS, MOST_SECTIONS))
        fine = np.linspace(0.0, 1.0, 4 * self.sections + 1)
        base = (geometry.base_joints - geometry.work.position) @ geometry.work.rotation
        in_tool = (geometry.platform_joints - geometry.tool.position) @ geometry.tool.rotation
        positions, rotations = self.poses(fine)
        joints = positions[:, None] + np.einsum("nij,kj->nki", rotations, in_tool)
        self._lengths = make_interp_spline(fine, np.linalg.norm(joints - base, axis=2), k=5)

    def poses(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's positions, (n, 3), and rotations, (n, 3, 3), at shares s; at 0 and 1 as given."""
        positions, rotations = self._line(s), self._turns(s).as_matrix()
        for at, pose in zip((0.0, 1.0), self._ends, strict=True):
            positions[s == at], rotations[s == at] = pose.position, pose.rotation
        return positions, rotations

    def struts(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the struts' nominal lengths and their first three derivatives by s, each (n, 6)."""
        q, q1, q2, q3 = (self._lengths(s, nu=order) for order in range(4))
        return q, q1, q2, q3


def time_optimal(
    q1: np.ndarray, q2: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, fastest: float = np.inf
) -> np.ndarray:
    """Return ṡ², (N + 1, C), on N equal sections of s from rest to rest, for C pairs of limits.

    q1 and q2, (N + 1, 6), are the struts' derivatives by s. Each section's acceleration is checked against the limits
    at both its ends; ṡ is nowhere above `fastest`.
    """
    sections = len(q1) - 1
    width = 2.0 / sections  # ṡ² grows by this times s̈
    a = np.concatenate([q1[:-1], q1[1:] + width * q2[1:]], axis=1)  # Each limit is |a s̈ + b ṡ²| ≤ acceleration
    b = np.concatenate([q2[:-1], q2[1:]], axis=1)
    b, a = np.where(a < 0.0, -b, b), np.maximum(np.abs(a), 1e-12 * np.abs(q1).max())
    slope = (b / a)[:, :, None]  # The limits are −most − slope ṡ² ≤ s̈ ≤ most − slope ṡ²
    most = acceleration / a[:, :, None]
    highest = np.minimum(speed / np.maximum(np.abs(q1), 1e-300).max(axis=1)[:, None], fastest) ** 2
    with np.errstate(divide="ignore", over="ignore"):
        for i in range(a.shape[1]):  # Intersections of one strut's upper limit with another's lower one
            fall = slope[:, [i]] - slope
            meet = np.where(fall > 0.0, (most[:, [i]] + most) / np.maximum(fall, 1e-300), np.inf)
            np.minimum(highest[:-1], meet.min(axis=1), out=highest[:-1])
    highest[-1] = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        for n in range(sections - 1, -1, -1):
            # ṡ² + width s̈ must lie in [0, highest[n + 1]], at the least and at the largest s̈
            fall = 1.0 / width - slope[n]
            reach = np.where(fall > 0.0, (highest[n + 1] / width + most[n]) / fall, np.inf)
            rest = np.where(-fall > 0.0, most[n] / -fall, np.inf)
            highest[n] = np.minimum(highest[n], np.minimum(reach, rest).min(axis=0))
    square = np.zeros_like(highest)
    for n in range(sections):
        largest = (most[n] - slope[n] * square[n]).min(axis=0)
        square[n + 1] = np.clip(square[n] + width * largest, 0.0, highest[n + 1])
    return square


@dataclass(frozen=True)
class Profile:
    """s over time: sections of constant acceleration, averaged over a window, run `slowed` times as slowly."""

    times: np.ndarray  # (N + 1,) at which sections begin and the last one ends, s
    speeds: np.ndarray  # (N + 1,) ṡ there
    window: float  # s; 0: not averaged
    slowed: float = 1.0

    @staticmethod
    def of(square: np.ndarray, window: float) -> Profile:
        """Return the profile of ṡ² on equal sections of s."""
        speeds = np.sqrt(square)
        steps = 2.0 / (len(square) - 1) / np.maximum(speeds[1:] + speeds[:-1], 1e-300)
        return Profile(np.concatenate([[0.0], np.cumsum(steps)]), speeds, window)

    @property
    def duration(self) -> float:
        """Time from rest to rest, s."""
        return float(self.times[-1] + self.window) * self.slowed

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return s and its first three derivatives by time."""
        times = np.asarray(times) / self.slowed
        v, steps = self.speeds, np.diff(self.times)
        a = np.diff(v) / steps
        s = np.linspace(0.0, 1.0, len(v))

        def integrals(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
            n = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(a) - 1)
            inside = (t >= 0.0) & (t < self.times[-1])
            dt = np.clip(t, 0.0, self.times[-1]) - self.times[n]
            areas = np.concatenate([[0.0], np.cumsum(steps * (s[:-1] + steps * (v[:-1] / 2.0 + steps * a / 6.0)))])
            area = areas[n] + dt * (s[n] + dt * (v[n] / 2.0 + dt * a[n] / 6.0)) + np.maximum(t - self.times[-1], 0.0)
            return area, s[n] + dt * (v[n] + dt * a[n] / 2.0), v[n] + dt * a[n], np.where(inside, a[n], 0.0)

        now = integrals(times)
        if self.window:
            before = integrals(times - self.window)
            share, speed, bend, jerk = ((x - y) / self.window for x, y in zip(now, before, strict=True))
        else:
            (_, share, speed, bend), jerk = now, np.zeros_like(times)
        share = np.where(times <= 0.0, 0.0, np.where(times >= self.times[-1] + self.window, 1.0, share))
        return np.clip(share, 0.0, 1.0), speed / self.slowed, bend / self.slowed**2, jerk / self.slowed**3

    def breaks(self) -> np.ndarray:
        """Return the times just after and before which a derivative jumps, and those halfway between."""
        edges = np.unique(np.concatenate([self.times, self.times + self.window] if self.window else [self.times]))
        near = 1e-9 * edges[-1]
        return (
            np.sort(np.concatenate([edges[:-1] + near, edges[1:] - near, (edges[1:] + edges[:-1]) / 2.0])) * self.slowed
        )


def strut_motion(
    leg: Leg | Course, s: np.ndarray, v: np.ndarray, a: np.ndarray, j: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the struts' speeds, accelerations and jerks, each (n, 6), of s and its derivatives by time, each (n,)."""
    _, q1, q2, q3 = leg.struts(s)
    v, a, j = v[:, None], a[:, None], j[:, None]
    return q1 * v, q1 * a + q2 * v**2, q1 * j + 3.0 * q2 * v * a + q3 * v**3


@dataclass(frozen=True)
class Motion:
    """A straight motion in time, from rest to rest, as :func:`plan_motion` returns it.

    Attributes
    ----------
    leg : Leg or Course
        The way.
    profile : Profile
        The share of the way over time.
    rates : StrutRates
        What the struts may do.
    """

    leg: Leg | Course
    profile: Profile
    rates: StrutRates

    @property
    def duration(self) -> float:
        """Time from start to end, s."""
        return self.profile.duration

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's positions, (n, 3), and rotations, (n, 3, 3), at times since the start, s."""
        return self.leg.poses(self.profile.at(np.asarray(times, dtype=float))[0])

    def sample(self, rate: float) -> Path:
        """Return the poses to send at a rate, Hz, start and end included; the last period may be shorter."""
        return Path(*self.at(_ticks(self.duration, rate)), rate)

    def stop(self, now: float, rate: float) -> Path:
        """Return the poses, at a rate in Hz, that brake the motion to rest on its path, from the time `now` on.

        The motion's own time is slowed to a halt, as early as the struts' rates allow; while it brakes at the limit
        anyway, the slowing begins later, at the latest when the motion ends by itself.
        """
        if not 0.0 <= now <= self.duration:
            raise GeometryError("now", f"must lie in the motion's 0…{self.duration:.6g} s", now)
        left = self.duration - now
        to_its_end = Path(*self.at(now + _ticks(left, rate)), rate)
        if len(to_its_end) <= 2:  # Nothing is sent before the end
            return to_its_end
        window = self.profile.window * self.profile.slowed
        delays = np.unique(
            np.concatenate([np.linspace(0.0, window, DELAYS // 2 + 1), np.linspace(0.0, left, DELAYS, endpoint=False)])
        )
        delays = delays[delays < left]
        # The struts' derivatives by time, computed once: those of any slowed motion are sums and products of them
        moments = now + left * np.linspace(0.0, 1.0, SECTIONS + 1)
        known = strut_motion(self.leg, *self.profile.at(moments))
        shares = np.linspace(0.0, 1.0, COARSE)

        def kept(lengths: np.ndarray) -> np.ndarray:
            clock, *rates = _slowing(delays[:, None] + lengths[:, None] * shares, delays[:, None], lengths[:, None])
            at = np.minimum((clock * (SECTIONS / left) + 0.5).astype(int), SECTIONS)
            found = _slowed([q[at] for q in known], *(r[:, :, None] for r in rates))
            return np.asarray(self.rates.excess(*found) <= 1.0)

        low, high = (left - delays) * SHORTEST, left - delays
        useful = kept(high)
        for _ in range(HALVINGS):
            middle = np.sqrt(low * high)
            good = kept(middle)
            low, high = np.where(good, low, middle), np.where(good, middle, high)
        for n in np.argsort(delays + high)[: np.count_nonzero(useful)] if useful.any() else ():
            for longer in LENGTHENED:
                delay, length = float(delays[n]), float(high[n] * longer)
                if useful[n] and delay + length < left and self._kept(now, delay, length):
                    since = _ticks(delay + length, rate)
                    return Path(*self.at(now + _slowing(since, delay, length)[0]), rate)
        return to_its_end

    def _kept(self, now: float, delay: float, length: float) -> bool:
        """Return whether the rates are kept when slowing begins after the delay, s, and is finished `length` later."""
        shares = np.linspace(0.0, 1.0, FINE)
        edges = self.profile.breaks() - now - delay
        edges = edges[(edges > 0.0) & (edges < length / 2.0)]
        gone, *_ = _slowing(shares, 0.0, 1.0)
        shares = np.concatenate([shares, np.interp(edges / length, gone, shares)])
        clock, *rates = _slowing(delay + length * shares, delay, length)
        clock[FINE:] = delay + edges  # On the side of the break on which they are
        known = strut_motion(self.leg, *self.profile.at(now + clock))
        return bool(self.rates.excess(*_slowed(known, *(r[:, None] for r in rates))) <= 1.0)


def _slowed(
    known: Sequence[np.ndarray], r: np.ndarray, r1: np.ndarray, r2: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return speeds, accelerations and jerks on a clock of rate r, with its derivatives, from those on time's own."""
    v, a, j = known
    return v * r, a * r**2 + v * r1, j * r**3 + 3.0 * a * r * r1 + v * r2


def _ticks(duration: float, rate: float) -> np.ndarray:
    """Return the times of a rate's ticks, s, and for the last one the duration itself."""
    return np.minimum(np.arange(int(np.ceil(duration * rate * (1.0 - 1e-12))) + 1) / rate, duration)


def _slowing(
    since: np.ndarray, delay: float | np.ndarray, length: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the time passed of a motion whose clock halts, and that clock's rate with two derivatives."""
    x = np.clip((since - delay) / length, 0.0, 1.0)
    gone = np.minimum(since, delay) + length * (x - x**3 + x**4 / 2.0)
    inside = (since >= delay).astype(float)
    rate = 1.0 - x * x * (3.0 - 2.0 * x)
    return gone, rate, -6.0 * x * (1.0 - x) / length * inside, -6.0 * (1.0 - 2.0 * x) / length**2 * inside


def plan_motion(
    geometry: HexapodGeometry,
    poses: Sequence[Pose],
    rates: StrutRates,
    pivot: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
) -> list[Motion]:
    """Return the least-time motions through tool poses, with a rest at each.

    Between two poses the pivot goes straight and the tool turns the shortest way about it. Neither strokes nor joints
    are checked: use :func:`hexapod_comp.check`, with the mode ``stream``, on the poses to send.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine, with the tool and the work frame that are used.
    poses : sequence of Pose
        ``pose_tool_in_work``, from where the tool stands on. Equal neighbours give no motion.
    rates : StrutRates
        What the struts may do.
    pivot : array_like, shape (3,)
        The point that goes straight, in the tool's frame, m; the tool's tip by default.

    Raises
    ------
    GeometryError
        A pivot that is not three finite numbers; a machine with a strut of no length on the way.
    PoseError
        A turn by 180°, which has two shortest ways.
    """
    point = np.asarray(pivot, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise GeometryError("pivot", "must be three finite numbers, m", point.tolist())
    legs = [Leg(geometry, a, b, point) for a, b in pairwise(poses)]
    return [Motion(leg, _fastest(leg, rates), rates) for leg in legs if leg.travel.any() or leg.turn.any()]


def plan_program(geometry: HexapodGeometry, poses: Sequence[Pose], times: Sequence[float], rates: StrutRates) -> Motion:
    """Return the motion along a program of tool poses with times, from rest to rest.

    The tool goes on a smooth curve through the poses, never ahead of the program's own pace, and slows down where a
    strut would be too fast.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine, with the tool and the work frame that are used.
    poses : sequence of Pose
        ``pose_tool_in_work``; neighbours turned by less than 180°.
    times : sequence of float
        Ascending, s.
    rates : StrutRates
        What the struts may do.

    Raises
    ------
    GeometryError
        Fewer than two poses, other times than poses, or times that do not ascend.
    """
    if not (len(poses) == len(times) >= 2 and np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
        raise GeometryError("times", "must ascend and be as many as the poses, at least 2", list(times)[:5])
    course = Course(geometry, poses, times)
    return Motion(course, _fastest(course, rates, course.sections, course.longest), rates)


def _fastest(leg: Leg | Course, rates: StrutRates, sections: int = SECTIONS, fastest: float = np.inf) -> Profile:
    """Return the profile of least time along a leg, with ṡ no more than `fastest`."""
    _, q1, q2, _ = leg.struts(np.linspace(0.0, 1.0, sections + 1))
    largest = np.abs(q1).max()
    if not (np.isfinite(largest) and largest > 0.0):
        raise GeometryError("poses", "must move the struts by finite lengths", float(largest))
    if not np.isfinite(rates.jerk):
        square = time_optimal(q1, q2, np.array([rates.speed]), np.array([rates.acceleration]), fastest)
        return _kept_within(leg, Profile.of(square[:, 0], 0.0), rates, fastest)
    # Seven phases of the strut that moves furthest, as if its length were linear in s: the start of the search
    way = largest
    acceleration = min(
        rates.acceleration, (rates.jerk**2 * way / 2.0) ** (1.0 / 3.0), (rates.speed * rates.jerk) ** 0.5
    )
    ramp = acceleration / rates.jerk
    speed = min(rates.speed, acceleration * (np.sqrt(ramp**2 + 4.0 * way / acceleration) - ramp) / 2.0)
    best = Profile(np.array([np.inf]), np.zeros(1), 0.0)
    for spread in SPREADS:
        around = np.exp(spread * np.linspace(-1.0, 1.0, CANDIDATES + 1))
        tried_a, tried_v = np.meshgrid(
            np.unique(np.minimum(acceleration * around, rates.acceleration)),
            np.unique(np.minimum(speed * around, rates.speed)),
        )
        squares = time_optimal(q1, q2, tried_v.ravel(), tried_a.ravel(), fastest)
        for square, v, a in zip(squares.T, tried_v.ravel(), tried_a.ravel(), strict=True):
            found = Profile.of(square, float(a / rates.jerk))
            if found.duration < best.duration:
                found = _kept_within(leg, found, rates, fastest)
            if found.duration < best.duration:
                best, speed, acceleration = found, float(v), float(a)
    return best


def _kept_within(leg: Leg | Course, profile: Profile, rates: StrutRates, fastest: float) -> Profile:
    """Return a profile, run slowly enough for the rates and `fastest`; a slower one scales all derivatives by time."""
    excess = float(rates.excess(*strut_motion(leg, *profile.at(profile.breaks()))))
    slowed = max(excess * (1.0 + SLACK), float(profile.speeds.max()) / fastest)
    return Profile(profile.times, profile.speeds, profile.window, slowed)
