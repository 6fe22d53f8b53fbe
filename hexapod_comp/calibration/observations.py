"""Observations of a fit: C means of repeated readings, and the instruments' unknowns (nuisance parameters).

An instrument's unknowns are its zero, the slope of its straightness beam, the centre from which it reads distances, and
the frame of a tracker.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..errors import CalibrationError
from ..formats.texts import number
from ..machine.arrays import different_rows, rms
from ..measurements.readings import ABSOLUTE_KINDS, AXES, CHANNELS, KINDS, LEAST_TRAVEL, LENGTH, MeasurementSet
from ..pose import best_motion, rotation_from_vector, rotation_vector
from .assumptions import ASSUMED

FAR = 5.0  # largest distance of a fitted centre from its position in the file, in prior σ
UNMOVED = 1e-3  # RMS change of the distances / motion of the centres: below this, readings do not determine the motion
FRAME_STATIONS = 4  # runs with fewer stations share a frame, whose six unknowns need three or more
FRAME_RANK = 1e-9  # a singular value below this fraction of the largest is a rounding error

ROUNDS, SETTLED = 20, 1e-10
"""Fit of centres or a tracker's frame: largest number of Gauss–Newton steps; step, m or rad, below which they end."""


class Nuisance(NamedTuple):
    """Unknowns of an instrument and their effect on n mean readings, each divided by its own σ."""

    members: np.ndarray  # (n,): indices of the mean readings
    basis: np.ndarray  # (n, k): orthonormal basis of the changes that the unknowns can cause
    share: np.ndarray  # (k,): prior variance / (prior + noise variance) along each column of the basis; 1: no prior

    def explained(self, values: np.ndarray) -> np.ndarray:
        """Return the most probable contribution of the unknowns to the n mean readings among `values` (C,)."""
        return self.basis @ (self.share * (self.basis.T @ values[self.members]))

    def project_out(self, values: np.ndarray, where: np.ndarray | slice | None = None) -> None:
        """Project the unknowns out of `values` (C,) or (C, m), in place: the values' covariance I + B·Bᵀ becomes I.

        B is the change of the mean readings by one prior σ of each unknown. `where` has the indices of the affected
        rows of `values`, by default `members`.
        """
        where = self.members if where is None else where
        weight = 1.0 - np.sqrt(1.0 - self.share)
        along = self.basis.T @ values[where]
        values[where] -= self.basis @ (weight * along.T).T


def without_nuisance(columns: np.ndarray, unknowns: Iterable[Nuisance]) -> np.ndarray:
    """Project all unknowns out of `columns` (C, K), in place; return the columns."""
    for part in unknowns:
        part.project_out(columns)
    return columns


def of_square(members: np.ndarray, scale: np.ndarray, lever: np.ndarray, group: np.ndarray) -> Nuisance:
    """Return an optical square's unknown rotation: it changes a reading by `lever` · angle, minus the group's mean."""
    slope = scale * lever
    for own in (group == n for n in np.unique(group)):
        zero = scale[own] / np.linalg.norm(scale[own])
        slope[own] -= zero * (zero @ slope[own])
    return Nuisance(members, (slope / np.linalg.norm(slope))[:, None], np.ones(1))


