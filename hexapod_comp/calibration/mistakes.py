"""Mistakes that a file of readings may contain, each with its correction.

Correcting a sign, unit or channel changes the readings only; correcting a frame or order of angles changes the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np

from ..machine.arrays import different_rows
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import MachineModel
from ..machine.passes import Passes
from ..measurements.readings import ANGULAR_KINDS, AXES, CHANNELS, KINDS, LINE_KINDS, MeasurementSet
from ..measurements.stations import compensated
from ..pose import angles_from_rotation, rotation_from_vector

PARALLEL = 0.999  # a line is parallel to an axis if the cosine of the angle between them is above this

RUN_FAMILIES = ("x lines", "y lines", "z lines", "other lines", "other runs")
"""Families of runs, by the direction of their line in the work frame; `other runs` are not lines."""

UNITS = {
    "length": {
        "µinch in place of µm": 0.0254,
        "0.1 µm in place of µm": 0.1,
        "0.01 mm in place of µm": 10.0,
        "mm in place of µm": 1e3,
        "µm in place of mm, or nm in place of µm": 1e-3,
    },
    "angle": {
        "arcsec in place of µrad": np.pi / 0.648,
        "µrad in place of arcsec": 0.648 / np.pi,
        "mrad in place of µrad": 1e3,
        "µrad in place of mrad": 1e-3,
        "mdeg in place of µrad": np.pi / 0.18,
    },
}
"""Wrong units, "unit of the numbers in place of the unit that the file states", with the ratio of the two units."""


class Mistake(NamedTuple):
    name: str  # for example "x lines, linear: sign reversed"
    corrected: Callable[[], MeasurementSet | None]  # None: nothing changes
    factor: np.ndarray = np.ones(len(KINDS))  # (kinds,): corrected value / value in the file
    choices: float = 0.0  # log of the number of equally probable mistakes from which this one was chosen


def family_of_run(measurements: MeasurementSet) -> np.ndarray:
    """Return for each run the index of its family in RUN_FAMILIES."""
    axes = np.array([run.axis for run in measurements.runs]).reshape(-1, 3) @ measurements.geometry.work.rotation
    parallel = np.abs(axes) > PARALLEL
    family = np.where(parallel.any(axis=1), parallel.argmax(axis=1), 3)
    return np.where(axes.any(axis=1), family, 4)


def mistakes_of_values(m: MeasurementSet) -> Iterator[Mistake]:
    """Yield mistakes whose correction changes readings only: signs, units, exchanged channels."""
    family, every = family_of_run(m)[m.run], np.ones(len(m), dtype=bool)
    # Reversed signs: of a kind of reading, a family, a kind in a family, a channel, a channel in a family
    several = [k for k in np.unique(m.kind) if len(np.unique(m.channel[m.kind == k])) > 1]
    parts = [(KINDS[k], m.kind == k) for k in several if (m.kind != k).any()]
    for number, name in enumerate(RUN_FAMILIES):
        members = family == number
        kinds = np.unique(m.kind[members])
        if members.any() and not members.all():
            parts.append((name, members))
        parts += [(f"{name}, {KINDS[k]}", members & (m.kind == k)) for k in kinds if len(kinds) > 1]
    for channel in np.unique(m.channel):
        members = m.channel == channel
        if not members.all():
            parts.append((CHANNELS[channel], members))
        if KINDS[m.kind[members][0]] != "linear":
            of_families = np.unique(family[members])
            parts += [(f"{RUN_FAMILIES[n]}, {CHANNELS[channel]}", members & (family == n)) for n in of_families]
    for name, members in parts:
        yield Mistake(f"{name}: sign reversed", partial(sign_reversed, m, members))
    for number in np.unique(family[family < RUN_FAMILIES.index("other runs")]):
        name = f"{RUN_FAMILIES[number]}: order of points reversed"
        yield Mistake(name, partial(_order_reversed, m, family == number))
    # Wrong units: of a kind of reading, all kinds that are read along lines, all lengths or all angles
    present = np.unique(m.kind)
    angular = np.array([KINDS[k] in ANGULAR_KINDS for k in present])
    for which, kinds in (("length", present[~angular]), ("angle", present[angular])):
        together = [(f"all {which}s", kinds)] if len(kinds) > 1 else []
        of_lines = [k for k in kinds if KINDS[k] in LINE_KINDS]
        if 1 < len(of_lines) < len(kinds):
            together.append((" and ".join(KINDS[k] for k in of_lines), np.array(of_lines)))
        together += [(KINDS[k], np.array([k])) for k in kinds]
        for (name, chosen), (unit, factor) in product(together, UNITS[which].items()):
            factors = np.where(np.isin(np.arange(len(KINDS)), chosen), factor, 1.0)
            yield Mistake(f"{name}: {unit}", partial(m.with_values, factors[m.kind] * m.value), factors)
    # Exchanged channels: in all runs, or in a family
    for a, b in combinations(np.unique(m.channel), 2):
        if CHANNELS[a].partition("_")[0] != CHANNELS[b].partition("_")[0]:
            continue
        both = (m.channel == a) | (m.channel == b)
        common = [n for n in np.unique(family[both]) if {a, b} <= set(m.channel[family == n].tolist())]
        # Not straightness in all runs: some lines would get a straightness along their own direction
        along_lines = CHANNELS[a].startswith("straightness") and (family[both] < 3).any()
        for name, where in [("", every)] * (not along_lines) + [(f"{RUN_FAMILIES[n]}, ", family == n) for n in common]:
            channel = np.where(both & where, a + b - m.channel, m.channel)
            yield Mistake(f"{name}{CHANNELS[a]} and {CHANNELS[b]}: exchanged", partial(replace, m, channel=channel))


def mistakes_of_check(m: MeasurementSet, model: MachineModel) -> Iterator[Mistake]:
    """Yield mistakes in check readings, such as a compensation that was on where the file says off, or vice versa."""
    if has_nominal_commands(m):
        yield Mistake("taken with this model running (--compensated)", partial(compensated, m, model))
        yield from (mistake for mistake in mistakes_of_poses(m) if mistake.name.endswith(": exchanged"))
    else:
        off = replace(m.stations, commands=_nominal(m))
        yield Mistake("taken with the compensation off", partial(replace, m, stations=off))
    yield Mistake("all readings: sign reversed", partial(m.with_values, -m.value))
    yield from mistakes_of_values(m)


def mistakes_of_poses(m: MeasurementSet) -> Iterator[Mistake]:
    """Yield mistakes in the poses: axes exchanged or mirrored, frames turned, order of angles."""
    for a, b in combinations(range(3), 2):
        order = np.eye(3)
        order[[a, b]] = order[[b, a]]
        yield Mistake(f"{AXES[a]} and {AXES[b]}: exchanged", partial(in_frame, m, order))
    for a, axis in enumerate(AXES):
        mirror = np.diag(1.0 - 2.0 * np.eye(3)[a])
        yield Mistake(f"{axis}: mirrored", partial(in_frame, m, mirror))
        yield Mistake(f"{axis}: mirrored, rotations as well", partial(in_frame, m, mirror, axial=True))
        for quarters, name in enumerate(("by 90°", "by 180°", "by -90°"), start=1):
            turn = rotation_from_vector(0.5 * np.pi * quarters * np.eye(3)[a]).round()
            yield Mistake(f"the work frame: turned about {axis} {name}", partial(in_frame, m, turn))
    for axes in permutations(AXES):
        if axes != ("y", "x", "z"):  # R = Ry(β)·Rx(α)·Rz(γ)
            title = f"angles: turned about {', '.join(axes)} in turn"
            yield Mistake(title, partial(_with_angle_order, m, "".join(axes).upper()))


def _order_reversed(m: MeasurementSet, members: np.ndarray) -> MeasurementSet:
    """Reverse the order of values in each pass of each channel, but only for the readings selected by `members`."""
    of_pass, place = different_rows(np.stack([m.run, m.channel, m.cycle, m.direction], axis=1))[1], np.arange(len(m))
    values = m.value.copy()
    values[np.lexsort((place, of_pass))] = m.value[np.lexsort((-place, of_pass))]
    return m.with_values(np.where(members, values, m.value))


def sign_reversed(m: MeasurementSet, members: np.ndarray) -> MeasurementSet:
    return m.with_values(np.where(members, -m.value, m.value))


def has_nominal_commands(m: MeasurementSet) -> bool:
    """Return whether all strut commands are nominal lengths, within 1 nm."""
    return np.allclose(m.stations.commands, _nominal(m), rtol=0.0, atol=1e-9)


def _nominal(m: MeasurementSet) -> np.ndarray:
    return strut_lengths_batch(Structure.of(m.geometry), m.stations.positions, m.stations.rotations)


def in_frame(m: MeasurementSet, frame: np.ndarray, axial: bool = False) -> MeasurementSet:
    """Correct readings along wrong axes: the columns of `frame`, true axes or reversed ones, are the file's x, y, z.

    If x is mirrored, x coordinates and rotations about x change sign; with `axial`, x and rotations about y and z do.
    """
    tips, tools = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)
    handed = round(float(np.linalg.det(frame)))
    turned = frame @ tools @ frame.T
    if handed < 0 and not axial:
        turned = np.swapaxes(turned, 1, 2)
    work = m.geometry.work
    in_base = work.rotation @ frame @ work.rotation.T
    to, sign = np.abs(frame).argmax(axis=0), frame.sum(axis=0)
    channel, factor = np.arange(len(CHANNELS)), np.ones(len(CHANNELS))
    for index, name in enumerate(CHANNELS):
        kind, _, axis = name.partition("_")
        if axis:
            a = AXES.index(axis)
            channel[index] = CHANNELS.index(f"{kind}_{AXES[to[a]]}")
            factor[index] = sign[a] * (handed if axial and kind in ANGULAR_KINDS else 1)
    centre = work.position + (m.centre - work.position) @ in_base.T
    value = factor[m.channel] * m.value
    runs = tuple(replace(run, axis=in_base @ run.axis) for run in m.runs)
    renamed = replace(m, channel=channel[m.channel], value=value, centre=centre, runs=runs)
    return _at_poses(renamed, *m.geometry.platform_poses(tips @ frame.T, turned), in_base)


def _with_angle_order(m: MeasurementSet, order: str) -> MeasurementSet | None:
    """Return the readings with each pose's angles applied in another `order`; None if no pose has two angles ≠ 0."""
    tips, tools = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)
    angles = angles_from_rotation(tools)
    if (np.abs(angles) > 1e-6).sum(axis=1).max() < 2:
        return None
    about = [rotation_from_vector(angles[:, [a]] * np.eye(3)[a]) for a in ("XYZ".index(axis) for axis in order)]
    turned = about[0] @ about[1] @ about[2]
    return _at_poses(m, *m.geometry.platform_poses(tips, turned), np.eye(3))


def _at_poses(m: MeasurementSet, positions: np.ndarray, rotations: np.ndarray, turn: np.ndarray) -> MeasurementSet:
    """Return the readings at other poses, directions of motion rotated by `turn`, nominal commands computed anew."""
    moving = Passes(m.geometry, positions, rotations, m.stations.sense[:, :3] @ turn.T)
    commands = moving.nominal_commands() if has_nominal_commands(m) else m.stations.commands
    stations = replace(m.stations, positions=positions, rotations=rotations, commands=commands, sense=moving.senses())
    return replace(m, stations=stations)
