"""Measurements on a rectangular grid of lines, as scheme ``lines`` wants them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from ..errors import CalibrationError
from ..machine.field import COMPONENTS, CROSS_AXES
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import MachineModel, RealMachine
from ..machine.region import Region
from ..machine.temperatures import REFERENCE_TEMPERATURE
from ..measurements.readings import AXES, CHANNELS, KINDS, LEAST_TRAVEL, MeasurementSet
from ..virtual.instruments import station_errors

WARM = 0.5
"""Temperatures further than this from the reference, K, are mentioned: the scheme has no temperature."""

COMPENSATED, FOLLOWED = 10e-6, 0.1e-6
"""Commands further off the nominal lengths than this, m, are a compensation's; than that, worth a remark."""


class Readings(NamedTuple):
    """Readings on grid lines; every array has one entry a reading.

    Attributes
    ----------
    axis, component, direction, run, cycle : ndarray of int, shape (N,)
        Of the line, the reading, the pass.
    point : ndarray, shape (N, 3)
        Commanded place of the measured point in ``base``, m.
    node : ndarray of int, shape (N, 3)
        Nearest node along each axis; along the line itself without meaning.
    value : ndarray, shape (N,)
        m or rad.
    sloping : ndarray of bool, shape (N,)
        Whether the beam's slope is unknown.
    """

    axis: np.ndarray
    component: np.ndarray
    direction: np.ndarray
    run: np.ndarray
    cycle: np.ndarray
    point: np.ndarray
    node: np.ndarray
    value: np.ndarray
    sloping: np.ndarray

    def select(self, mask: np.ndarray) -> Readings:
        """Return those in a mask or at indices."""
        return Readings(*(array[mask] for array in self))


def grid_readings(measurements: MeasurementSet) -> tuple[Readings, list[str]]:
    """Return the readings on lines parallel to an axis, and remarks on all that was left out.

    Raises
    ------
    CalibrationError
        None is left, or they cannot be taken as components along the axes of ``base``.
    """
    m = measurements
    axis_of_run = np.array([-1 if run.base_axis is None else run.base_axis for run in m.runs])
    axis = axis_of_run[m.run]
    notes = []
    others = [m.runs[r].name for r in np.unique(m.run[axis < 0])]
    if others:
        what = "not parallel to an axis of base; scheme lines has no use for them"
        notes.append(f"{len(others)} runs are {what} (first: {others[0]})")
    if (axis < 0).all():
        raise CalibrationError("grid lines", "there are none: no run is parallel to an axis of base")
    component = _components(m, axis >= 0)
    along_itself = (component == axis) & (m.channel != CHANNELS.index("linear"))
    if along_itself.any():
        notes.append("straightness along the line itself was left out")
    kept = np.flatnonzero((axis >= 0) & ~along_itself)
    axis, station = axis[kept], m.station[kept]
    _check_level(m.stations.rotations[station])
    notes += _warm_note(m.stations.temperatures[station]) + _command_note(m, np.unique(station))
    direction = m.stations.sense[station, axis].astype(int)
    node = np.zeros((len(kept), 3), dtype=int)
    value = _of_the_model(m)[kept] * np.sign(m.directions()[kept, component[kept]])
    sloping = m.kind[kept] == KINDS.index("straightness")
    point = m.points()[station]
    return Readings(axis, component[kept], direction, m.run[kept], m.cycle[kept], point, node, value, sloping), notes


def _of_the_model(measurements: MeasurementSet) -> np.ndarray:
    """Return readings without what the turning of the screws does to them, shape (N,), m or rad.

    Where the geometry has a lead, whoever applies the model undoes that anyway: in the field it would count twice.
    """
    m = measurements
    if not m.geometry.screw_lead.any():
        return m.value
    turning = station_errors(m, RealMachine(m.geometry, MachineModel(m.geometry.name)))
    return m.value - (m.directions() * turning[m.station]).sum(axis=1)


def _components(measurements: MeasurementSet, wanted: np.ndarray) -> np.ndarray:
    """Return which of the six components each reading is of, shape (N,), −1 where a mask does not want it."""
    weights = np.abs(measurements.directions())
    turned = wanted & (weights.max(axis=1) < 1.0 - 1e-9)
    if turned.any():
        run = measurements.runs[measurements.run[turned.argmax()]]
        raise CalibrationError(f"run {run.name}", "is read across axes that are turned against those of base")
    return np.where(wanted, weights.argmax(axis=1), -1)


def _check_level(rotations: np.ndarray) -> None:
    """Refuse lines that were read at different attitudes: the field does not depend on attitude."""
    if np.abs(rotations - rotations[0]).max() > 1e-9:
        raise CalibrationError("grid lines", "must all be read at one attitude of the platform: the field has none")


def _warm_note(temperatures: np.ndarray) -> list[str]:
    low, high = temperatures.min(), temperatures.max()
    if max(REFERENCE_TEMPERATURE - low, high - REFERENCE_TEMPERATURE) <= WARM:
        return []
    return [f"read at {low:.1f} to {high:.1f} °C; scheme lines takes the growth for an error at 20 °C"]