class Zeros:
    """Groups of mean readings, each with an unknown zero and, if `along` (C,), m, is not NaN, an unknown slope."""

    def __init__(self, groups: Sequence[np.ndarray], along: np.ndarray) -> None:
        self._order = np.concatenate(groups) if groups else np.zeros(0, dtype=int)
        self._count = np.array([len(members) for members in groups], dtype=int)
        self._start = np.cumsum(self._count) - self._count
        self._away = along[self._order]
        if groups:
            self._away = self._away - self._each(self._sums(self._away) / self._count)
        self.groups, self.sloping = groups, np.isfinite(self._away[self._start])

    def _sums(self, values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(values, self._start)

    def _each(self, of_group: np.ndarray) -> np.ndarray:
        return np.repeat(of_group, self._count)

    def unknowns(self, scale: np.ndarray) -> list[Nuisance]:
        """Return the unknowns of all groups; `scale` (C,) is 1 / σ of each mean reading."""
        if not self.groups:
            return []
        zero = scale[self._order]
        slope = zero * self._away
        zero = zero / self._each(np.sqrt(self._sums(zero**2)))
        slope -= zero * self._each(self._sums(zero * slope))
        basis = np.column_stack([zero, slope / self._each(np.sqrt(self._sums(slope**2)))])
        both, ends = np.ones(2), self._start + self._count
        return [
            Nuisance(members, basis[start:stop, : 1 + sloping], both[: 1 + sloping])
            for members, start, stop, sloping in zip(self.groups, self._start, ends, self.sloping, strict=True)
        ]


@dataclass(frozen=True)
class Distances:
    """Distances read from centres in one run: value = |p + e − c| − |p − c₀| + zero, c₀: the centre in the file.

    All centres of a run belong to one rigid body: c = m + R·(c₀ − m) + δ, with m the mean of the c₀. Each linearisation
    fits δ and R (variable projection), so a centre may be millimetres off, and the tool error e need not be small.
    """

    name: str  # of the run
    members: np.ndarray  # (n,): indices of the mean readings
    points: np.ndarray  # (n, 3): commanded position of the measured point, m in ``base``
    centres: np.ndarray  # (n, 3): c₀, m in ``base``
    known_zero: bool  # whether the zero is 0: a calibrated instrument

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return (not self.known_zero) + (6 if self._arms().any() else 3)

    def _arms(self) -> np.ndarray:
        """Return the centres relative to their mean (n, 3), m; exactly zero if all centres are one point."""
        arms = self.centres - self.centres.mean(axis=0)
        return arms if np.abs(arms).max() > LEAST_TRAVEL else np.zeros_like(arms)

    def linearise(
        self, displacement: np.ndarray, value: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, list[Nuisance]]:
        """Return predicted values (n,), their derivatives (n, 3) by `displacement` e, and the unknowns zero, δ and R.

        `scale` (n,) is 1 / σ of each measured `value`. The noise is at least the residuals' RMS: otherwise, far from
        the solution, a circle's centre would leave the circle's plane to explain errors of the machine.
        """
        known = 0 if self.known_zero else 1
        zero = Nuisance(self.members, (scale / np.linalg.norm(scale))[:, None][:, :known], np.ones(known))
        arms = self._arms()
        size = max(float(np.linalg.norm(arms, axis=1).max()), LEAST_TRAVEL)  # m: a turn counts as angle × longest arm
        nominal = np.linalg.norm(self.points - self.centres, axis=1)
        root = self._prior(arms / size)
        body, turn = np.zeros(6), np.eye(3)
        for _ in range(ROUNDS):
            turned = arms @ turn.T
            away = self.points + displacement - self.centres + arms - turned - body[:3]
            distance = np.linalg.norm(away, axis=1)
            n = away / distance[:, None]
            columns = -scale[:, None] * np.hstack([n, np.cross(turned / size, n)]) @ root
            columns -= zero.basis @ (zero.basis.T @ columns)
            left = scale * (value - distance + nominal)
            left -= zero.basis @ (zero.basis.T @ left)
            noise, off = max(1.0, rms(left)), np.linalg.solve(root, body)
            weighted = columns.T / noise**2
            step = root @ np.linalg.solve(weighted @ columns + np.eye(6), weighted @ left - off)
            if np.abs(step).max() < SETTLED:
                break
            turn = rotation_from_vector(step[3:] / size) @ turn
            body = np.concatenate([body[:3] + step[:3], size * rotation_vector(turn)])
        if np.abs(body[:3]).max() > FAR * ASSUMED.centre:
            shift = ", ".join(number(v * 1e3, 1) for v in body[:3])
            of_run = f"the lengths of run {self.name} place the centre {shift} mm (x, y, z in base)"
            problem = f"{of_run} off its position in the file"
            wanted = f"at most {FAR * ASSUMED.centre * 1e3:g} mm is allowed"
            raise CalibrationError("centre", f"{problem}; {wanted}; check centres, units and commanded poses")
        u, s, _ = np.linalg.svd(columns / noise, full_matrices=False)
        # `off`: the prior's mean stays the position in the file, not the point of linearisation
        predicted = distance - nominal - columns @ off / scale
        return predicted, n, [zero, Nuisance(self.members, u, s**2 / (1.0 + s**2))]

    def _prior(self, arms: np.ndarray) -> np.ndarray:
        """Return a root (6, 6) of the prior covariance of δ and R, m; `arms`: centres − mean, scaled to 1 at most."""
        n = self.points - self.centres
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        columns = np.hstack([n, np.cross(arms, n)])
        if not self.known_zero:
            columns -= columns.mean(axis=0)
        squares, directions = np.linalg.eigh(columns.T @ columns / len(columns))
        return directions * np.where(squares > UNMOVED**2, ASSUMED.centre, ASSUMED.centre_unseen)


@dataclass(frozen=True)
class Frame:
    """Readings from one position of a tracker; its unknown frame is the work frame rotated by R about c, shifted by d.

    The tracker reads point p + e at c + Rᵀ·(p + e − c − d), and attitude exp(r) as Rᵀ·exp(r); R and d have no prior.
    """

    members: np.ndarray  # (n,): indices of the mean readings
    points: np.ndarray  # (n, 3): commanded position of the measured point, m in base

    def linearise(
        self, directions: np.ndarray, errors: np.ndarray, value: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, Nuisance]:
        """Return predicted values (n,), their derivatives (n, 6) by `errors`, and the unknowns R and d.

        `directions` (n, 6) are the derivatives by `errors` if the frame is not turned (R = I); `scale` (n,) is 1 / σ of
        each `value`.
        """
        centre = self.points.mean(axis=0)
        shift, turn, attitude = np.zeros(3), np.eye(3), rotation_from_vector(errors[:, 3:])
        for _ in range(ROUNDS):
            away = self.points + errors[:, :3] - centre - shift
            shown = centre + away @ turn - self.points
            turned = rotation_vector(turn.T @ attitude)
            expected = (directions[:, :3] * shown).sum(axis=1) + (directions[:, 3:] * turned).sum(axis=1)
            # Derivative of `turned` by a small rotation of the frame
            moving = directions[:, 3:] + 0.5 * np.cross(turned, directions[:, 3:])
            along = np.hstack([directions[:, :3] @ turn.T, moving @ turn.T])
            turning = np.cross(away, along[:, :3]) + along[:, 3:]
            u, s, v = np.linalg.svd(-scale[:, None] * np.hstack([along[:, :3], turning]), full_matrices=False)
            rank = int((s > FRAME_RANK * s[0]).sum())
            step = v[:rank].T @ (u[:, :rank].T @ (scale * (value - expected)) / s[:rank])
            shift = shift + step[:3]
            turn = rotation_from_vector(step[3:]) @ turn
            if np.abs(step).max() < SETTLED:
                break
        return expected, along, Nuisance(self.members, u[:, :rank], np.ones(rank))


@dataclass(frozen=True)
class MeanReadings:
    """Mean readings: each is the mean of all readings of one channel at one station."""

    of_reading: np.ndarray  # (N,): index of the mean to which each reading belongs
    first: np.ndarray  # (C,): index of its first reading
    station: np.ndarray  # (C,): index of its station
    channel: np.ndarray  # (C,): index into CHANNELS
    kind: np.ndarray  # (C,): index into KINDS
    group: np.ndarray  # (C,): one number for each run and channel, whose readings share a zero; -1: absolute reading
    directions: np.ndarray  # (C, 6): derivative by the tool error; distances: from the centre's position in the file
    along: np.ndarray  # (C,): commanded coordinate along the line, m
    lever: np.ndarray  # (C,): change per rotation of the optical square, m/rad
    square: np.ndarray  # (C,): one number for each optical square and axis of its rotation; -1: read without a square
    fold: np.ndarray  # (C,): group that cross-validation leaves out: a line, a ball bar's circle, or a single pose

    @staticmethod
    def of(measurements: MeasurementSet) -> MeanReadings:
        m = measurements
        centre = different_rows(np.nan_to_num(m.centre))[1]
        first, of_reading = different_rows(np.stack([m.station, m.channel, centre], axis=1))
        groups = different_rows(np.stack([m.run, m.channel], axis=1))[1]
        absolute = np.isin(np.array(KINDS)[m.kind[first]], ABSOLUTE_KINDS)
        whole = _left_out_whole(m)[m.run[first]]
        poses = np.hstack([m.stations.positions, m.stations.rotations.reshape(-1, 9)]).round(9)
        pose = different_rows(poses)[1][m.station[first]]
        names = np.array([run.slope for run in m.runs])
        levers, about = (values[first] for values in m.square_levers())
        numbers = np.unique(names, return_inverse=True)[1].ravel()[m.run[first]]
        square = np.where((names[m.run[first]] != "") & levers.astype(bool), 3 * numbers + about, -1)
        fold_key = np.where(whole, -1 - m.run[first], pose)
        return MeanReadings(
            of_reading=of_reading,
            first=first,
            station=m.station[first],
            channel=m.channel[first],
            kind=m.kind[first],
            group=np.where(absolute, -1, groups[first]),
            directions=m.directions()[first],
            along=m.along()[first],
            lever=levers,
            square=square,
            fold=np.unique(fold_key, return_inverse=True)[1].ravel(),
        )

    def with_zeros(self, measurements: MeasurementSet) -> tuple[Zeros, list[Distances]]:
        """Return groups of mean readings that share an unknown zero and, separately, the distances of each run."""
        c, m = self, measurements
        points = m.points()
        zeros, distances = list[np.ndarray](), list[Distances]()
        along = np.where((c.square < 0) & (c.kind == KINDS.index("straightness")), c.along, np.nan)
        order = np.argsort(c.group, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(c.group[order])) + 1):
            one = members.min()
            if c.group[one] < 0:
                continue
            if c.channel[one] == LENGTH:
                run = m.runs[m.run[c.first[one]]]
                places = points[c.station[members]], m.centre[c.first[members]]
                distances.append(Distances(run.name, members, *places, run.known_zero))
                continue
            if not np.ptp(along[members]) > 0.0:
                along[members] = np.nan
            zeros.append(members)
        return Zeros(zeros, along), distances

    def near_work(self, measurements: MeasurementSet, frames: Sequence[Frame]) -> MeasurementSet:
        """Transform readings from tracker frames to ``work``, by a best fit of each frame to the commanded poses.

        The transformation makes each frame's unknown rotation and shift small. A frame is left as it is if its readings
        lack a coordinate of a point, or do not determine a rotation.
        """
        m, value, uncertainty = measurements, measurements.value.copy(), measurements.uncertainty.copy()
        points = _commanded(m)
        # An attitude counts as six points about the mean of the positions
        arms = np.sqrt(0.5) * m.geometry.characteristic_length * np.concatenate([np.eye(3), -np.eye(3)])
        for frame in frames:
            rows = np.flatnonzero(np.isin(self.of_reading, frame.members))
            places, turns = (_triples(m, rows, kind) for kind in ABSOLUTE_KINDS)
            if places is None or turns is None:
                continue
            meant, turned = points[places[:, 0]], rotation_from_vector(value[turns])
            seen = meant + value[places]
            to, centre = (x.mean(axis=0) if len(x) else np.zeros(3) for x in (meant, seen))
            turned_arms = (centre + arms @ np.swapaxes(turned, -1, -2)).reshape(-1, 3)
            motion = best_motion(
                np.concatenate([seen, turned_arms]), np.concatenate([meant, np.tile(to + arms, (len(turned), 1))])
            )
            if motion is None:
                continue
            value[places] = motion.transform(seen) - meant
            value[turns] = rotation_vector(motion.rotation @ turned)
            for triples in (places, turns):  # neglects the correlation of the rotated errors
                uncertainty[triples] = np.sqrt(uncertainty[triples] ** 2 @ (motion.rotation**2).T)
        return replace(m, value=value, uncertainty=uncertainty)

    def mirrored(
        self, measurements: MeasurementSet, frames: Sequence[Frame]
    ) -> Iterator[tuple[np.ndarray, float, float]]:
        """Yield, for each tracker frame whose points span a plane, the rows of the points' coordinates and two misfits.

        The misfits are RMS differences, m, between measured and commanded coordinates after a best fit of the frame:
        first of the measured coordinates, then of these with one axis mirrored.
        """
        m = measurements
        points = _commanded(m)
        for frame in frames:
            rows = _triples(m, np.flatnonzero(np.isin(self.of_reading, frame.members)), "position")
            if rows is None or len(rows) == 0:
                continue
            meant = points[rows[:, 0]]
            seen = meant + m.value[rows]
            fits = [(x, best_motion(x, meant)) for x in (seen, seen * (1.0, 1.0, -1.0))]
            misfits = [rms(motion.transform(x) - meant) for x, motion in fits if motion is not None]
            if misfits:
                yield rows, misfits[0], misfits[1]

    def squares(self) -> list[np.ndarray]:
        """Return, for each optical square and axis, the indices of the mean readings that depend on its rotation."""
        numbers = np.unique(self.square[self.square >= 0])
        return [np.flatnonzero(np.isin(self.group, self.group[self.square == n])) for n in numbers]

    def frames(self, measurements: MeasurementSet) -> list[Frame]:
        """Return the trackers' frames: one for each run; runs with fewer than FRAME_STATIONS stations share a frame."""
        m, absolute = measurements, np.flatnonzero(self.group < 0)
        run, points = m.run[self.first[absolute]], m.points()
        for n in np.unique(run):
            if len(np.unique(self.station[absolute[run == n]])) < FRAME_STATIONS:
                run[run == n] = -1
        return [Frame(own, points[self.station[own]]) for n in np.unique(run) for own in [absolute[run == n]]]


