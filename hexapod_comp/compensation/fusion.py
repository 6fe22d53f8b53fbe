"""A Kalman filter that estimates the machine's drift, a random walk, from a pose instrument and the strut encoders.

The filter's state is the drift that :func:`.compensator.drifted` describes. The observation is the measured tool pose
minus the pose that forward kinematics compute from the struts. Readings at one pose cannot distinguish a drift of the
struts from a drift of the base (both variances stay large); readings at several poses can (doc/theory.md, section 11).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from ..errors import CommandError, HexapodError
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import jacobian
from ..pose import Pose, attitude_error, cross_matrix, rotation_from_vector
from .compensator import DRIFT_STATES, Compensator

KEPT = 1024  # Number of stored strut readings: one second at 1 kHz
MOST_WAITING = 32  # Largest number of pose readings that wait for strut readings of the same time
LONGEST_GAP = 0.1  # Longest time between two strut readings between which lengths are interpolated, s


@dataclass(frozen=True)
class FusionRules:
    """Assumptions about machine and instrument."""

    drift_rate: float = 5e-8  # standard deviation of each state's drift after 1 s, m; it grows with the root of time
    initial_deviation: float = 5e-6  # standard deviation of each state at the start, m
    limit: float = 2e-4  # largest magnitude of a state, m: an update to a larger state is rejected
    gate_probability: float = 0.999  # probability that a correct reading passes the gate
    strut_deviation: float = 1e-6  # standard deviation of a strut reading and of the model's residual error, m
    time_deviation: float = 1e-3  # standard deviation of the time offset between stamps of instrument and struts, s
    position_deviation: float = 2e-6  # the instrument's standard deviation of position if its message states none, m
    rotation_deviation: float = 1e-5  # the instrument's standard deviation of rotation if its message states none, rad

    def covariance(self) -> np.ndarray:
        return np.diag(np.repeat([self.position_deviation, self.rotation_deviation], 3) ** 2)


class DriftFilter:
    """A Kalman filter whose state x is a random walk; each reading z = H·x + v must pass a chi-square gate."""

    def __init__(self, rules: FusionRules, states: int = DRIFT_STATES) -> None:
        self.rules = rules
        self.state: np.ndarray = np.zeros(states)
        self.covariance: np.ndarray = rules.initial_deviation**2 * np.eye(states)
        self.time = math.nan  # time of the newest reading, s
        self.chi_square = 0.0  # chi-square of the last innovation

    def predict(self, time: float) -> None:
        """Increase the covariance by the random walk to `time`, s; a time before the newest reading changes nothing."""
        if time > self.time:
            self.covariance = self.covariance + self.rules.drift_rate**2 * (time - self.time) * np.eye(len(self.state))
        if not time <= self.time:
            self.time = time

    def update(self, reading: np.ndarray, observation: np.ndarray, noise: np.ndarray) -> None:
        """Update the state with a `reading` z = H·x + v; `observation` is H, and `noise` is the covariance of v.

        Raise a CommandError if the reading fails the chi-square gate (``wild_pose``) or the state would exceed the
        rules' limit (``drift_limit``); then state and covariance stay unchanged.
        """
        innovation = reading - observation @ self.state
        spread = observation @ self.covariance @ observation.T + noise
        self.chi_square = float(innovation @ np.linalg.solve(spread, innovation))
        from scipy.special import gammaincinv  # a node without fusion need not load SciPy

        allowed = 2.0 * float(gammaincinv(len(innovation) / 2.0, self.rules.gate_probability))
        if not self.chi_square <= allowed:
            off = f"{1e3 * math.hypot(*innovation[:3]):.4g} mm, {1e3 * math.hypot(*innovation[3:]):.4g} mrad"
            rule = f"{allowed:.3g} (probability {self.rules.gate_probability:g})"
            problem = f"the measured pose is {off} from the estimate: chi-square {self.chi_square:.4g}, allowed {rule}"
            raise CommandError("wild_pose", problem)
        gain = np.linalg.solve(spread, observation @ self.covariance).T
        state = self.state + gain @ innovation
        if (worst := float(np.abs(state).max())) > self.rules.limit:
            limit = f"{self.rules.limit * 1e3:g} mm"
            text = f"the drift would be {worst * 1e3:.4f} mm, allowed {limit}: the previous drift stays in use"
            raise CommandError("drift_limit", text)
        # Joseph's form keeps the covariance positive definite despite rounding
        kept = np.eye(len(state)) - gain @ observation
        self.state, self.covariance = state, kept @ self.covariance @ kept.T + gain @ noise @ gain.T


@dataclass(frozen=True)
class PoseReading:
    pose: Pose  # pose_tool_in_base
    made: float  # monotonic time, s
    covariance: np.ndarray  # (6, 6): displacement, m, and rotation vector, rad, along the axes of ``base``


def checked_covariance(numbers: Sequence[float], rules: FusionRules) -> np.ndarray:
    """Return a message's covariance, 36 numbers, as a (6, 6) matrix, or the covariance of `rules` if all are zero.

    Raise a CommandError with the reason ``covariance`` if the matrix is not symmetric and positive definite.
    """
    matrix = np.array(numbers, dtype=float).reshape(6, 6)
    if not matrix.any():
        return rules.covariance()
    size = np.sqrt(np.abs(matrix.diagonal()))
    if np.isfinite(matrix).all() and (matrix.diagonal() > 0.0).all():
        relative = matrix / np.outer(size, size)
        if np.allclose(relative, relative.T, rtol=0.0, atol=1e-6) and np.linalg.eigvalsh(relative)[0] > 1e-9:
            return matrix
    text = "the covariance must be symmetric and positive definite, or zero to use that of the node's parameters"
    raise CommandError("covariance", text)


def observation(geometry: HexapodGeometry, platform: Pose, tool: Pose) -> np.ndarray:
    """Return H, (6, 12): displacement, m, and rotation, rad, of the tool in ``base`` per m of each state."""
    size, struts = geometry.characteristic_length, np.linalg.inv(jacobian(geometry, platform))
    result = np.zeros((6, DRIFT_STATES))
    result[:3, :3], result[3:, 3:6] = np.eye(3), np.eye(3) / size
    result[:3, 3:6] = -cross_matrix(tool.position - geometry.home.position) / size
    result[:3, 6:] = struts[:3] - cross_matrix(tool.position - platform.position) @ struts[3:]
    result[3:, 6:] = struts[3:]
    return result


class Fusion:
    """An estimator of the drift of one compensator's machine, from the readings of a pose instrument."""

    def __init__(self, compensator: Compensator, rules: FusionRules) -> None:
        self._compensator, self.rules = compensator, rules
        self.reset()

    def reset(self) -> None:
        """Set the estimated drift to zero; the compensator keeps its present drift until the next :meth:`feed`."""
        self.filter, self.held = DriftFilter(self.rules), ""
        self._model, self._tool = self._compensator.model, self._compensator.geometry.tool_name
        self._struts: deque[tuple[float, np.ndarray]] = deque(maxlen=KEPT)
        self._waiting: deque[PoseReading] = deque(maxlen=MOST_WAITING)
        self.count, self.last = 0, -math.inf  # number of accepted readings, and time of the newest reading

    @property
    def drift(self) -> np.ndarray:
        """The estimated drift, twelve numbers as in :func:`.drifted`, m."""
        return self.filter.state

    @property
    def turn(self) -> np.ndarray:
        return self.drift[3:6] / self._compensator.geometry.characteristic_length

    def add(self, reading: PoseReading) -> list[CommandError]:
        """Add a pose reading; it is used when later strut readings arrive. Return an error per rejected reading."""
        self._waiting.append(reading)
        return self._process_waiting()

    def add_struts(self, struts: Sequence[float], made: float) -> list[CommandError]:
        """Add a reading of the struts, m, made at the monotonic time `made`, s; return the errors of rejected poses."""
        if not self._struts or made > self._struts[-1][0]:
            self._struts.append((made, np.array(struts)))
        return self._process_waiting() if self._waiting else []

    def with_drift(self, tool: np.ndarray) -> np.ndarray:
        """Return the pose `tool` that :meth:`.Compensator.estimate` gave, moved by the drift not yet compensated."""
        left = self.drift - self._compensator.drift
        if not left.any():
            return tool
        pose = Pose(tool[:3], tool[3:].reshape((3, 3)))
        moved = self._observation(pose) @ left
        turned = rotation_from_vector(moved[3:]) @ pose.rotation
        return np.concatenate([pose.position + moved[:3], turned.ravel()])

    def feed(self, compensate: bool) -> None:
        """Pass the estimated drift, or a zero drift if `compensate` is False, to the compensator.

        After a change of model the estimated drift starts again at zero. Raise a HexapodError if the new corrections
        break a limit; then the compensator keeps its previous drift.
        """
        if self._compensator.model is not self._model:
            self.reset()
        self._compensator.set_drift(self.drift if compensate else np.zeros(DRIFT_STATES))

    def _observation(self, tool: Pose) -> np.ndarray:
        return observation(self._compensator.geometry, Pose(*self._compensator.platform_estimate), tool)

    def _process_waiting(self) -> list[CommandError]:
        rejected = []
        if self._compensator.geometry.tool_name != self._tool or self._compensator.model is not self._model:
            self._waiting.clear()  # the waiting poses were measured with another tool, or belong to another model
            self._tool = self._compensator.geometry.tool_name
        while self._waiting and self._struts and self._waiting[0].made <= self._struts[-1][0]:
            reading = self._waiting.popleft()
            try:
                self._update(reading)
            except CommandError as error:
                rejected.append(error)
            except HexapodError as error:
                text = f"forward kinematics find no pose for the struts at the time of the measured pose: {error}"
                rejected.append(CommandError("no_estimate", text))
        return rejected

    def _update(self, reading: PoseReading) -> None:
        struts, speed = self._struts_at(reading.made)
        estimated = self._compensator.estimate(struts)
        tool = Pose(estimated[:3].copy(), estimated[3:].reshape((3, 3)).copy())
        rules, matrix = self.rules, self._observation(tool)
        seen = np.concatenate([
            reading.pose.position - tool.position,
            attitude_error(reading.pose.rotation, tool.rotation),
        ])  # fmt: skip
        effect, moving = matrix[:, 6:], matrix[:, 6:] @ speed * rules.time_deviation
        noise = reading.covariance + rules.strut_deviation**2 * effect @ effect.T + np.outer(moving, moving)
        self.filter.predict(reading.made)
        try:
            self.filter.update(seen + matrix @ self._compensator.drift, matrix, noise)
        except CommandError as error:
            self.held = str(error) if error.reason == "drift_limit" else self.held
            raise
        self.held, self.count, self.last = "", self.count + 1, reading.made

    def _struts_at(self, made: float) -> tuple[np.ndarray, np.ndarray]:
        """Return strut lengths, m, and speeds, m/s, at the time `made`, s, interpolated between two strut readings."""
        after = bisect_left(self._struts, made, key=itemgetter(0))
        if not 0 < after < len(self._struts) or self._struts[after][0] - self._struts[after - 1][0] > LONGEST_GAP:
            text = f"the measured pose does not lie between two strut readings at most {LONGEST_GAP:g} s apart"
            raise CommandError("no_struts", text)
        (then, struts), (end, later) = self._struts[after - 1], self._struts[after]
        speed = (later - struts) / (end - then)
        return struts + speed * (made - then), speed
