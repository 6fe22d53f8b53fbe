"""What may have happened to a machine since it was calibrated, as changes of its parameters.

Every change has a prior N(0, scale²) for each of its columns, and several scales, all equally likely beforehand: a
crash may move a strut by 5 µm as well as by 300 µm.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..machine.geometry import STRUT_NAMES
from ..measurements.readings import AXES
from .blocks import Block
from .parameters import BLOCKS, ParameterSpace
from .posterior import FittedParameters

DATUM, STRUT, TEMPERATURE, AGEING, READING, OTHER = "datum", "strut", "temperature", "ageing", "reading", "other"

FAMILIES = {
    DATUM: "the datum has moved",
    STRUT: "a strut's offset has changed",
    TEMPERATURE: "a temperature acts",
    AGEING: "the whole machine has aged",
    READING: "a single reading is wrong",
    OTHER: "it has changed in a way that none of these explains",
}
"""Kinds of change, and what each is called."""

PRIOR = {DATUM: 1.0, STRUT: 1.0, TEMPERATURE: 1.0, AGEING: 0.125, READING: 0.25, OTHER: 0.5}
"""How likely they are beforehand, beside each other. So are the groups of a kind, equally, and the changes of a group:
else a bend would count for little beside all joints and screws, and what is one would be called ageing. For the same
reason ageing is as likely as one of the last kind's four groups: each can stand for the other, and for much else."""

REPAIRABLE = (DATUM, STRUT, TEMPERATURE, AGEING)
"""Kinds that few readings can repair: they are parameters of the model."""

LENGTHS = (3e-6, 1e-5, 3e-5, 1e-4, 3e-4)
"""How far joints, struts or the datum may have moved, m."""

GROWTHS = (4e-6, 12e-6, 36e-6, 120e-6)
"""How much a body may have grown, m/m: steel by a third of a kelvin to ten kelvin."""

SHARES = (0.02, 0.05, 0.1, 0.2)
"""By which share of its tolerance everything may have aged: the joints by 2 to 20 µm of 100."""

BENDS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""How large a smooth field may have grown, in its first tolerances (5 µm, 20 µrad). As fine as :data:`SHARES`: of two
explanations by many directions the one whose scales fit better would win, whichever is true."""

FIELD = ("field displacement", "field rotation")
"""Blocks of which it is made."""

PITCHES, BACKLASHES = (1e-5, 3e-5, 1e-4, 3e-4), (1e-6, 3e-6, 1e-5, 3e-5)
"""What wear may do to one screw, m/m and m."""


@dataclass(frozen=True)
class Change:
    """One thing that may have happened.

    Attributes
    ----------
    family : str
        Of :data:`FAMILIES`.
    name : str
        For people.
    columns : ndarray, shape (size, k)
        How the parameters change with each of its coefficients, SI.
    scales : tuple of float
        Standard deviations that the coefficients may have.
    shown : tuple of (str, float, str)
        Label, factor and unit in which each coefficient is shown; empty where they mean nothing one by one.
    group : str
        Changes of one kind that are alike; all groups of a kind are equally likely beforehand.
    """

    family: str
    name: str
    columns: np.ndarray
    scales: tuple[float, ...]
    shown: tuple[tuple[str, float, str], ...] = ()
    group: str = ""


def widened(fitted: FittedParameters, blocks: tuple[str, ...] = BLOCKS) -> FittedParameters:
    """Return what a fit knows, in a space that has more blocks; these are zero and, so far, certain.

    Parameters
    ----------
    fitted : FittedParameters
        What a fit knows.
    blocks : tuple of str
        Blocks to have besides those of the fit, where the machine can have them.
    """
    old = fitted.space
    kept = {block.name for block in old.blocks}
    settings = replace(old.settings, blocks=tuple(name for name in BLOCKS if name in kept or name in blocks))
    space = ParameterSpace((old.geometry, old.region), settings)
    places = np.concatenate([np.arange(b.part.start, b.part.stop) for b in space.blocks if b.name in kept])
    x, covariance = np.zeros(space.size), np.zeros((space.size, space.size))
    x[places], covariance[np.ix_(places, places)] = fitted.x, fitted.covariance
    known = {block.name: value for block, value in zip(old.blocks, fitted.tolerances, strict=True)}
    start = space.start_tolerances()
    tolerances = np.array([known.get(b.name, value) for b, value in zip(space.blocks, start, strict=True)])
    return FittedParameters(space, x, covariance, tolerances, fitted.noise, fitted.held)


def possible_changes(space: ParameterSpace, modelled: tuple[str, ...]) -> list[Change]:
    """Return what may have happened to a machine.

    Parameters
    ----------
    space : ParameterSpace
        The parameters in which changes are written; has all blocks, see :func:`widened`.
    modelled : tuple of str
        Blocks of the fit: what of the machine can age.
    """
    return [
        _datum(space),
        *_struts(space),
        *_temperatures(space),
        Change(AGEING, "all of it, a little", _prior_root(space, modelled), SHARES),
        *_joints(space),
        *_screws(space),
        Change(OTHER, "a smooth bend in space", _prior_root(space, FIELD), BENDS, group="bend"),
    ]


class _Structure:
    """Where the structure's parameters stand in a vector."""

    def __init__(self, space: ParameterSpace) -> None:
        start, self.size = space.blocks[0].part.start, space.size
        groups = int(space.platform_groups.max()) + 1
        self.base = start + np.arange(18).reshape(6, 3)
        self.platform = start + 18 + np.arange(3 * groups).reshape(groups, 3)
        self.offsets = start + 18 + 3 * groups + np.arange(6)

    def units(self, places: np.ndarray) -> np.ndarray:
        """Return unit columns for some places, shape (size, k)."""
        columns = np.zeros((self.size, len(places)))
        columns[places, np.arange(len(places))] = 1.0
        return columns


