"""Cells: readings that differ by noise only, and the groups of them that share what their instrument does not know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..machine.rows import different_rows
from ..measurements.readings import ABSOLUTE_KINDS, KINDS, LEAST_TRAVEL, LENGTH, MeasurementSet
from .unknowns import Lengths


@dataclass(frozen=True)
class Cells:
    """Readings of one channel at one station are one cell: they differ by noise only.

    Attributes
    ----------
    of_reading : ndarray of int, shape (N,)
        Cell of each reading.
    first : ndarray of int, shape (C,)
        First reading of each cell.
    station, channel, kind, group : ndarray of int, shape (C,)
        Of each cell; a group is one channel of one run, whose unknowns its cells share.
    directions : ndarray, shape (C, 6)
        w of each cell; of a length, from its centre's place in the file.
    along : ndarray, shape (C,)
        Commanded coordinate along the line, m.
    fold : ndarray of int, shape (C,)
        What is left out together in cross-validation: a line's run, a ball bar's circle, or a scattered pose.
    """

    of_reading: np.ndarray
    first: np.ndarray
    station: np.ndarray
    channel: np.ndarray
    kind: np.ndarray
    group: np.ndarray
    directions: np.ndarray
    along: np.ndarray
    fold: np.ndarray

    @staticmethod
    def of(measurements: MeasurementSet) -> Cells:
        """Return the cells of a set."""
        m = measurements
        centre = different_rows(np.nan_to_num(m.centre))[1]
        first, of_reading = different_rows(np.stack([m.station, m.channel, centre], axis=1))
        groups = different_rows(np.stack([m.run, m.channel], axis=1))[1]
        absolute = np.isin(np.array(KINDS)[m.kind[first]], ABSOLUTE_KINDS)
        whole = _left_out_whole(m)[m.run[first]]
        poses = np.hstack([m.stations.positions, m.stations.rotations.reshape(-1, 9)]).round(9)
        pose = different_rows(poses)[1][m.station[first]]
        fold_key = np.where(whole, -1 - m.run[first], pose)
        return Cells(
            of_reading=of_reading,
            first=first,
            station=m.station[first],
            channel=m.channel[first],
            kind=m.kind[first],
            group=np.where(absolute, -1, groups[first]),
            directions=m.directions()[first],
            along=m.along()[first],
            fold=np.unique(fold_key, return_inverse=True)[1].ravel(),
        )

    def groups(self, measurements: MeasurementSet) -> tuple[list[tuple[np.ndarray, np.ndarray | None]], list[Lengths]]:
        """Return the cells of each channel of each run: those with a zero, and their slope's lever; and lengths."""
        c, m = self, measurements
        points = m.points()
        zeros: list[tuple[np.ndarray, np.ndarray | None]] = []
        lengths = []
        for group in np.unique(c.group[c.group >= 0]):
            members = np.flatnonzero(c.group == group)
            if c.channel[members[0]] == LENGTH:
                run = m.runs[m.run[c.first[members[0]]]]
                places = points[c.station[members]], m.centre[c.first[members]]
                lengths.append(Lengths(run.name, members, *places, run.known_zero))
                continue
            sloping = KINDS[c.kind[members[0]]] == "straightness" and np.ptp(c.along[members]) > 0.0
            zeros.append((members, c.along[members] if sloping else None))
        return zeros, lengths


def _left_out_whole(measurements: MeasurementSet) -> np.ndarray:
    """Return which runs are left out as a whole, shape (runs,): lines, and circles of one length about one centre."""
    m = measurements
    whole = np.array([run.is_line for run in m.runs])
    of_length = m.channel == LENGTH
    distance = np.linalg.norm(m.points()[m.station] - m.centre, axis=1)
    for run in np.unique(m.run[of_length]):
        members = of_length & (m.run == run)
        whole[run] = np.ptp(np.column_stack([m.centre, distance])[members], axis=0).max() < LEAST_TRAVEL
    return whole