def _command_note(measurements: MeasurementSet, stations: np.ndarray) -> list[str]:
    """Return a remark on commands that were not quite nominal; refuse a machine that was compensated."""
    there, nominal = measurements.stations, Structure.of(measurements.geometry)
    lengths = strut_lengths_batch(nominal, there.positions[stations], there.rotations[stations])
    most = float(np.abs(there.commands[stations] - lengths).max())
    if most > COMPENSATED:
        problem = f"were read under strut commands up to {most * 1e6:.1f} µm off the nominal lengths: compensated?"
        raise CalibrationError("grid lines", f"{problem} Scheme lines needs the machine as it is")
    if most <= FOLLOWED:
        return []
    return [f"strut commands are up to {most * 1e6:.2f} µm off the nominal lengths, and are taken for nominal"]


def distinct(values: np.ndarray) -> np.ndarray:
    """Return values, in order, of which no two are the same place."""
    ordered = np.unique(values)
    return ordered[np.append(True, np.diff(ordered) > LEAST_TRAVEL)]


def grid_of(readings: Readings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nodes along x, y, z, m: where the lines stand, or how far they go where none crosses.

    Raises
    ------
    CalibrationError
        Lines at one place only, or that end within the grid.
    """
    grid = []
    for axis, name in enumerate(AXES):
        along = readings.point[readings.axis == axis, axis]
        across = readings.point[readings.axis != axis, axis]
        nodes = distinct(across) if len(across) else np.array([along.min(), along.max()])
        if len(nodes) < 2:
            raise CalibrationError("grid", f"lines stand at one {name} only ({nodes[0] * 1e3:g} mm); two are needed")
        grid.append(nodes)
    return grid[0], grid[1], grid[2]


def nearest_nodes(points: np.ndarray, grid: Sequence[np.ndarray]) -> np.ndarray:
    """Return the index of the node nearest to each point along each axis, shape (N, 3)."""
    columns = [np.abs(points[:, axis, None] - nodes).argmin(axis=1) for axis, nodes in enumerate(grid)]
    return np.stack(columns, axis=1)


def line_name(grid: Sequence[np.ndarray], axis: int, node: Sequence[int]) -> str:
    places = zip(CROSS_AXES[axis], node, strict=True)
    return f"{AXES[axis]} line at " + ", ".join(f"{AXES[a]} {grid[a][n] * 1e3:.1f}" for a, n in places) + " mm"


def check_complete(readings: Readings, grid: Sequence[np.ndarray]) -> None:
    """Refuse a family of which a line, a channel of a line, or a line's end is missing."""
    for axis in np.unique(readings.axis):
        family = readings.select(readings.axis == axis)
        every = set(product(*(range(len(grid[a])) for a in CROSS_AXES[axis])))
        for component in np.unique(family.component):
            rows = family.component == component
            there = {(int(i), int(j)) for i, j in family.node[rows][:, CROSS_AXES[axis]]}
            if every - there:
                first = line_name(grid, axis, min(every - there))
                what = f"{COMPONENTS[component]} on the {first}"
                missing = f"of {len(every)} lines of the rectangular grid {len(every - there)} were not measured"
                raise CalibrationError(what, f"is missing; {missing}")
        _check_ends(family, int(axis), grid)


def _check_ends(family: Readings, axis: int, grid: Sequence[np.ndarray]) -> None:
    """Refuse a line that ends within the grid: a polynomial says nothing beyond its readings."""
    low, high = grid[axis][0], grid[axis][-1]
    for node in sorted({(int(i), int(j)) for i, j in family.node[:, CROSS_AXES[axis]]}):
        on_line = (family.node[:, CROSS_AXES[axis]] == node).all(axis=1)
        reach = family.point[on_line, axis]
        if reach.min() > low + LEAST_TRAVEL or reach.max() < high - LEAST_TRAVEL:
            problem = f"is read from {reach.min() * 1e3:.1f} to {reach.max() * 1e3:.1f} mm"
            wanted = f"the grid reaches from {low * 1e3:.1f} to {high * 1e3:.1f} mm"
            raise CalibrationError(line_name(grid, axis, node), f"{problem}, but {wanted}")


def datum_of(measurements: MeasurementSet, grid: Sequence[np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Return where each line is zero, shape (3,), m in ``base``: home's place of the measured point."""
    home = measurements.geometry.home
    point = home.position + home.rotation @ measurements.probe
    datum = np.array([min(max(p, nodes[0]), nodes[-1]) for p, nodes in zip(point, grid, strict=True)])
    beyond = [name for name, p, d in zip(AXES, point, datum, strict=True) if abs(p - d) > LEAST_TRAVEL]
    if not beyond:
        return datum, []
    return datum, [f"home lies outside the box along {', '.join(beyond)}: lines are zero at the end next to it"]


def region_of(measurements: MeasurementSet, grid: Sequence[np.ndarray]) -> Region:
    """Return the places of the measured point that the grid covers."""
    return Region(np.array([[nodes[0] for nodes in grid], [nodes[-1] for nodes in grid]]), measurements.probe)