def _commanded(m: MeasurementSet) -> np.ndarray:
    """Return the commanded measured point of each reading, (N, 3), m in the work frame."""
    return (m.points()[m.station] - m.geometry.work.position) @ m.geometry.work.rotation


def _triples(m: MeasurementSet, rows: np.ndarray, kind: str) -> np.ndarray | None:
    """Return the indices among `rows` of readings of x, y, z of each point, (n, 3); None if a coordinate is missing."""
    columns = [rows[m.channel[rows] == CHANNELS.index(f"{kind}_{axis}")] for axis in AXES]
    columns = [own[np.argsort(m.station[own], kind="stable")] for own in columns]
    whole = all(np.array_equal(m.station[own], m.station[columns[0]]) for own in columns)
    return np.column_stack(columns) if whole else None


def _left_out_whole(measurements: MeasurementSet) -> np.ndarray:
    """Return for each run whether cross-validation leaves it out whole: a line, or ball-bar circles of one centre."""
    m = measurements
    whole = np.array([run.is_line for run in m.runs])
    of_length = m.channel == LENGTH
    distance = np.linalg.norm(m.points()[m.station] - m.centre, axis=1)
    for run in np.unique(m.run[of_length]):
        members = of_length & (m.run == run)
        whole[run] = np.ptp(np.column_stack([m.centre, distance])[members], axis=0).max() < LEAST_TRAVEL
    return whole
