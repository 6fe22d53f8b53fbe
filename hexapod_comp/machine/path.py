"""Least-time straight motions between tool poses, within the struts' limits of speed, acceleration and jerk.

On a leg, one point of the tool (its tip or another pivot) moves along a straight line, and the tool makes the shortest
turn about that point. The path parameter s goes from 0 to 1 along the leg. Closed forms give the struts' lengths and
their first three derivatives with respect to s. If jerk is not limited, the motion comes from time-optimal path
parameterisation by reachability (Pham & Pham 2018). On a grid of s, a backward pass finds the largest ṡ² from which the
end can still be reached; a forward pass then accelerates as much as this ṡ² and the limits allow. If jerk is limited, a
moving average over a time w follows: it turns a step of the acceleration by A into a jerk A/w, and makes the motion
last longer by w. The lower the acceleration, the shorter w may be, so a search finds the acceleration and speed with
the shortest motion; for one strut this is the optimal profile of seven phases. Finally the motion is slowed down until
all struts keep their limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..errors import GeometryError, PoseError
from ..pose import Pose, attitude_error, rotation_from_vector, stacked
from .geometry import HexapodGeometry
from .trajectory import SHARE_OF_LIMIT, Path, check_rate

# If the machine file limits no acceleration or no jerk: times, s, to the largest speed and to the largest acceleration
SPEED_UP, JERK_UP = 0.1, 0.02
SECTIONS, MOST_SECTIONS = 200, 4000  # Sections of a leg; most sections of a program; ṡ² is linear in s on each section
# Each round of the search tries speeds and accelerations from e^−spread to e^spread times the best values so far
SPREADS = (1.0, 0.3, 0.1)
CANDIDATES = 6  # Each round tries seven speeds and seven accelerations, at six equal intervals of their logarithms
SLACK = 1e-4  # Share of extra slowing, because the largest excess over a limit may lie between two checked times
DELAYS = 8  # Number of moments up to the motion's end at which a stop may begin; 4 more lie in the averaging window
HALVINGS = 10  # Bisections in the search for the shortest stop that begins at a given time
SHORTEST = 1e-3  # Shortest stop tried, as a share of the motion's remaining time
# A stop is checked at `COARSE` times, then at `FINE` times; a stop that then breaks a limit is lengthened by factors
LENGTHENED = (1.0, 1.01, 1.03, 1.1)
COARSE, FINE = 24, 200
HALF_TURN = 1e-6  # A turn nearer to 180° than this, rad, is refused, as it has two shortest ways


@dataclass(frozen=True)
class StrutRates:
    """Limits of speed, acceleration and jerk, the same for all struts.

    Parameters
    ----------
    speed, acceleration : float
        Largest speed, m/s, and largest acceleration, m/s², of a strut.
    jerk : float, optional
        Largest jerk, m/s³, of a strut; infinite if jerk is not limited.

    Raises
    ------
    GeometryError
        A limit is not positive, or speed or acceleration is not finite.
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
        """Return `share` times the machine's limits for commands at a rate, Hz; corrections need the remaining share.

        The limit of the step between two commands also limits the speed. A missing limit of acceleration becomes the
        largest speed / 0.1 s, and a missing limit of jerk the largest acceleration / 0.02 s.
        """
        limits = geometry.limits
        check_rate(rate)
        if not 0.0 < share <= 1.0:
            raise GeometryError("share", "must lie in (0, 1]", share)
        acceleration = limits.acceleration or limits.speed / SPEED_UP
        jerk = limits.jerk or acceleration / JERK_UP
        return StrutRates(share * min(limits.speed, limits.step * rate), share * acceleration, share * jerk)

    def excess(self, speed: np.ndarray, acceleration: np.ndarray, jerk: np.ndarray) -> np.ndarray:
        """Return the factor by which a motion must last longer to keep the limits; array axes are …, times, struts."""
        most = [np.abs(values).max(axis=(-2, -1)) for values in (speed, acceleration, jerk)]
        roots = most[0] / self.speed, (most[1] / self.acceleration) ** 0.5, (most[2] / self.jerk) ** (1.0 / 3.0)
        return np.max(roots, axis=0)


def refuse_half_turns(turns: np.ndarray) -> None:
    """Raise PoseError if one of n rotation vectors, (n, 3), rad, each from a pose to the next, is a turn by 180°."""
    for turn in turns[np.linalg.norm(turns, axis=1) > np.pi - HALF_TURN]:
        raise PoseError("a turn by 180° has two shortest ways: add a pose in between", np.degrees(turn).tolist())