def _datum(space: ParameterSpace) -> Change:
    """Return a rigid motion of base or workpiece; turns are about the box's centre, by how far its corners move."""
    at, columns, work = _Structure(space), np.zeros((space.size, 6)), space.geometry.work.rotation
    size = 0.5 * float(np.linalg.norm(np.ptp(space.work_box, axis=0))) or 1.0
    arms = space.geometry.base_joints - space.places(space.work_box.mean(axis=0))
    for n, axis in enumerate(work.T):
        columns[at.base, n] = axis
        columns[at.base, 3 + n] = np.cross(axis, arms) / size
    shown = [(a, 1e6, "µm") for a in AXES] + [(f"about {a}", 1e6 / size, "µrad") for a in AXES]
    return Change(DATUM, "base or workpiece, in the work frame", columns, LENGTHS, tuple(shown))


def _struts(space: ParameterSpace) -> Iterator[Change]:
    offsets = _Structure(space)
    for name, place in zip(STRUT_NAMES, offsets.offsets, strict=True):
        yield Change(STRUT, name, offsets.units(np.array([place])), LENGTHS, ((name, 1e6, "µm"),))
    shown = tuple((name, 1e6, "µm") for name in STRUT_NAMES)
    yield Change(STRUT, "several struts", offsets.units(offsets.offsets), LENGTHS, shown)


def _temperatures(space: ParameterSpace) -> Iterator[Change]:
    """Yield growth of the struts, of the base, of all bodies alike, and of each by itself."""
    at, geometry, pitch = _Structure(space), space.geometry, space.block("pitch")
    grown = np.zeros((space.size, 3))
    grown[at.offsets, 0] = space.home_lengths
    if pitch is not None:
        grown[pitch.part, 0] = 1.0
    grown[at.base, 1] = geometry.base_joints
    grown[at.platform[space.platform_groups], 2] = geometry.platform_joints
    names = ("struts", "base", "platform")
    for name, n in (("struts", 0), ("base", 1)):
        yield Change(TEMPERATURE, name, grown[:, n : n + 1], GROWTHS, ((name, 1e6, "ppm"),))
    yield Change(TEMPERATURE, "all alike", grown.sum(axis=1, keepdims=True), GROWTHS, (("all", 1e6, "ppm"),))
    yield Change(TEMPERATURE, "each by itself", grown, GROWTHS, tuple((name, 1e6, "ppm") for name in names))


def _joints(space: ParameterSpace) -> Iterator[Change]:
    at = _Structure(space)
    shown = tuple((axis, 1e6, "µm") for axis in AXES)
    for body, joints in (("base", at.base), ("platform", at.platform)):
        for n, places in enumerate(joints, start=1):
            yield Change(OTHER, f"{body} joint {n}", at.units(places), LENGTHS, shown, "joints")


def _screws(space: ParameterSpace) -> Iterator[Change]:
    for name, scales, factor, unit in (("pitch", PITCHES, 1e6, "ppm"), ("backlash", BACKLASHES, 1e6, "µm")):
        block = space.block(name)
        for n, strut in enumerate(STRUT_NAMES if block else ()):
            column = np.zeros((space.size, 1))
            column[block.part.start + n] = 1.0  # type: ignore[union-attr]
            yield Change(OTHER, f"{name} of {strut}", column, scales, ((strut, factor, unit),), "screws")


def _prior_root(space: ParameterSpace, names: tuple[str, ...]) -> np.ndarray:
    """Return a root of the prior's covariance of some blocks at their first tolerances, shape (size, k)."""
    start = dict(zip((block.name for block in space.blocks), space.start_tolerances(), strict=True))
    chosen: list[Block] = [block for block in space.blocks if block.name in names]
    columns, done = np.zeros((space.size, sum(len(b.labels) for b in chosen))), 0
    for block in chosen:
        columns[block.part, done : done + len(block.labels)] = start[block.name] * block.root
        done += len(block.labels)
    return columns