class Leg:
    """A straight leg between two tool poses: the pivot moves along a line, and the tool turns about the pivot."""

    def __init__(self, geometry: HexapodGeometry, start: Pose, end: Pose, pivot: np.ndarray) -> None:
        self.start, self.end, self.pivot = start, end, pivot
        self.turn = attitude_error(end.rotation, start.rotation)  # in ``work``
        refuse_half_turns(self.turn[None])
        self.origin = start.position + start.rotation @ pivot
        self.travel = end.position + end.rotation @ pivot - self.origin
        # A strut's vector is fixed + s travel + cos(angle s) across + sin(angle s) ahead, in ``work``, so half of
        # the square of its length is made of these terms: a polynomial in s, and factors of the cosine and the sine
        self.angle = float(np.linalg.norm(self.turn))
        axis = self.turn / (self.angle or 1.0)
        in_tool = (geometry.platform_joints - geometry.tool.position) @ geometry.tool.rotation
        arms = (in_tool - pivot) @ start.rotation.T
        along = np.outer(arms @ axis, axis)
        fixed = self.origin + along - (geometry.base_joints - geometry.work.position) @ geometry.work.rotation
        across, ahead = arms - along, np.cross(axis, arms)
        squares = 0.5 * ((fixed**2).sum(axis=1) + (across**2).sum(axis=1))
        self.polynomial = squares, fixed @ self.travel, 0.5 * (self.travel @ self.travel)
        self.cosine = (fixed * across).sum(axis=1), across @ self.travel
        self.sine = (fixed * ahead).sum(axis=1), ahead @ self.travel

    def poses(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's positions (n, 3), m, and rotations (n, 3, 3) at path parameters s, (n,)."""
        rotations = rotation_from_vector(s[:, None] * self.turn) @ self.start.rotation
        positions = self.origin + s[:, None] * self.travel - rotations @ self.pivot
        for at, pose in ((0.0, self.start), (1.0, self.end)):
            positions[s == at], rotations[s == at] = pose.position, pose.rotation
        return positions, rotations

    def struts(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the struts' nominal lengths at path parameters s, and three derivatives by s, each (n, 6)."""
        s, w = s[:, None], self.angle
        cosine, sine = np.cos(w * s), np.sin(w * s)
        (p0, p1, p2), (c0, dc), (s0, ds) = self.polynomial, self.cosine, self.sine
        of_cosine, of_sine = c0 + dc * s, s0 + ds * s
        half = [p0 + s * (p1 + s * p2) + of_cosine * cosine + of_sine * sine]
        for rest in (p1 + 2.0 * p2 * s, 2.0 * p2, 0.0):  # derivatives of the product of a line and a cosine or sine
            of_cosine, of_sine, dc, ds = dc + w * of_sine, ds - w * of_cosine, w * ds, -w * dc
            half.append(rest + of_cosine * cosine + of_sine * sine)
        q = np.sqrt(2.0 * half[0])
        q1 = half[1] / q
        q2 = (half[2] - q1 * q1) / q
        return q, q1, q2, (half[3] - 3.0 * q1 * q2) / q


class Curve:
    """Smooth curve through the tool poses of a program; s = 0 at the first and s = 1 at the last of the given times."""

    def __init__(self, geometry: HexapodGeometry, poses: Sequence[Pose], times: Sequence[float]) -> None:
        # Imported here, as the imports take 0.5 s and straight moves do not need them
        from scipy.interpolate import CubicSpline, make_interp_spline
        from scipy.spatial.transform import Rotation, RotationSpline

        shares = (np.asarray(times, dtype=float) - times[0]) / (times[-1] - times[0])
        self._ends, (places, attitudes) = (poses[0], poses[-1]), stacked(poses)
        refuse_half_turns(attitude_error(attitudes[1:], attitudes[:-1]))
        self._line = CubicSpline(shares, places, bc_type="clamped")
        self._turns = RotationSpline(shares, Rotation.from_matrix(attitudes))
        self.fastest = 1.0 / (times[-1] - times[0])  # ṡ of a motion that takes exactly the program's time
        self.sections = int(np.clip(4 * len(poses), SECTIONS, MOST_SECTIONS))
        fine = np.linspace(0.0, 1.0, 4 * self.sections + 1)
        base = (geometry.base_joints - geometry.work.position) @ geometry.work.rotation
        in_tool = (geometry.platform_joints - geometry.tool.position) @ geometry.tool.rotation
        positions, rotations = self.poses(fine)
        joints = positions[:, None] + np.einsum("nij,kj->nki", rotations, in_tool)
        self._lengths = make_interp_spline(fine, np.linalg.norm(joints - base, axis=2), k=5)

    def poses(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's positions (n, 3), m, and rotations (n, 3, 3) at path parameters s, (n,)."""
        positions, rotations = self._line(s), self._turns(s).as_matrix()
        for at, pose in zip((0.0, 1.0), self._ends, strict=True):
            positions[s == at], rotations[s == at] = pose.position, pose.rotation
        return positions, rotations

    def struts(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the struts' nominal lengths at path parameters s, and three derivatives by s, each (n, 6)."""
        q, q1, q2, q3 = (self._lengths(s, nu=order) for order in range(4))
        return q, q1, q2, q3


def time_optimal(
    q1: np.ndarray, q2: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, fastest: float = np.inf
) -> np.ndarray:
    """Return ṡ² of C least-time motions from rest to rest, (N + 1, C), at the N + 1 ends of N equal sections of s.

    q1 and q2, (N + 1, 6), are the first two derivatives of the struts' lengths with respect to s. `speed` and
    `acceleration`, (C,), are the limits of the C motions; acceleration is limited at both ends of each section.
    `fastest` is the largest ṡ.
    """
    sections = len(q1) - 1
    width = 2.0 / sections  # over a section, ṡ² grows by width · s̈
    a = np.concatenate([q1[:-1], q1[1:] + width * q2[1:]], axis=1)  # each limit is |a s̈ + b ṡ²| ≤ acceleration
    b = np.concatenate([q2[:-1], q2[1:]], axis=1)
    b, a = np.where(a < 0.0, -b, b), np.maximum(np.abs(a), 1e-12 * np.abs(q1).max())
    slope = (b / a)[:, :, None]  # the limits are −most − slope ṡ² ≤ s̈ ≤ most − slope ṡ²
    most = acceleration / a[:, :, None]
    with np.errstate(divide="ignore", over="ignore"):
        highest = np.minimum(speed / np.abs(q1).max(axis=1)[:, None], fastest) ** 2
        for i in range(a.shape[1]):  # ṡ² at which one strut's upper limit of s̈ meets another strut's lower limit
            fall = slope[:, [i]] - slope
            meet = np.where(fall > 0.0, (most[:, [i]] + most) / fall, np.inf)
            np.minimum(highest[:-1], meet.min(axis=1), out=highest[:-1])
    highest[-1] = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        for n in range(sections - 1, -1, -1):
            # The next ṡ², ṡ² + width s̈, must be ≤ highest[n + 1] for the smallest s̈, and ≥ 0 for the largest s̈
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
    """Path parameter s as a function of time, made in three steps: s̈ is constant on each section; a moving average
    over time smooths s(t); the whole motion is slowed down.
    """

    times: np.ndarray  # (N + 1,): s; ends of the N sections, before averaging and slowing
    speeds: np.ndarray  # (N + 1,): ṡ at `times`
    window: float  # length of the moving average, s; 0: not averaged
    slowed: float = 1.0  # factor by which the whole motion takes longer

    @staticmethod
    def of(square: np.ndarray, window: float) -> Profile:
        """Return the profile whose ṡ² at the ends of N equal sections of s is `square`, (N + 1,)."""
        speeds = np.sqrt(square)
        steps = 2.0 / (len(square) - 1) / np.maximum(speeds[1:] + speeds[:-1], 1e-300)
        return Profile(np.concatenate([[0.0], np.cumsum(steps)]), speeds, window)

    @property
    def duration(self) -> float:
        """Duration from rest to rest, s."""
        return float(self.times[-1] + self.window) * self.slowed

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the path parameter and its first three time derivatives at `times`, in seconds after the start."""
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
        """Return the times, s, just before, just after and halfway between those at which a derivative of s jumps."""
        edges = np.unique(np.concatenate([self.times, self.times + self.window] if self.window else [self.times]))
        near = 1e-9 * edges[-1]
        return (
            np.sort(np.concatenate([edges[:-1] + near, edges[1:] - near, (edges[1:] + edges[:-1]) / 2.0])) * self.slowed
        )


def strut_motion(
    leg: Leg | Curve, s: np.ndarray, v: np.ndarray, a: np.ndarray, j: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the struts' speeds, accelerations and jerks, (n, 6), where s has the time derivatives v, a, j, (n,)."""
    _, q1, q2, q3 = leg.struts(s)
    v, a, j = v[:, None], a[:, None], j[:, None]
    return q1 * v, q1 * a + q2 * v**2, q1 * j + 3.0 * q2 * v * a + q3 * v**3


@dataclass(frozen=True)
class Motion:
    """Tool poses as a function of time from rest to rest; :func:`plan_motion` and :func:`plan_program` return it.

    Attributes
    ----------
    leg : Leg or Curve
        Path of the tool.
    profile : Profile
        Path parameter as a function of time.
    rates : StrutRates
        Limits of the struts.
    """

    leg: Leg | Curve
    profile: Profile
    rates: StrutRates

    @property
    def duration(self) -> float:
        """Duration from start to end, s."""
        return self.profile.duration

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's positions, (n, 3), and rotations, (n, 3, 3), at `times`, in seconds after the start."""
        return self.leg.poses(self.profile.at(np.asarray(times, dtype=float))[0])

    def sample(self, rate: float) -> Path:
        """Return the poses to send at a rate, Hz, from start to end; the last period may be shorter than 1/rate."""
        return Path(*self.at(_ticks(self.duration, rate)), rate)

    def stop(self, now: float, rate: float) -> Path:
        """Return the poses to send at a rate, Hz, from the time `now`, s, until the tool rests on its path.

        The tool stops as early as the struts' limits allow. If no stop keeps the limits, the motion continues to its
        end.
        """
        if not 0.0 <= now <= self.duration:
            raise GeometryError("now", f"must lie in the motion's 0…{self.duration:.6g} s", now)
        left = self.duration - now
        to_its_end = Path(*self.at(now + _ticks(left, rate)), rate)
        if len(to_its_end) <= 2:  # no command is sent between now and the end
            return to_its_end
        window = self.profile.window * self.profile.slowed
        delays = np.unique(
            np.concatenate([np.linspace(0.0, window, DELAYS // 2 + 1), np.linspace(0.0, left, DELAYS, endpoint=False)])
        )
        delays = delays[delays < left]
        # Time derivatives of the struts' lengths without a stop, from which `_slowed` computes those of each tried stop
        moments = now + left * np.linspace(0.0, 1.0, SECTIONS + 1)
        known = strut_motion(self.leg, *self.profile.at(moments))
        shares = np.linspace(0.0, 1.0, COARSE)

        def keeps_limits(lengths: np.ndarray) -> np.ndarray:
            clock, *rates = _slowing(delays[:, None] + lengths[:, None] * shares, delays[:, None], lengths[:, None])
            at = np.minimum((clock * (SECTIONS / left) + 0.5).astype(int), SECTIONS)
            found = _slowed([q[at] for q in known], *(r[:, :, None] for r in rates))
            return np.asarray(self.rates.excess(*found) <= 1.0)

        low, high = (left - delays) * SHORTEST, left - delays
        useful = keeps_limits(high)
        for _ in range(HALVINGS):
            middle = np.sqrt(low * high)
            good = keeps_limits(middle)
            low, high = np.where(good, low, middle), np.where(good, middle, high)
        for n in np.argsort(delays + high)[: np.count_nonzero(useful)] if useful.any() else ():
            for longer in LENGTHENED:
                delay, length = float(delays[n]), float(high[n] * longer)
                if useful[n] and delay + length < left and self._keeps_limits(now, delay, length):
                    since = _ticks(delay + length, rate)
                    return Path(*self.at(now + _slowing(since, delay, length)[0]), rate)
        return to_its_end

    def _keeps_limits(self, now: float, delay: float, length: float) -> bool:
        """Return whether a stop that begins at the time `now` + `delay` and lasts for `length`, s, keeps the limits."""
        shares = np.linspace(0.0, 1.0, FINE)
        edges = self.profile.breaks() - now - delay
        edges = edges[(edges > 0.0) & (edges < length / 2.0)]
        gone, *_ = _slowing(shares, 0.0, 1.0)
        shares = np.concatenate([shares, np.interp(edges / length, gone, shares)])
        clock, *rates = _slowing(delay + length * shares, delay, length)
        clock[FINE:] = delay + edges  # exactly, as a rounded time could lie on the other side of the jump
        known = strut_motion(self.leg, *self.profile.at(now + clock))
        return bool(self.rates.excess(*_slowed(known, *(r[:, None] for r in rates))) <= 1.0)


def _slowed(
    known: Sequence[np.ndarray], r: np.ndarray, r1: np.ndarray, r2: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return speeds, accelerations and jerks if the motion's clock runs at a rate r with time derivatives r1, r2."""
    v, a, j = known
    return v * r, a * r**2 + v * r1, j * r**3 + 3.0 * a * r * r1 + v * r2


def _ticks(duration: float, rate: float) -> np.ndarray:
    """Return the times 0, 1/rate, 2/rate, … up to a duration, s, and the duration itself; refuse an invalid rate."""
    check_rate(rate)
    return np.minimum(np.arange(int(np.ceil(duration * rate * (1.0 - 1e-12))) + 1) / rate, duration)


def _slowing(
    since: np.ndarray, delay: float | np.ndarray, length: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a slowing clock's time, its rate and the rate's two derivatives, at real times `since` the request, s.
    The clock's rate falls from 1 at the real time `delay` to 0 at the real time `delay` + `length`.
    """
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
    """Return the least-time motions through tool poses, with a stop at each pose.

    Between two poses the pivot moves straight, and the tool makes the shortest turn about the pivot. Strokes and joint
    angles are not checked: call :func:`hexapod_comp.check`, with the mode ``stream``, on the poses to send.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine, with the tool and the work frame that are used.
    poses : sequence of Pose
        ``pose_tool_in_work``, first the tool's present pose. Two equal poses in a row give no motion.
    rates : StrutRates
        Limits of the struts.
    pivot : array_like, shape (3,)
        The point of the tool that moves straight, m in the tool's frame; by default the tool's tip.

    Raises
    ------
    GeometryError
        The pivot is not three finite numbers, or the struts' lengths on the path are not finite.
    PoseError
        Two successive poses differ by a turn by 180°, which has two shortest ways.
    """
    point = np.asarray(pivot, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise GeometryError("pivot", "must be three finite numbers, m", point.tolist())
    legs = [Leg(geometry, a, b, point) for a, b in pairwise(poses)]
    return [Motion(leg, _fastest(leg, rates), rates) for leg in legs if leg.travel.any() or leg.turn.any()]


def plan_program(geometry: HexapodGeometry, poses: Sequence[Pose], times: Sequence[float], rates: StrutRates) -> Motion:
    """Return the motion, from rest to rest, along a program: tool poses, each with a time.

    The tool moves on a smooth curve through the poses. The tool is nowhere faster than in the program; it is slower
    where a strut would otherwise exceed a limit.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine, with the tool and the work frame that are used.
    poses : sequence of Pose
        ``pose_tool_in_work``; each pose is turned by less than 180° from the pose before.
    times : sequence of float
        Increasing times, s, one for each pose.
    rates : StrutRates
        Limits of the struts.

    Raises
    ------
    GeometryError
        There are fewer than two poses, the numbers of poses and times differ, or the times do not increase.
    PoseError
        Two successive poses differ by a turn of 180°.
    """
    if not (len(poses) == len(times) >= 2 and np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
        raise GeometryError("times", "must be two or more increasing numbers, one for each pose", list(times)[:5])
    curve = Curve(geometry, poses, times)
    return Motion(curve, _fastest(curve, rates, curve.sections, curve.fastest), rates)


def _fastest(leg: Leg | Curve, rates: StrutRates, sections: int = SECTIONS, fastest: float = np.inf) -> Profile:
    """Search the profile of least time along a leg, with ṡ at most `fastest`."""
    _, q1, q2, _ = leg.struts(np.linspace(0.0, 1.0, sections + 1))
    largest = np.abs(q1).max()
    if not (np.isfinite(largest) and largest > 0.0):
        raise GeometryError("poses", "must change the strut lengths by finite amounts above 0", float(largest))
    if not np.isfinite(rates.jerk):
        square = time_optimal(q1, q2, np.array([rates.speed]), np.array([rates.acceleration]), fastest)
        return _slowed_to_limits(leg, Profile.of(square[:, 0], 0.0), rates, fastest)
    # The search starts from speed and acceleration of the seven-phase profile of one strut over the distance `largest`
    acceleration = min(
        rates.acceleration, (rates.jerk**2 * largest / 2.0) ** (1.0 / 3.0), (rates.speed * rates.jerk) ** 0.5
    )
    ramp = acceleration / rates.jerk
    speed = min(rates.speed, acceleration * (np.sqrt(ramp**2 + 4.0 * largest / acceleration) - ramp) / 2.0)
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
                found = _slowed_to_limits(leg, found, rates, fastest)
            if found.duration < best.duration:
                best, speed, acceleration = found, float(v), float(a)
    return best


def _slowed_to_limits(leg: Leg | Curve, profile: Profile, rates: StrutRates, fastest: float) -> Profile:
    """Return the profile with its time scaled so that the struts keep their limits and ṡ is at most `fastest`."""
    excess = float(rates.excess(*strut_motion(leg, *profile.at(profile.breaks()))))
    slowed = max(excess * (1.0 + SLACK), float(profile.speeds.max()) / fastest)
    return Profile(profile.times, profile.speeds, profile.window, slowed)
